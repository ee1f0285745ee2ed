"""ROBOSENSE points worked out by hand, from packets laid out byte by byte.

Source: docs/sources/robosense.md. Of every model some readings are put where the sheet says that
they lie; when they fired, where the rotor was by then, and the point follow from the formulas of
sections 5 and 6, written out here with the numbers of each case.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

import numpy as np
import pytest

from mlbatch.sensors.robosense.sensor import MODELS, RobosenseLidar
from tests.builders.others import filled
from tests.builders.robosense_cases import (
    CALENDAR,
    CALENDAR_NS,
    CASES,
    FIRST_CDEG,
    SECONDS_NS,
    Case,
    Probe,
)
from tests.builders.robosense_decoded import built_in, decoded, evidence_of

DIFOP_MAGIC = bytes.fromhex("a5ff005a11115555")


def _packet(case: Case, readings: Mapping[int, bytes]) -> bytes:
    begin, stride, count = case.blocks
    parts = dict(case.head)
    for block in range(count):
        cdeg = FIRST_CDEG + block // case.shared * case.step_cdeg
        azimuth = struct.pack(">H", cdeg)
        parts[begin + block * stride] = case.block_id[:2].ljust(2, b"\1") + azimuth
    return filled(case.size, {**parts, **readings})


def _elevation(channel: int, case: Case) -> tuple[bytes, float]:
    """Bytes in the DIFOP, and degrees."""
    if case.model == "RS-LiDAR-16":  # unsigned; the lower eight look down
        raw = 10_000 * channel + 290
        return raw.to_bytes(3, "big"), raw * 0.0001 * (-1 if channel < 8 else 1)
    raw = 60 * channel + 29
    is_down = channel % 2 == 1
    return bytes((is_down,)) + struct.pack(">H", raw), raw * case.difop[3] * (-1) ** is_down


def _correction(channel: int, case: Case) -> tuple[bytes, float]:
    if not case.difop[2]:
        return b"", 0.0
    raw = 57 - 3 * channel
    return bytes((raw < 0,)) + struct.pack(">H", abs(raw)), raw * case.difop[3]


def _difop(case: Case) -> bytes:
    mode, elevation_at, azimuth_at, _ = case.difop
    channels = int(case.model.split()[-1].split("-")[-1].replace("v3", "32").replace("v4", "32"))
    parts = {0: DIFOP_MAGIC, 300: bytes((mode,)), 1246: b"\x0f\xf0", **case.extra}
    parts[elevation_at] = b"".join(_elevation(k, case)[0] for k in range(channels))
    if azimuth_at:
        parts[azimuth_at] = b"".join(_correction(k, case)[0] for k in range(channels))
    return filled(1248, parts)


def _lidar(case: Case, packet: bytes) -> RobosenseLidar:
    evidence = evidence_of([packet], [_difop(case)])
    lidar = built_in(evidence).lidar({}, evidence)
    assert lidar.model == case.model
    return lidar


def _point(case: Case, probe: Probe, range_m: float) -> tuple[float, float, float]:
    """Section 6: X = r cos w cos a + R cos a'; Y = -(r cos w sin a + R sin a'); Z = r sin w + Z."""
    rotor = math.radians((FIRST_CDEG + probe.turned_cdeg) / 100)
    azimuth = rotor + math.radians(_correction(probe.channel, case)[1])
    elevation = math.radians(_elevation(probe.channel, case)[1])
    radius, height = case.lens_m
    flat = range_m * math.cos(elevation)
    return (
        flat * math.cos(azimuth) + radius * math.cos(rotor),
        -(flat * math.sin(azimuth) + radius * math.sin(rotor)),
        range_m * math.sin(elevation) + height,
    )


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.model}, {case.mode}")
def test_readings_are_where_when_and_what_the_manual_states(case: Case) -> None:
    for number, probe in enumerate(case.probes):
        raw, level = 4000 + 37 * number, 200 + number
        packet = _packet(case, {probe.at: struct.pack(">HB", raw, level)})
        lidar = _lidar(case, packet)
        assert lidar.mode.startswith(case.mode)
        sample = np.frombuffer(packet, np.uint8)[None]
        assert lidar.faults(sample).tolist() == [0]
        found = decoded(lidar, sample)
        place = (probe.column, probe.channel, probe.which)
        assert list(zip(*np.nonzero(found.range_m), strict=True)) == [place]
        range_m = raw * case.unit_m
        assert found.range_m[place] == np.float32(range_m)
        assert found.intensity[place] == level
        begin_ns = CALENDAR_NS if CALENDAR in case.head.values() else SECONDS_NS
        after_ns = found.time_ns[place[:2]] - begin_ns
        assert after_ns == pytest.approx(probe.after_us * 1000, abs=1)
        assert found.xyz_m[place] == pytest.approx(_point(case, probe, range_m), abs=1e-5)


def test_every_model_has_three_readings_worked_out() -> None:
    for model in MODELS:
        assert sum(len(case.probes) for case in CASES if case.model == model.name) >= 3
