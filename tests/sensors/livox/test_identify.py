"""What Livox packets are called, by docs/sources/others.md."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.sensors.livox import sensor as livox
from mlbatch.sensors.packet_bytes import NO_DECODER
from tests.builders.others import livox1_packets, livox2_packets


@pytest.mark.parametrize(
    ("kind", "size", "what"),
    [
        (1, 14, "Cartesian 32 bit, single return"),
        (2, 8, "Cartesian 16 bit, single return"),
        (3, 10, "spherical, single return"),
        (0x11, 28, "Cartesian 32 bit, dual return"),
    ],
)
def test_names_of_the_second_kind(kind: int, size: int, what: str) -> None:
    packets = livox2_packets(kind, size, 96)
    assert livox.describe(packets.shape[1], packets) == f"Livox lidar (SDK2), {what}"
    longer = np.hstack([packets, packets[:, :1]])
    assert livox.describe(longer.shape[1], longer) is None
    assert livox.describe(packets.shape[1] + 1, packets) is None
    assert livox.describe(packets.shape[1], packets[:0]) is None


@pytest.mark.parametrize(
    ("kind", "size", "what"),
    [
        (0, 1318, "Cartesian, single return"),
        (1, 918, "spherical, single return"),
        (2, 1362, "Cartesian with tags, single return"),
        (3, 978, "spherical with tags, single return"),
        (4, 1362, "Cartesian, dual return"),
        (5, 786, "spherical, dual return"),
        (7, 1278, "Cartesian, triple return"),
        (8, 678, "spherical, triple return"),
    ],
)
@pytest.mark.parametrize(("time_type", "step"), [(0, 400_000), (1, 400_000), (3, 400), (4, 400)])
def test_names_of_the_first_kind(
    kind: int, size: int, what: str, time_type: int, step: int
) -> None:
    packets = livox1_packets(kind, size, time_type, step)
    assert livox.describe(size, packets) == f"Livox lidar (SDK1), {what}{NO_DECODER}"
    assert livox.describe(size, packets[:1]) is None
    assert livox.describe(size, packets[[0, 0, 0]]) is None


def test_names_of_imu_packets() -> None:
    assert livox.describe(60, livox2_packets(0, 24, 1)) == "Livox IMU packet"
    assert livox.describe(42, livox1_packets(6, 42)) == "Livox IMU packet"
