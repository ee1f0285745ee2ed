"""IMU packets of both kinds: real ones, hand-worked ones, and encode then decode."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.sensors.ouster.imu import read_legacy
from mlbatch.simulate.ouster.encode import OusterSpec, imu_packet
from tests.builders.spinning import ouster_calibration

ACCEL32 = "ACCEL32_GYRO32_NMEA"


def payload_of(data: bytes) -> U8Array:
    return np.frombuffer(data, np.uint8)


def test_a_legacy_packet_worked_by_hand() -> None:
    lidar = ouster_calibration(OusterSpec(beams=16)).lidar({}, None)
    data = struct.pack("<QQQffffff", 11, 22, 33, 0.5, 0.0, -1.0, 180.0, 0.0, -90.0)
    for extra in (b"", b"\x00"):
        assert lidar.is_imu(len(data + extra))
        samples = lidar.imu(payload_of(data + extra)[None], 3)
        assert samples.sensor == 3
        assert samples.stamp_ns.tolist() == [33]
        assert samples.acceleration.tolist() == [[4.903325, 0.0, -9.80665]]
        np.testing.assert_allclose(samples.angular_velocity, [[np.pi, 0, -np.pi / 2]], rtol=1e-15)


def test_a_new_packet_worked_by_hand() -> None:
    lidar = ouster_calibration(OusterSpec(beams=16, imu_profile=ACCEL32)).lidar({}, None)
    samples = [
        struct.pack("<QHHffffff", 1000 + i, i, status, i, 0.5, 9.75, 0.25, -i, 0.0)
        for i, status in enumerate((1, 0, 0xFFFF))
    ]
    data = b"\x02" + bytes(131) + b"".join(samples) + bytes(32)
    assert len(data) == 164 + 3 * 36
    assert lidar.is_imu(len(data))
    found = lidar.imu(payload_of(data)[None], 0)
    assert found.stamp_ns.tolist() == [1000, 1002]
    assert found.acceleration.tolist() == [[0.0, 0.5, 9.75], [2.0, 0.5, 9.75]]
    assert found.angular_velocity.tolist() == [[0.25, 0.0, 0.0], [0.25, -2.0, 0.0]]


@pytest.mark.parametrize(
    ("profile", "samples", "sizes", "others"),
    [
        ("LEGACY", 0, (48, 49), (47, 50, 452, 680)),
        (ACCEL32, 0, (200, 452), (48, 164, 451, 680, 24896, 164 + 36 * 300)),
        (ACCEL32, 8, (452, 453), (48, 200, 488)),
        ("SOMETHING_NEW", 0, (), (48, 452)),
    ],
)
def test_sizes_of_imu_packets(
    profile: str, samples: int, sizes: tuple[int, ...], others: tuple[int, ...]
) -> None:
    lidar = ouster_calibration(
        OusterSpec(beams=16, imu_profile=profile, imu_samples=samples)
    ).lidar({}, None)
    assert all(lidar.is_imu(size) for size in sizes)
    assert not any(lidar.is_imu(size) for size in others)


@pytest.mark.parametrize(("profile", "count"), [("LEGACY", 1), (ACCEL32, 8)])
def test_encode_then_decode_is_identity(profile: str, count: int) -> None:
    spec = OusterSpec(beams=16, imu_profile=profile, imu_samples=8 * (count > 1))
    rng = np.random.default_rng(count)
    stamps = rng.integers(1, 2**60, count)
    acceleration, angular_velocity = rng.normal(0, 9, (count, 3)), rng.normal(0, 1, (count, 3))
    valid = np.arange(count) % 4 != 3
    data = imu_packet(spec, stamps, acceleration, angular_velocity, valid)
    lidar = ouster_calibration(spec).lidar({}, None)
    assert lidar.is_imu(len(data))
    found = lidar.imu(payload_of(data)[None], 0)
    assert found.stamp_ns.tolist() == stamps[valid].tolist()
    np.testing.assert_allclose(found.acceleration, acceleration[valid], rtol=1e-6)
    np.testing.assert_allclose(found.angular_velocity, angular_velocity[valid], rtol=1e-6)


def test_a_nan_that_signals_makes_no_noise(recwarn: pytest.WarningsRecorder) -> None:
    """0x7F800001 is a signalling NaN: a damaged packet must not print a warning of numpy's."""
    payload = np.zeros(48, np.uint8)
    payload[24:28] = np.frombuffer(bytes.fromhex("0100807f"), np.uint8)
    samples = read_legacy(payload[None], 0)
    assert np.isnan(samples.acceleration[0, 0])
    assert len(recwarn) == 0
