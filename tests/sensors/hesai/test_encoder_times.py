"""Times and directions of the HESAI encoder, by hand from facts/hesai.md sections 5 and 6."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.builders.hesai import (
    DUAL,
    TRIPLE,
    Angles,
    HesaiSpec,
    MirrorAngles,
    azimuths_deg,
    block_times_ns,
    directions,
    fires,
    firing_times_ns,
    host_times_ns,
    packet_times_ns,
)

# The first packet is sent at 999 999.5 us of a second and says 999 999.
BASE = HesaiSpec("", start_deg=359.9, start_ns=1_700_000_000_999_999_500)
T_NS = 1_700_000_000_999_999_000


def spec(model: str, **chosen: Any) -> HesaiSpec:
    return replace(BASE, model=model, **chosen)


# Times of the first columns after the packet's, by section 5.
BLOCKS = [
    ("Pandar40P", {}, {0: -28580 - 9 * 55560, 8: -84140, 9: -28580}),
    ("Pandar40P", {"mode": DUAL}, {0: -28580 - 4 * 55560, 4: -28580}),
    ("Pandar64", {}, {0: -42580 - 5 * 55560, 5: -42580}),
    ("Pandar64-7", {}, {0: -42580 - 6 * 55560, 6: -42580}),
    ("PandarQT64", {}, {0: 25710, 1: 192376, 2: 359043, 3: 525710}),
    ("QT128C2X", {}, {0: 9000, 1: 120110}),
    ("PandarXT-16", {"mode": DUAL}, {0: 5632 - 150000, 3: 5632}),
    ("PandarXT-32", {}, {0: 5632 - 350000, 7: 5632}),
    ("XT32M2X", {"mode": TRIPLE}, {0: -44368, 1: 5632}),
    ("Pandar128E3X", {}, {0: -24630, 1: 3148}),
    ("Pandar128E3X", {"operation": "standard"}, {0: -52408, 1: 3148}),
    ("Pandar128E3X", {"mode": DUAL}, {0: 3148}),
    ("OT128", {"operation": "standard"}, {0: -55556, 1: 0}),
    ("AT128", {}, {0: -92581, 1: -50915}),
    ("AT128", {"mode": DUAL}, {0: -50915}),
    ("JT16", {}, {0: 0}),
]


@pytest.mark.parametrize(("model", "chosen", "after"), BLOCKS)
def test_times_of_blocks(model: str, chosen: dict[str, Any], after: dict[int, int]) -> None:
    one = spec(model, **chosen)
    times = block_times_ns(one, one.groups) - T_NS
    assert one.groups == max(after) + 1
    assert {column: int(times[column]) for column in after} == after


def test_packets_say_whole_microseconds() -> None:
    # 4 groups of 166.67 us.
    one = spec("PandarQT64")
    assert (packet_times_ns(one, 3) - T_NS).tolist() == [0, 667000, 1333000]


def test_beams_fire_by_their_table() -> None:
    times = firing_times_ns(spec("PandarXT-32"), 8) - T_NS
    assert times[7, :2].tolist() == [5632 + 368, 5632 + 1880]
    times = firing_times_ns(spec("Pandar40P"), 10) - T_NS
    assert times[9, [0, 39]].tolist() == [-28580 - 42220, -28580 - 3620]
    one = spec("QT128C2X")
    assert fires(one, 2).sum(axis=1).tolist() == [96, 96]
    assert (firing_times_ns(one, 2) - T_NS)[:, 0].tolist() == [9000, 120110 + 2312]


@pytest.mark.parametrize("model", ["Pandar40P", "PandarQT64", "QT128C2X", "PandarXT-32"])
def test_packets_arrive_after_their_last_shot(model: str) -> None:
    one = spec(model)
    host = host_times_ns(one, 4)
    last = firing_times_ns(one, 4 * one.groups).reshape(4, -1).max(axis=1)
    assert (host > last).all()
    assert (host > packet_times_ns(one, 4)).all()
    assert (np.diff(host) > 0).all()


def test_azimuths_wrap_and_have_the_packets_steps() -> None:
    assert azimuths_deg(spec("PandarXT-32"), 3).tolist() == [359.9, 0.08, 0.26]
    fine = azimuths_deg(spec("AT128", rpm=201), 2)
    assert fine.tolist() == [359.9, 359.95 + 6 / 25600]


def test_beams_look_where_the_rotor_is_when_they_fire() -> None:
    beams = Angles([0.0] * 31 + [30.0], [10.0] + [0.0] * 31)
    one = spec("PandarXT-32", start_deg=80.0)
    found = directions(one, beams, 1)[0]
    # Channel 1 after 0.368 us: 0.0013248 deg; channel 32 after 47.24 us: 0.170064 deg.
    azimuth = np.degrees(np.arctan2(found[:, 0], found[:, 1]))
    assert azimuth[0] == pytest.approx(90.0013248)
    assert azimuth[31] == pytest.approx(80.170064)
    assert found[31, 2] == pytest.approx(0.5)
    still = directions(one, beams, 1, turning=False)[0]
    assert still[0].tolist() == pytest.approx([1, 0, 0], abs=1e-12)
    # cos 30 deg x sin and cos of 80 deg.
    assert still[31].tolist() == pytest.approx([0.852868532, 0.150383733, 0.5])


def test_mirrors_double_the_angle() -> None:
    mirrors = MirrorAngles((30.0, 150.0, 270.0), [0.0] * 128, [2.4] + [0.0] * 127)
    found = directions(spec("AT128", start_deg=75.0), mirrors, 1, turning=False)[0]
    # 2 x (75 - 30) - 2.4
    assert np.degrees(np.arctan2(found[:2, 0], found[:2, 1])) == pytest.approx([87.6, 90])
    content = mirrors.dat()
    assert len(content) == 47176
    # 30 deg x 25600 = 768000 = 0xbb800; 2.4 deg: 61440 = 0xf000.
    assert content[16:20].hex() == "00b80b00"
    assert content[40:44].hex() == "00f00000"
