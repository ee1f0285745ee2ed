"""ROBOSENSE: heads and device packets as the manuals print them, modes of the document.

Source: docs/sources/robosense.md. Where readings lie and when they fire: `test_documents.py`; that
decoders and encoders follow these rows: `test_round_trip.py`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.lidar.interface import Evidence, Lidar
from mlbatch.sensors.robosense.difop import Angles, find_difop
from mlbatch.sensors.robosense.models import AIRY_96, BPEARL_V4, ROWS, RS16, RS32, Model
from mlbatch.sensors.robosense.sensor import BUILT_IN, MODELS
from mlbatch.simulate.robosense.encode import RobosenseSpec
from tests.builders.others import filled, robosense_packets
from tests.builders.spinning import best_of, difops_of, evidence_of, fired
from tests.reference import robosense as reference

FIRST = bytes.fromhex("55aa050a5aa550a0")
DIFOP_MAGIC = bytes.fromhex("a5ff005a11115555")


def _lidar(evidence: Evidence) -> Lidar:
    return best_of(evidence).lidar({}, evidence)


# Elevations that the manuals print: model, byte, field, degrees.
@pytest.mark.parametrize(
    ("row", "at", "field", "channels", "wanted_deg"),
    [
        (RS32, 468, "012829", [0], [-10.281]),
        (BPEARL_V4, 468, "0022f6", [0], [89.50]),
        (AIRY_96, 468, "000171", [0], [3.69]),
        # u24, 0.0001 degree, without a sign: the first eight channels look down.
        (RS16, 1165, f"0249f0{'00' * 21}0249f0{'00' * 21}", [0, 8], [-15.0, 15.0]),
        # Never written.
        (BPEARL_V4, 0, "a5ff005a11115555", [], []),
        (BPEARL_V4, 468, "ff" * 768, [], []),
        (BPEARL_V4, 468, "004000" * 32, [], []),
    ],
)
def test_angles_of_device_packets(
    row: Model, at: int, field: str, channels: list[int], wanted_deg: list[float]
) -> None:
    parts = {0: DIFOP_MAGIC, 1246: b"\x0f\xf0", at: bytes.fromhex(field)}
    found = find_difop(evidence_of([filled(1248, parts)]))
    assert found is not None
    angles = found.angles(row)
    assert isinstance(angles, Angles) == bool(channels)
    if angles is not None:
        assert angles.elevation_deg[channels] == pytest.approx(wanted_deg, abs=1e-9)
        assert row is not RS16 or not angles.azimuth_deg.any()


def _head(parts: Mapping[int, bytes], cdeg: int) -> bytes:
    """The first 46 bytes as the manual prints them; the blocks that follow are made up."""
    blocks = {
        42 + 100 * block: b"\xff\xee" + struct.pack(">H", cdeg + 20 * block) for block in range(12)
    }
    return filled(1248, {0: FIRST, **parts, **blocks})


@pytest.mark.parametrize(
    ("parts", "cdeg", "model", "time_ns"),
    [
        # Never synchronised: its clock counts from 0, here 4066 s.
        (
            {12: struct.pack(">I", 6062479), 20: struct.pack(">HII", 0, 4066, 355991)}
            | {31: b"\x03\x04"},
            *(21582, "RS-Bpearl v4", 4_066_355_991_000),
        ),
        # 2021-12-07 03:06:24 UTC
        (
            {20: bytes((21, 12, 7, 3, 6, 24)) + struct.pack(">HH", 765, 698), 30: b"\x03"},
            *(23577, "RS-Bpearl v3", 1_638_846_384_765_698_000),
        ),
    ],
)
def test_the_real_head_of_a_bpearl(
    parts: Mapping[int, bytes], cdeg: int, model: str, time_ns: int
) -> None:
    after = {**parts, 12: struct.pack(">I", 6062480)} if 12 in parts else parts
    evidence = evidence_of(
        [_head(parts, cdeg), _head(after, cdeg + 240)],
        neighbours=difops_of(RobosenseSpec("Bpearl v3").device_packet(0)) if 30 in parts else (),
    )
    lidar = _lidar(evidence)
    assert lidar.model == model
    counts = lidar.sequence(evidence.sample).tolist()
    if 12 in parts:
        assert (lidar.sequence_modulus, counts) == (2**32, [6062479, 6062480])
    times_ns, angle, _ = fired(lidar, lidar.column_headers(evidence.sample, evidence.host_ns))
    assert times_ns[0, 0] == time_ns
    assert np.degrees(angle[0, 0]) == pytest.approx(cdeg / 100)


def test_a_bpearl_that_leaves_its_count_at_zero_has_nominal_angles_and_no_count() -> None:
    evidence = evidence_of(robosense_packets({0: FIRST, 31: b"\x03\x04"}))
    lidar = _lidar(evidence)
    assert lidar.sequence_modulus == 0
    assert len(set(lidar.sequence(evidence.sample).tolist())) == len(evidence.sample)
    assert lidar.calibration == "nominal angles"
    (note,) = lidar.notes
    assert "nominal" in note
    rise_deg = np.degrees(np.arcsin(lidar.beams.direction[2, :, 2]))
    assert rise_deg == pytest.approx(reference.bpearl_v4_elevation_deg(), abs=1e-4)


@pytest.mark.parametrize(
    ("family", "names"),
    [
        ("RS-16, RS-32, Bpearl v3", ("RS-LiDAR-16", "RS-LiDAR-32", "RS-Bpearl v3")),
        ("Bpearl v4, Helios", ("RS-Bpearl v4", "Helios 16", "Helios 32")),
        ("Ruby (old)", ("Ruby 48", "Ruby 80", "Ruby 128")),
        ("Ruby Plus", ("Ruby Plus 48", "Ruby Plus 80", "Ruby Plus 128")),
        ("Airy", ("Airy 48", "Airy 96")),
    ],
)
def test_return_modes_are_those_of_the_document(family: str, names: tuple[str, ...]) -> None:
    wanted = reference.return_modes(family)
    for row in (row for row in ROWS if row.name in names):
        found = {code: mode.name or reference.DUAL for code, mode in row.modes.items()}
        assert found == wanted
        assert {mode.returns for mode in row.modes.values() if not mode.name} <= {2}
    assert set(names) <= {row.name for row in ROWS}


def test_every_model_is_listed_and_built_in() -> None:
    names = [one.model for one in BUILT_IN]
    assert names == [one.name for one in sensors.models() if one.vendor == "ROBOSENSE"]
    assert len(set(names)) == 14
    assert [one.name for one in MODELS if one.verified == "real recording"] == ["Helios 32"]
