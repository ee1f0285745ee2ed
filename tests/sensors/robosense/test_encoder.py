"""The encoder of ROBOSENSE packets, by bytes worked out by hand from docs/sources/robosense.md.

At 600 rpm the rotor rotates by 0.0036 degrees per us. Readings count up from 1 in the order
(column, return, channel), levels likewise modulo 251.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.simulate.robosense.encode import (
    Angles,
    RobosenseSpec,
    azimuths_deg,
    difop,
    directions,
    fan,
    firing_times_ns,
    msop,
    origins,
)
from mlbatch.simulate.robosense.models import DUAL, LAST, MODELS, NEAREST, STRONGEST

# 2023-11-14 22:13:20 UTC; 1 700 000 000 s are 0x6553F100; 7 us, 12 ms and 999 ns after it.
START_NS = 1_700_000_000_012_007_999
CALENDAR = "170b0e160d14 000c 0007"  # 23, 11, 14, 22, 13, 20; 12 ms, 7 us
SECONDS = "00006553f100 00002ee7"  # 12007 us
COLUMNS = {"RS-16": 24, "Helios 16": 24, "Helios 1615": 24, "Airy 96": 4, "Airy 48": 8}
COLUMNS |= {"Ruby 128": 3, "Ruby Plus 128": 3, "Ruby 80": 4, "Ruby Plus 80": 4}
COLUMNS |= {"Ruby Plus 80v": 4, "Ruby 48": 8, "Ruby Plus 48": 8}


def counted(columns: int, channels: int, returns: int) -> tuple[I64Array, I64Array]:
    """Raw ranges and levels (columns, channels, returns) that count up in the order of the wire."""
    shape = (columns, returns, channels)
    number = np.arange(1, columns * returns * channels + 1).reshape(shape).transpose(0, 2, 1)
    return number, number % 251


def packets(
    model: str, mode: str = STRONGEST, count: int = 1, start_deg: float = 90.0
) -> list[bytes]:
    """Packets of counted readings."""
    spec = RobosenseSpec(model, mode, start_deg=start_deg, start_ns=START_NS, first_counter=258)
    columns = COLUMNS.get(model, 12) * count // spec.returns
    return [
        payload for _, payload in msop(spec, *counted(columns, spec.row.channels, spec.returns))
    ]


# Azimuths of blocks: 90 degrees, and the rotation in the rounds before them.
@pytest.mark.parametrize(
    ("model", "size", "places"),
    [
        # Second block: round 2, 111 us, 0.3996 degrees: 9040; its first reading is the 33rd.
        ("RS-16", 1248, {0: "55aa050a5aa550a0", 20: CALENDAR, 30: "01", 42: "ffee 2328 0001 01",
                         142: "ffee 2350 0021 21", 1246: "00ff"}),
        ("Bpearl v4", 1248, {12: "00000102", 20: SECONDS, 30: "00 03 04", 142: "ffee 233c"}),
        ("Helios 32", 1248, {0: "55aa055a", 17: "01", 20: SECONDS, 30: "00 06 01", 1246: "00ff"}),
        # Two blocks a column, 111.08 us a column: 9040.
        ("Airy 96", 1248, {16: "00 00", 31: "31 02", 42: "ffee 2328 0001", 190: "ffee 2328 0031",
                           338: "ffee 2350 0061", 1246: "0000"}),
        ("Ruby 128", 1248, {0: "55aa055a", 7: "01", 10: SECONDS, 31: "04", 80: "fe01 2328 0001",
                            468: "fe01 233c 0081"}),
        ("Ruby Plus 80v", 1248, {7: "01", 31: "05 03", 324: "fe01 233c 0051"}),
    ],
)  # fmt: skip
def test_bytes_of_single_return_packets(model: str, size: int, places: dict[int, str]) -> None:
    (payload,) = packets(model)
    assert len(payload) == size
    for at, expected in places.items():
        assert payload[at : at + len(bytes.fromhex(expected))] == bytes.fromhex(expected), at


@pytest.mark.parametrize(
    ("model", "places"),
    [
        # One round a block, 0.1998 degrees a round; 17th reading: second return of channel 1.
        ("RS-16", {42: "ffee 2328 0001", 94: "0011 11", 142: "ffee 233c 0021"}),
        ("Bpearl v4", {42: "ffee 2328 0001", 142: "ffee 2328 0021", 242: "ffee 233c 0041"}),
        # Two blocks a return: 48 + 48 channels; 193rd reading: the next column.
        ("Airy 96", {17: "03", 338: "ffee 2328 0061", 634: "ffee 2350 00c1"}),
        ("Ruby 80", {7: "03", 80: "fe01 2328", 324: "fe02 2328 0051", 568: "fe01 233c 00a1"}),
    ],
)
def test_bytes_of_dual_return_packets(model: str, places: dict[int, str]) -> None:
    (payload,) = packets(model, DUAL)
    for at, expected in places.items():
        assert payload[at : at + len(bytes.fromhex(expected))] == bytes.fromhex(expected), at


def test_dual_packets_of_128_lines_share_a_column() -> None:
    """Blocks: column 0 twice, column 1 | column 1, column 2 twice; times of columns 0 and 1."""
    first, second = packets("Ruby 128", DUAL, count=2)
    headers = [[payload[at : at + 4].hex() for at in (80, 468, 856)] for payload in (first, second)]
    assert headers == [["fe012328", "fe022328", "fe01233c"], ["fe02233c", "fe012350", "fe022350"]]
    # 12007.999 + 55.55 us = 12063.549 us.
    assert (first[16:20].hex(), second[16:20].hex()) == ("00002ee7", "00002f1f")
    # The 385th reading begins the second packet.
    assert second[84:86].hex() == "0181"


# Channels (from 1) and their us after the round, worked by section 5.
@pytest.mark.parametrize(
    ("model", "wanted_us"),
    [
        ("RS-16", {1: 0, 2: 2.8, 16: 42.0}),
        ("RS-32", {1: 0, 15: 40.32, 16: 44.64, 17: 1.44, 32: 46.08}),
        ("Bpearl v3", {1: 0, 9: 25.68, 17: 1.28, 25: 26.96, 32: 44.88}),
        ("Bpearl v4", {1: 0, 4: 5.0, 32: 51.71}),
        ("Helios 32", {1: 0, 2: 1.73, 32: 53.63}),
        ("Helios 16", {1: 27.68, 2: 29.41, 16: 53.63}),
        ("Airy 96", {8: 0, 9: 5.712, 96: 93.296}),
        ("Airy 48", {4: 0, 5: 7.616, 48: 97.104}),
        ("Ruby 128", {4: 0, 5: 3.236, 64: 48.54, 65: 0, 128: 48.54}),
        ("Ruby Plus 128", {4: 0, 5: 1.13, 65: 21.14, 66: 23.31, 127: 50.53, 128: 53.771}),
        ("Ruby 80", {3: 0, 4: 3.236, 40: 48.54, 41: 0, 76: 45.304}),
        ("Ruby Plus 80", {4: 0, 5: 1.217, 33: 16.941, 74: 42.683, 75: 50.603, 80: 53.771}),
        ("Ruby Plus 80v", {4: 0, 13: 3.652, 80: 31.963}),
        ("Ruby 48", {1: 0, 5: 12.944, 6: 12.944, 13: 25.888, 24: 48.54, 25: 0}),
        ("Ruby Plus 48", {2: 0, 3: 1.217, 32: 23.127, 48: 40.666}),
    ],
)
def test_times_of_channels(model: str, wanted_us: dict[int, float]) -> None:
    spec = RobosenseSpec(model, start_ns=START_NS)
    after_ns = firing_times_ns(spec, np.arange(1))[0] - START_NS // 1000 * 1000
    found = {channel: after_ns[channel - 1] / 1000 for channel in wanted_us}
    assert found == pytest.approx(wanted_us)


def test_a_beam_points_by_the_formula() -> None:
    """Channel 2 of RS-16: 2.8 us after 90 degrees it is 0.01008 degrees on; 10 degrees up."""
    spec = RobosenseSpec("RS-16", start_deg=90.0)
    angles = Angles(np.full(16, 10.0), np.full(16, 3.0))
    azimuth, elevation = math.radians(93.01008), math.radians(10)
    expected = [
        math.cos(elevation) * math.cos(azimuth),
        -math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    assert directions(spec, angles, np.arange(1))[0, 1] == pytest.approx(expected)
    lens = math.radians(90.01008)
    expected = [0.03825 * math.cos(lens), -0.03825 * math.sin(lens), 0.0]
    assert origins(spec, np.arange(1))[0, 1] == pytest.approx(expected)


def test_reversed_rotor_turns_counterclockwise() -> None:
    spec = RobosenseSpec("Bpearl v4", start_deg=30.0, is_reversed=True)
    angles = Angles(np.zeros(32), np.zeros(32))
    first = directions(spec, angles, np.arange(1))[0, 0]
    assert first == pytest.approx([math.cos(math.radians(30)), math.sin(math.radians(30)), 0.0])
    assert azimuths_deg(spec, np.arange(2))[1, 0] == pytest.approx(-30.200016)
    assert difop(spec, angles)[337] == 1
    assert origins(spec, np.arange(1))[0, 0, 2] == 0.09571


@pytest.mark.parametrize(
    ("model", "mode", "code"),
    [
        ("RS-16", DUAL, 0), ("RS-32", STRONGEST, 1), ("Bpearl v3", LAST, 2),
        ("Bpearl v4", NEAREST, 6), ("Helios 32", LAST, 5), ("Helios 16", STRONGEST, 4),
        ("Ruby 128", DUAL, 3), ("Ruby 48", STRONGEST, 1), ("Ruby Plus 128", STRONGEST, 0),
        ("Ruby Plus 80", DUAL, 3), ("Airy 96", NEAREST, 1),
    ],
)  # fmt: skip
def test_device_packet(model: str, mode: str, code: int) -> None:
    spec = RobosenseSpec(model, mode, rpm=1200, start_ns=START_NS, view_deg=(10.0, 350.0))
    payload = difop(spec, fan(spec), sync=(1, 0))
    assert len(payload) == 1248
    assert payload[:10] == bytes.fromhex("a5ff005a11115555 04b0")
    assert payload[32:36] == bytes.fromhex("03e8 88b8")
    assert payload[292:298] == bytes.fromhex("0a1b2c3d4e5f")
    assert payload[300:303] == bytes((code, 1, 0))
    time = CALENDAR if MODELS[model].is_calendar else SECONDS
    assert payload[303:313] == bytes.fromhex(time)
    assert payload[1246:] == b"\x0f\xf0"
