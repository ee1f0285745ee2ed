"""Points of HESAI families, worked by hand from packets that are laid out byte by byte.

Every model by its encoder: `tests/sensors/test_round_trip.py`.

Places: docs/sources/hesai.md section 2 and 3 (header + block x stride + lead + channel x unit);
times: sections 5 and 12. All beams look 30 deg up and 1 deg to the right of the rotor (AT128:
left).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.lidar.interface import Lidar
from mlbatch.simulate.hesai.encode import angles_csv
from tests.builders.decoded import Readings, readings
from tests.builders.others import rows
from tests.builders.spinning import evidence_of, fired, from_file

# 2023-06-15 12:30:45.678901 UTC; `date -u -d 2023-06-15T12:30:45 +%s` says 1686832245.
DATE = bytes([123, 6, 15, 12, 30, 45])
PACKET_NS = 1_686_832_245_678_901_000
DEG_PER_NS = 600 * 6e-9
# The firing-time files of XT models begin at 6 us, which rotate the azimuth; times begin at 368 ns.
AZIMUTH_LAG_NS = {"PandarXT-16": 5632, "PandarXT-32": 5632, "XT32M2X": 5632}


@dataclass(frozen=True)
class Shot:
    """A reading: its channel's byte, what it must become, and when.

    block_ns: time of its block after the packet's; firing_ns: of its channel after that.
    """

    at: int
    column: int
    channel: int
    block_ns: int
    firing_ns: int
    which: int = 0


@dataclass(frozen=True)
class Case:
    """A packet: its header, and the offsets of the tail's fields."""

    model: str
    size: int
    head: str
    channels: int
    tail: tuple[int, int, int, int]  # mode, rpm, date, microseconds
    blocks: tuple[int, ...]  # bytes of the azimuths
    shots: tuple[Shot, ...]
    mode: int = 0x37
    unit_mm: int = 4
    more: tuple[tuple[int, str], ...] = ()


def decode(
    packet: bytes, content: bytes, options: Mapping[str, str] | None = None
) -> tuple[Lidar, Readings, I64Array]:
    """Two packets like this, with an angle file; times (columns, channels) of all firings, ns."""
    packets = rows([packet] * 2)
    lidar = from_file(content).lidar(options or {}, evidence_of(packets))
    assert not lidar.faults(packets).any()
    found = readings(lidar, packets)
    return lidar, found, fired(lidar, found.headers)[0]


def _starts(first: int, stride: int, count: int) -> tuple[int, ...]:
    return tuple(range(first, first + stride * count, stride))


_FLAGS_40P = tuple((124 * block, "ffee") for block in range(10))
CASES = (
    Case(
        *("Pandar40P", 1262, "ffee", 40, (1254, 1248, 1256, 1250), _starts(2, 124, 10)),
        (
            Shot(4, 0, 0, -28580 - 9 * 55560, -42220),
            Shot(1116 + 4 + 33, 9, 11, -28580, -8190),
            Shot(496 + 4 + 117, 4, 39, -28580 - 5 * 55560, -3620),
        ),
        more=_FLAGS_40P,
    ),
    Case(
        *("QT128C2X", 1127, "eeff0302030080020004021d", 128),
        (1073, 1074, 1076, 1082),
        _starts(12, 514, 2),
        (
            Shot(14 + 128, 0, 32, 9000, 27656),
            Shot(12 + 514 + 2, 1, 0, 9000 + 111110, 2312),
            Shot(12 + 514 + 2 + 508, 1, 127, 9000 + 111110, 48976),
        ),
        more=((1066, "01"),),
    ),
    Case(
        *("PandarXT-16", 568, "eeff06010000100800040201", 16, (550, 551, 553, 559)),
        _starts(12, 66, 8),
        (
            Shot(14, 0, 0, 5632 - 7 * 50000, 368),
            Shot(12 + 462 + 2 + 60, 7, 15, 5632, 368 + 45360),
            Shot(12 + 198 + 2 + 16, 3, 4, 5632 - 4 * 50000, 368 + 12096),
        ),
    ),
    Case(
        *("PandarXT-32", 1080, "eeff06010000200800040201", 32, (1062, 1063, 1065, 1071)),
        _starts(12, 130, 8),
        (
            Shot(14, 0, 0, 5632 - 7 * 50000, 368),
            Shot(12 + 910 + 2 + 124, 7, 31, 5632, 368 + 46872),
            Shot(12 + 650 + 2 + 40, 5, 10, 5632 - 2 * 50000, 368 + 15120),
        ),
    ),
    Case(
        *("XT32M2X", 820, "eeff06010000200600050301", 32, (802, 803, 805, 811)),
        _starts(12, 130, 6),
        (
            Shot(14, 0, 0, 5632 - 50000, 368),
            Shot(12 + 130 + 2 + 68, 0, 17, 5632 - 50000, 368 + 2888, which=1),
            Shot(12 + 650 + 2 + 64, 1, 16, 5632, 368, which=2),
        ),
        mode=0x3D,
        unit_mm=5,
    ),
    Case(
        *("OT128", 861, "eeff01048000800200040107", 128, (817, 818, 820, 826)),
        _starts(12, 386, 2),
        (
            Shot(14, 0, 0, -55556, 46645),
            Shot(400 + 6, 1, 2, 0, 18867),
            Shot(400 + 381, 1, 127, 0, 0),
        ),
        # Standard; state 1, then state 0.
        more=((814, "0040"), (816, "02")),
    ),
)


def _packet(case: Case) -> bytes:
    """Azimuths: 40 deg for the first group, and 10 more for each other."""
    packet = bytearray(case.size)
    packet[: len(case.head) // 2] = bytes.fromhex(case.head)
    for at, text in case.more:
        packet[at : at + len(text) // 2] = bytes.fromhex(text)
    mode_at, rpm_at, date_at, us_at = case.tail
    if mode_at:
        packet[mode_at] = case.mode
    if rpm_at:
        struct.pack_into("<H", packet, rpm_at, 600)
    packet[date_at : date_at + 6] = DATE
    struct.pack_into("<I", packet, us_at, 678901)
    returns = {0x37: 1, 0x39: 2, 0x3D: 3}[case.mode]
    for block, at in enumerate(case.blocks):
        struct.pack_into("<H", packet, at, 4000 + 1000 * (block // returns))
    for number, shot in enumerate(case.shots):
        struct.pack_into("<HB", packet, shot.at, 2501 + number, 17 * (number + 1))
    return bytes(packet)


_ELEVATION_DEG = 10.0
# Of beams that the packets leave dark, where the field of view of a model ends.
_LIMITS_DEG = {"QT128C2X": (52.6, -52.6), "XT32M2X": (19.5, -20.8)}
_DOWN_TO_DEG = {"PandarXT-16": -15.0, "PandarXT-32": -16.0}


def _point(azimuth_deg: float, range_m: float) -> tuple[float, float, float]:
    elevation, azimuth = math.radians(_ELEVATION_DEG), math.radians(azimuth_deg)
    flat_m = range_m * math.cos(elevation)
    return flat_m * math.sin(azimuth), flat_m * math.cos(azimuth), range_m * math.sin(elevation)


def _csv(case: Case) -> bytes:
    elevation_deg = [_ELEVATION_DEG] * case.channels
    dark = sorted(set(range(case.channels)) - {shot.channel for shot in case.shots})
    usual = (15.0, _DOWN_TO_DEG.get(case.model, -25.0))
    elevation_deg[dark[0]], elevation_deg[dark[-1]] = _LIMITS_DEG.get(case.model, usual)
    return angles_csv(elevation_deg, [1.0] * case.channels)


@pytest.mark.parametrize("turning", [True, False], ids=["turning", "still"])
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.model}-{case.size}-{case.mode:x}")
def test_hand_worked_points(case: Case, turning: bool) -> None:
    options = {} if turning else {"firing_azimuth": "off"}
    lidar, found, time_ns = decode(_packet(case), _csv(case), options)
    assert lidar.model == case.model
    # Nothing else came back, in either of the two packets.
    assert np.count_nonzero(found.range_m) == 2 * len(case.shots)
    for number, shot in enumerate(case.shots):
        place = shot.column, shot.channel, shot.which
        range_m = (2501 + number) * case.unit_mm / 1000
        assert found.range_m[place] == np.float32(range_m)
        assert found.intensity[place] == 17 * (number + 1)
        assert time_ns[place[:2]] == PACKET_NS + shot.block_ns + shot.firing_ns
        block_deg = 40 + 10 * shot.column
        turned_ns = shot.firing_ns + AZIMUTH_LAG_NS.get(case.model, 0)
        turned_deg = DEG_PER_NS * turned_ns if turning and case.model != "JT16" else 0.0
        expected = _point(block_deg + 1 + turned_deg, range_m)
        assert found.xyz[place].tolist() == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize(("raw", "range_m"), [(0, 0.0), (1, 0.0), (3, 0.0), (4, 0.016)])
def test_small_numbers_of_an_ot128_are_words(raw: int, range_m: float) -> None:
    case = next(case for case in CASES if case.model == "OT128")
    packet = bytearray(_packet(case))
    struct.pack_into("<H", packet, case.shots[1].at, raw)
    _, found, _ = decode(bytes(packet), _csv(case))
    assert found.range_m[1, 2, 0] == np.float32(range_m)
