"""Defaults of all lidars without IMU, and hashes of packets."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.sensors import content_keys
from mlbatch.sensors.packet_bytes import number
from tests.builders.spinning import velodyne_calibration


def test_a_lidar_without_imu() -> None:
    lidar = velodyne_calibration("VLP-16").lidar({}, None)
    assert not lidar.is_imu(48)
    assert len(lidar.imu(np.zeros((2, 48), np.uint8), 3).stamp_ns) == 0
    assert lidar.sensor_from_imu() is None
    assert lidar.projection(np.eye(4)) is None


@pytest.mark.parametrize("size", [1, 5, 8, 9, 16, 1206])
@pytest.mark.parametrize("stride", [1, 2])
def test_hashes_are_equal_for_equal_packets_alone(size: int, stride: int) -> None:
    packets = np.random.default_rng(size).integers(0, 256, (3, size * stride), np.uint8)
    packets = packets[:, ::stride]
    packets[1] = packets[0]
    packets[2] = packets[0]
    packets[2, -1] ^= 1
    keys = content_keys(packets)
    assert keys[0] == keys[1] != keys[2]
    assert (keys >= 0).all()


def test_a_number_at_the_end_of_a_packet() -> None:
    packets = np.array([[9, 9, 9, 1, 2, 3]], np.uint8)
    assert number(packets, 3, 3).tolist() == [0x030201]
    assert number(packets, 1, 3).tolist() == [0x010909]
