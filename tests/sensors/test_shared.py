"""What all vendors share: block times, hashes and checksums of packets, defaults of lidars."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.sensors import content_keys
from mlbatch.sensors.crc import crc32, crc64
from mlbatch.sensors.packet_bytes import block_time_us
from tests.builders.spinning import velodyne_calibration

HOUR_US = 3_600_000_000
# Ten packets of twelve blocks; a block takes 50 us, in which the rotor rotates by 0.36 degrees.
STAMP_US = np.arange(10) * 600
AZIMUTH = (np.arange(10)[:, None] * 12 + np.arange(12)) * 36


def test_without_a_block_time() -> None:
    rest = np.zeros_like(AZIMUTH)
    for stamps_us, azimuth in (
        (STAMP_US[:1], AZIMUTH[:1]),
        (STAMP_US[:0], AZIMUTH[:0]),
        (STAMP_US, rest),
        (STAMP_US, AZIMUTH[:, :1]),
        (np.zeros_like(STAMP_US), AZIMUTH),
    ):
        assert block_time_us(stamps_us, azimuth, HOUR_US) is None


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


def bitwise(message: bytes) -> int:
    """The definition: one bit at a time, lowest first."""
    register = 2**64 - 1
    for byte in message:
        for bit in range(8):
            lowest = (register ^ (byte >> bit)) & 1
            register = (register >> 1) ^ (0xC96C5795D7870F42 if lowest else 0)
    return register ^ (2**64 - 1)


def test_check_values_of_the_catalogue() -> None:
    """Of "123456789", in the catalogue of parametrised checksums; CRC-32 is CRC-32/MPEG-2."""
    messages = np.stack([np.frombuffer(b"123456789", np.uint8)] * 300)
    assert crc64(messages).tolist() == [0x995DC9BBDF1939FA] * 300
    assert crc32(messages).tolist() == [0x0376E6E7] * 300


@settings(max_examples=60)
@given(st.integers(8, 200).flatmap(lambda size: st.lists(st.binary(min_size=size, max_size=size))))
def test_any_messages_equal_the_definition(messages: list[bytes]) -> None:
    if not messages:
        return
    rows = np.array([np.frombuffer(message, np.uint8) for message in messages[:3]])
    assert crc64(rows).tolist() == [bitwise(message) for message in messages[:3]]
