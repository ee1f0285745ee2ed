"""Damaged packets are named faults, whatever they are; Livox and Ouster: in their folders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mlbatch.lidar.interface import FAULTS
from mlbatch.simulate.hesai.encode import HesaiSpec
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from tests.builders.spinning import stream_of

XT32 = HesaiSpec("PandarXT-32", "dual")
# A stream; byte and content of damage.
DAMAGE: list[tuple[SpinningSpec, dict[str, tuple[int, str]]]] = [
    (
        VelodyneSpec("VLP-16", "dual"),
        {
            "flag": (300, "ffdd"),
            "azimuth of 360.01 degrees": (102, "a18c"),
            "stamp of a full hour": (1200, "00a493d6"),
            "another mode": (1204, "37"),
        },
    ),
    (
        XT32,
        {
            "marker": (0, "00"),
            "version": (3, "02"),
            "lasers": (6, "10"),
            "blocks": (7, "06"),
            "distance unit": (9, "05"),
            "flags": (11, "00"),
            "azimuth": (13, "ff"),
            "azimuth of the second block, of the first one's group": (143, "10"),
            "one return": (1062, "37"),
            "three returns": (1062, "3d"),
            "unknown mode": (1062, "99"),
            "month": (1066, "0d"),
            "day": (1067, "00"),
            "hour": (1068, "18"),
            "microseconds": (1074, "10"),
        },
    ),
    (HesaiSpec("Pandar40P"), {"flag of a block": (9 * 124, "00")}),
    (
        RobosenseSpec("Helios 32"),
        {
            "magic": (2, "00"),
            "id of the first block": (43, "00"),
            "more than a million us": (26, "10"),
        },
    ),
]


@pytest.mark.parametrize(
    ("spec", "at", "value"),
    [
        pytest.param(spec, *damage, id=f"{spec.model} {what}")
        for spec, table in DAMAGE
        for what, damage in table.items()
    ],
)
def test_damaged_packets_have_a_bad_header(spec: SpinningSpec, at: int, value: str) -> None:
    stream = stream_of(spec, packets=8)
    lidar = stream.lidar()
    packets = stream.damaged((at, bytes.fromhex(value)))
    assert [FAULTS[code] for code in lidar.faults(packets)] == ["bad_header", ""]
    # What is damaged is never a reason to stop.
    headers = lidar.column_headers(packets, np.zeros(2, np.int64))
    assert headers.stamp_ns.shape == (2, lidar.columns_per_packet)


@pytest.mark.parametrize(
    ("spec", "at", "value"),
    [
        # A VLS-128 does not use these blocks with two returns.
        (VelodyneSpec("VLS-128", "dual"), 800, bytes(400)),
        # Another mode with as many returns of the same types.
        (XT32, 1062, b"\x3b"),
    ],
)
def test_what_may_change_is_no_damage(spec: SpinningSpec, at: int, value: bytes) -> None:
    stream = stream_of(spec, packets=8)
    assert not stream.lidar().faults(stream.damaged((at, value))).any()


@pytest.mark.parametrize("model", ["QT128C2X", "Pandar128E3X", "OT128", "AT128", "JT16"])
def test_checksums_are_checked_if_asked(model: str) -> None:
    stream = stream_of(HesaiSpec(model))
    damaged = stream.packets[:3].copy()
    damaged[0, 40] ^= 1  # a channel
    damaged[1, 72 if model == "JT16" else -37] ^= 0x80  # in the tail or its checksum
    checking = stream.lidar(crc="check")
    assert [FAULTS[code] for code in checking.faults(damaged)] == ["bad_crc", "bad_crc", ""]
    assert not checking.faults(stream.packets).any()
    assert not stream.lidar().faults(damaged).any()


def test_damaged_blocks_of_a_robosense_are_columns() -> None:
    stream = stream_of(RobosenseSpec("Helios 32"), packets=6)
    lidar = stream.lidar()
    packets = stream.packets.copy()
    packets[2, 42 + 500] = 0  # id of block 5
    packets[3, 42 + 302] = 0xFF  # azimuth of block 3: 655 degrees
    # It jumps there and back again, as no gap does.
    packets[5, 42 + 302] ^= 0x40
    changed = replace(stream, packets=packets)
    assert not lidar.faults(packets).any()
    found, whole = changed.headers(lidar), stream.headers(lidar)
    assert (~found.valid).nonzero()[0].tolist() == [2, 3]
    assert (~found.valid).nonzero()[1].tolist() == [5, 3]
    np.testing.assert_array_equal(found.stamp_ns, whole.stamp_ns)
