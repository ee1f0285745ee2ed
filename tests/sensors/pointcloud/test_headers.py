"""Headers of the packets of clouds: one column each."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.ros.point_packets import Layout, Points, pack
from mlbatch.sensors.pointcloud.sensor import CloudLidar
from tests.builders.engines import needs_native
from tests.builders.headers import check_headers
from tests.builders.points import STAMP_NS

pytestmark = needs_native
HOST_NS = np.full(40, STAMP_NS)


def _lidar_and_packets() -> tuple[CloudLidar, U8Array]:
    """Forty columns of eight rings."""
    random = np.random.default_rng(3)
    ring = np.tile(np.arange(8, dtype=np.uint16), 40)
    nothing = np.zeros(320, np.uint8)
    stamp_ns = STAMP_NS + np.repeat(np.arange(40), 8) * 55_296
    reals = random.random((4, 320)).astype(np.float32)
    layout = Layout(0, 16, by_ring=True)
    return CloudLidar(layout, "/top"), pack(
        Points(stamp_ns, reals, ring, nothing, nothing), layout, 0
    )


def test_each_packet_is_a_column() -> None:
    lidar, packets = _lidar_and_packets()
    found = check_headers(lidar, packets, HOST_NS)
    expected = STAMP_NS + np.arange(40) * 55_296
    assert found.columns.stamp_ns[:, 0].tolist() == expected.tolist()


def test_hashes_that_are_known_are_used() -> None:
    lidar, packets = _lidar_and_packets()
    keys = np.arange(40)
    start = keys * lidar.packet_size
    found = lidar.reader.read(packets.reshape(-1), start, HOST_NS, keys) if lidar.reader else None
    assert found is not None
    assert found.key.tolist() == keys.tolist()


@pytest.mark.parametrize("change", ["times that fall", "another layout"])
def test_unusual_packets(change: str) -> None:
    lidar, packets = _lidar_and_packets()
    if change == "another layout":
        packets[7, 5] = 1
    else:
        packets = packets[::-1]
    found = check_headers(lidar, packets, HOST_NS)
    assert found.faults.any() == (change == "another layout")
