"""Real Velodyne recordings, converted whole, against the points of velodyne-decoder.

Figures: recordings/MANIFEST.md; docs/sources/velodyne.md section 11 (how well decoders agree) and
12 (where that one is wrong).
"""

from __future__ import annotations

import struct
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.simulate.velodyne.models import MODELS
from tests.builders.run import Cloud
from tests.builders.traffic import read_pcap
from tests.recordings.references import (
    HOUR_NS,
    ONLY,
    STRONGEST_FIRST,
    STRONGEST_LAST,
    US_NS,
    WEAK_FIRST,
    WEAK_LAST,
    apart,
    converted,
    heading_deg,
    turned_deg,
)
from tests.recordings.velodyne import BELIED, CASES, DUAL, FOLDER, GAPS, GPS, Case

every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.folder)


@every_case
def test_every_point_with_the_angles_of_the_vendor(case: Case, tmp_path: Path) -> None:
    ours = converted(case.alone(tmp_path), tmp_path / "out").cloud
    check(case, ours, added_m=0 * case.heights_m)


@pytest.mark.parametrize("case", [DUAL, GAPS], ids=lambda case: case.folder)
def test_every_point_with_the_file_next_to_the_bag(case: Case, tmp_path: Path) -> None:
    """The file, found automatically, has the vendor's angles, and 0 for the heights of all lasers.

    The built-in heights are kept.
    """
    alone = case.alone(tmp_path)
    for words, added_m in (((), 0.0), (("--decode", "vertical_offset=off"), 1.0)):
        made = converted(case.path, tmp_path / f"found {added_m}", *words)
        assert made.sensor["calibration"] == case.file
        assert ("vertical offsets of all lasers are 0" in made.err) == (not words)
        check(case, made.cloud, added_m=added_m * case.heights_m)
        built_in = converted(alone, tmp_path / f"alone {added_m}", *words)
        assert built_in.sensor["calibration"] == "built in"
        assert np.abs(built_in.cloud.xyz - made.cloud.xyz).max() < 1e-4


def check(case: Case, ours: Cloud, added_m: F64Array) -> None:
    """Ranges, rings and levels equal; angles and times as near as both decoders can be."""
    theirs = case.theirs
    assert len(ours.range_m) == case.points
    assert (ours.lidar_id == 0).all()
    assert ours.reflectivity is None
    # The first sequence of a packet begins at the packet's stamp.
    assert np.array_equal(ours.column_stamp_ns[:: case.columns], theirs.packet_ns)
    assert len(ours.column_stamp_ns) == case.packets * case.columns
    found, good = apart(ours, theirs, case.heights_m, added_m), case.known_well(theirs)
    assert int(good.sum()) == (129_711 if case is GAPS else case.points)
    # Less than half a count means equal counts; theirs went through single precision.
    assert found.range_m.max() < 5e-5
    assert found.up_m.max() < 5e-5
    assert found.turn_deg[good].max() < 0.03
    assert found.time_ns[good].max() < US_NS


@every_case
def test_the_report(case: Case, tmp_path: Path) -> None:
    made, theirs = converted(case.path, tmp_path / "out"), case.theirs
    sensor, points = made.sensor, made.sensor["points"]
    assert (sensor["model"], sensor["mode"]) == (case.model, case.mode)
    assert sensor["calibration"] == (case.file or "built in")
    assert made.report["timescale"] == case.timescale
    packets = {"read": case.packets, "accepted": case.packets, "rejected": {}}
    assert sensor["packets"] == {**packets, "lost": 0, "reordered": 0}
    assert sensor["columns"]["written"] == case.packets * case.columns
    # Of the fastest packet, by its newest column.
    newest_ns = made.cloud.column_stamp_ns[case.columns - 1 :: case.columns]
    ahead_ms = (newest_ns - theirs.host_ns).max() / 1e6
    assert sensor["clock"]["offset_to_host_ms"] == pytest.approx(ahead_ms, abs=1e-3)
    returns = 2 if case is DUAL else 1
    beams = len(MODELS[case.model].elevation_deg)
    assert points["slots"] == case.packets * case.columns * beams * returns
    twice = int((theirs.which == 3).sum())
    assert points["repeated"] == twice
    assert points["written"] == len(theirs.ring)
    both = converted(case.path, tmp_path / "both", "--keep-repeated").sensor["points"]
    assert both["repeated"] == 0
    assert both["written"] == len(theirs.ring) + twice
    warnings = {one["code"]: one["message"] for one in made.report["warnings"]}
    assert len(warnings) == made.err.count("\n")
    assert ("calibration" in warnings) == (case is BELIED or case.file != "")
    # More than 2 s off: the hour is known, but not the time past it.
    assert ("clock_epoch" in warnings) == (case.timescale == "unknown")
    if case is BELIED:
        assert "VLP-16" in warnings["calibration"]
        assert "product byte says HDL-32E" in warnings["calibration"]
    if case.file:
        assert "vertical offsets of all lasers are 0" in warnings["calibration"]


@pytest.mark.parametrize("decode", ["on", "off"])
def test_angle_follows_time_over_blind_sectors(decode: str, tmp_path: Path) -> None:
    """The unit is silent for half of each revolution, but its rotor keeps its speed."""
    words = ("--decode", f"firing_azimuth={decode}")
    ours = converted(GAPS.path, tmp_path / "out", *words).cloud
    assert GAPS.theirs.behind_jump.sum() == 26
    assert (np.diff(ours.column_stamp_ns) > 0).all()
    # All columns have points.
    assert len(np.unique(ours.column)) == GAPS.packets * GAPS.columns
    table = MODELS["VLP-32C"]
    order = np.argsort(table.elevation_deg)
    rotor_deg = heading_deg(ours.xyz) - np.array(table.azimuth_deg)[order][ours.ring]
    when_ns = ours.at_ns if decode == "on" else ours.stamp_ns
    past_s = (when_ns - when_ns[0]) / 1e9
    revolutions = rotor_deg / 360
    revolutions += np.rint(past_s * 10 - (revolutions - revolutions[0]))
    slope, start = np.polyfit(past_s, revolutions, 1)
    assert slope == pytest.approx(10.0, abs=0.01)
    assert np.abs((revolutions - start) / slope - past_s).max() < 20e-6


def test_time_of_the_first_packet_by_hand(tmp_path: Path) -> None:
    """GPRMC gives the hour, the packet the microseconds past it; the pulse is locked: UTC."""
    payloads = [frame[42:] for _, frame in read_pcap(GPS.path)]
    position = next(one for one in payloads if len(one) == 512)
    assert position[202] == 2
    sentence = position[206:334].split(b",")
    assert sentence[:3] == [b"$GPRMC", b"081802.00", b"A"]
    assert sentence[9] == b"210116"
    packet = next(one for one in payloads if len(one) == 1206)
    (past_hour_us,) = struct.unpack_from("<I", packet, 1200)
    # 18 min 2.340595 s, by the sentence.
    assert past_hour_us == 1_082_340_595
    hour_s = int(datetime(2016, 1, 21, 8, tzinfo=timezone.utc).timestamp())
    made = converted(GPS.path, tmp_path / "out")
    assert made.cloud.column_stamp_ns[0] == hour_s * 1_000_000_000 + past_hour_us * US_NS
    assert made.cloud.column_stamp_ns[0] == 1_453_364_282_340_595_000
    assert made.report["timescale"] == made.sensor["clock"]["epoch"] == "utc"


def test_an_azimuth_of_36000_costs_no_packet(tmp_path: Path) -> None:
    """Data packet 1750 has it; the reference has packets 1600 to 1901."""
    folder = FOLDER / "vlp16_azimuth-36000"
    recording = folder / "vlp-16-test-90deg-1-50-frames.pcap"
    made = converted(recording, tmp_path / "out")
    assert made.sensor["model"] == "VLP-16"
    assert made.sensor["packets"]["rejected"] == {}
    assert made.sensor["points"]["written"] == 700_400
    ours = made.cloud
    packet = ours.column.astype(np.int64) // 24
    with np.load(folder / "reference.npz") as theirs:
        wanted = {key: theirs[key] for key in theirs.files}
    late = packet >= 1600
    order = np.lexsort((ours.at_ns[late], packet[late]))
    past_hour_ns = ours.at_ns[late][order] % HOUR_NS
    assert np.array_equal(packet[late][order], wanted["data_packet"])
    assert np.array_equal(past_hour_ns, wanted["time_past_hour_ns"])
    assert np.array_equal(ours.ring[late][order], wanted["ring"])
    assert np.array_equal(ours.intensity[late][order], wanted["intensity"])
    xyz = ours.xyz[late][order]
    turn_deg = np.abs(turned_deg(heading_deg(xyz), heading_deg(wanted["xyz_m"])))
    # That decoder rounds to 0.01 degrees.
    assert turn_deg.max() < 0.0051
    assert np.abs(xyz[:, 2] - wanted["xyz_m"][:, 2]).max() < 5e-5


def test_returns_of_a_pair_are_distinguished(tmp_path: Path) -> None:
    """Even blocks have the last return: the farther one, wherever two are seen (section 3)."""
    ours, theirs = converted(DUAL.path, tmp_path / "out").cloud, DUAL.theirs
    types = ours.return_type[np.lexsort((ours.range_m, ours.ring, ours.column))]
    # 97.8 % of pairs are equal; one return is missing in 528 and 57; 708 differ.
    assert [(theirs.which == kind).sum() for kind in (1, 2, 3)] == [708 + 57, 708 + 528, 57_413]
    alone = types == ONLY
    assert alone[theirs.which == 3].all()
    assert [(alone & (theirs.which == kind)).sum() for kind in (1, 2)] == [57, 528]
    first, last = (~alone & (theirs.which == kind) for kind in (1, 2))
    assert np.isin(types[first], (STRONGEST_FIRST, WEAK_FIRST)).all()
    assert np.isin(types[last], (STRONGEST_LAST, WEAK_LAST)).all()
    # Both of a pair are adjacent in this order; one of them is the stronger.
    pair = first.nonzero()[0]
    assert np.array_equal(pair + 1, last.nonzero()[0])
    levels = theirs.intensity
    differ = levels[pair] != levels[pair + 1]
    nearer_is_stronger = levels[pair] > levels[pair + 1]
    assert np.array_equal((types[pair] == STRONGEST_FIRST)[differ], nearer_is_stronger[differ])
    assert (types[pair].astype(int) + types[pair + 1] == STRONGEST_FIRST + WEAK_LAST).all()
    # The sheet: the odd one is the stronger in 41 %.
    assert nearer_is_stronger.mean() == pytest.approx(0.41, abs=0.02)
