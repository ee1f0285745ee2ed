"""Headers of the packets of clouds, by compiled loops and by numpy."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.pipeline.sensor import header_loops
from mlbatch.ros.point_packets import Layout, Points, pack
from mlbatch.sensors.pointcloud.sensor import CloudLidar
from tests.builders.engines import needs_native
from tests.builders.points import STAMP_NS

pytestmark = needs_native


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


@pytest.mark.parametrize("knows_keys", [False, True])
def test_compiled_headers_are_those_of_numpy(knows_keys: bool) -> None:
    lidar, packets = _lidar_and_packets()
    host_ns = np.full(40, STAMP_NS)
    expected = lidar.column_headers(packets, host_ns)
    key = lidar.sequence(packets)
    loops = header_loops(lidar)
    assert loops is not None
    start = np.arange(40) * lidar.packet_size
    known = key if knows_keys else None
    found = loops.read(packets.reshape(-1), start, lidar.packet_size, host_ns, known)
    assert found is not None
    headers, found_key = found
    assert found_key.tolist() == key.tolist()
    for name in ("stamp_ns", "encoder", "valid"):
        assert np.array_equal(
            getattr(headers, name).reshape(-1), getattr(expected, name).reshape(-1)
        )


def test_unusual_headers_are_left_to_numpy() -> None:
    """Another layout, or times that fall."""
    lidar, packets = _lidar_and_packets()
    loops = header_loops(lidar)
    assert loops is not None
    start = np.arange(40) * lidar.packet_size
    host_ns = np.full(40, STAMP_NS)
    assert loops.read(packets.reshape(-1), start[::-1], lidar.packet_size, host_ns) is None
    packets[7, 5] = 1
    assert loops.read(packets.reshape(-1), start, lidar.packet_size, host_ns) is None
