"""Livox SDK2 points, by hand-worked packets and by what the encoder was given."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.lidar.interface import FAULTS, Evidence
from mlbatch.sensors.livox import sensor as livox
from mlbatch.types import Stream
from tests.builders.decoded import readings
from tests.builders.livox import (
    CARTESIAN16,
    CARTESIAN32,
    DUAL,
    SPHERICAL,
    START_NS,
    LivoxSpec,
    imu_packet,
    point_packets,
)
from tests.builders.others import livox1_packets, livox2_packets, rows

(CALIBRATION,) = livox.BUILT_IN
STILL = np.eye(4)
# Rotates x to y, y to z, z to x; then 10, 20, 30 m on.
TURNED = np.array([[0, 0, 1, 10], [1, 0, 0, 20], [0, 1, 0, 30], [0, 0, 0, 1]], np.float64)


def evidence(packets: U8Array, port: int = 56301) -> Evidence:
    """A stream of these packets."""
    stream = Stream("10.0.0.7", port)
    return Evidence(stream, packets.shape[1], packets, np.arange(len(packets)))


def sensor(packets: U8Array, **options: str) -> livox.LivoxLidar:
    """The lidar that sends these packets."""
    lidar = CALIBRATION.lidar(options, evidence(packets))
    assert isinstance(lidar, livox.LivoxLidar)
    return lidar


def sent(spec: LivoxSpec, coordinates: I64Array, levels: I64Array) -> U8Array:
    """The packets alone."""
    return rows([payload for _, payload in point_packets(spec, coordinates, levels)])


def random_packets(
    spec: LivoxSpec, packets: int = 3, seed: int = 5
) -> tuple[I64Array, I64Array, U8Array]:
    """Raw coordinates (n, returns, 3), levels (n, returns), and their packets."""
    rng = np.random.default_rng(seed)
    shape = (packets * spec.points, spec.returns)
    coordinates = rng.integers(-30_000, 30_000, (*shape, 3))
    if spec.kind == SPHERICAL:
        coordinates = rng.integers(0, (200_000, 18_001, 36_000), (*shape, 3))
    levels = rng.integers(0, 256, shape)
    return coordinates, levels, sent(spec, coordinates, levels)


def decoded(
    packets: U8Array, pose: F64Array = STILL, which: int = 0
) -> tuple[F32Array, F32Array, F32Array]:
    """Points (n, 3), ranges (n,) and intensities (n,), as the core asks for them."""
    found = readings(sensor(packets), packets, body_from_sensor=pose)
    return found.xyz[:, 0, which], found.range_m[:, 0, which], found.intensity[:, 0, which]


def one_point(kind: int, *values: int) -> tuple[list[float], float]:
    """Coordinates and range of a point alone in its packet; values: a triple a return."""
    spec = LivoxSpec(kind, points=1)
    coordinates = np.array(values).reshape(1, spec.returns, 3)
    xyz, range_m, _ = decoded(sent(spec, coordinates, np.full((1, spec.returns), 7)))
    return xyz[0].tolist(), float(range_m[0])


@pytest.mark.parametrize(
    ("kind", "values", "xyz_m", "range_m"),
    [
        # 3, 4, 12 m: 13 m away.
        (CARTESIAN32, (3000, -4000, 12_000), (3.0, -4.0, 12.0), 13.0),
        (CARTESIAN32, (-1, 2, -2), (-0.001, 0.002, -0.002), 0.003),
        # Centimetres: 2, 3, 6 m.
        (CARTESIAN16, (200, -300, 600), (2.0, -3.0, 6.0), 7.0),
        (CARTESIAN16, (-32_768, 0, 0), (-327.68, 0.0, 0.0), 327.68),
        # 90 degrees from z is level; phi rotates from x to y.
        (SPHERICAL, (10_000, 9000, 0), (10.0, 0.0, 0.0), 10.0),
        (SPHERICAL, (10_000, 9000, 9000), (0.0, 10.0, 0.0), 10.0),
        (SPHERICAL, (10_000, 0, 1234), (0.0, 0.0, 10.0), 10.0),
        # 8 m at 60 degrees from z: 4 m up; flat 8 sin 60, at 330 degrees: cos 30, -sin 30.
        (SPHERICAL, (8000, 6000, 33_000), (6.0, -2 * math.sqrt(3), 4.0), 8.0),
    ],
)
def test_points_worked_by_hand(
    kind: int, values: tuple[int, ...], xyz_m: tuple[float, ...], range_m: float
) -> None:
    found_m, found_range_m = one_point(kind, *values)
    assert found_m == pytest.approx(xyz_m, rel=1e-7, abs=2e-6)
    assert found_range_m == np.float32(range_m)


@pytest.mark.parametrize("kind", [CARTESIAN32, CARTESIAN16, SPHERICAL])
def test_a_point_at_the_origin_is_no_return(kind: int) -> None:
    found_m, found_range_m = one_point(kind, 0, 0, 0)
    assert np.isnan(found_m).all()
    assert found_range_m == 0


def test_a_point_of_two_returns() -> None:
    packets = sent(
        LivoxSpec(DUAL, points=1),
        np.array([[[1000, 2000, 2000], [0, 0, -5000]]]),
        np.array([[9, 8]]),
    )
    assert packets.shape == (1, 36 + 28)
    for which, (xyz_m, range_m, level) in enumerate([((1, 2, 2), 3, 9), ((0, 0, -5), 5, 8)]):
        found = decoded(packets, which=which)
        assert [part[0].tolist() for part in found] == [list(xyz_m), range_m, level]


def test_points_go_to_the_body_frame() -> None:
    xyz_m, range_m, _ = decoded(
        sent(LivoxSpec(points=1), np.array([[[1000, 2000, 3000]]]), np.array([[1]])), TURNED
    )
    assert xyz_m[0].tolist() == [13.0, 21.0, 32.0]
    assert range_m[0] == np.float32(math.sqrt(14))


@pytest.mark.parametrize("kind", [CARTESIAN32, CARTESIAN16, SPHERICAL, DUAL])
def test_decoding_is_the_inverse_of_encoding(kind: int) -> None:
    spec = LivoxSpec(kind, points=48, interval=2400)
    coordinates, levels, packets = random_packets(spec)
    lidar = sensor(packets)
    assert lidar.faults(packets).tolist() == [0] * 3
    for which in range(spec.returns):
        xyz_m, range_m, intensity = decoded(packets, which=which)
        assert intensity.tolist() == levels[:, which].tolist()
        raw = coordinates[:, which]
        if kind == SPHERICAL:
            theta, phi = np.radians(raw[:, 1:].T / 100)
            flat_m = raw[:, 0] / 1000 * np.sin(theta)
            up_m = raw[:, 0] / 1000 * np.cos(theta)
            wanted_m = np.stack([flat_m * np.cos(phi), flat_m * np.sin(phi), up_m], axis=1)
            np.testing.assert_allclose(xyz_m, wanted_m, atol=4e-5)
            assert range_m.tolist() == (raw[:, 0] / 1000).astype(np.float32).tolist()
        else:
            wanted_m = raw / (100 if kind == CARTESIAN16 else 1000)
            assert np.array_equal(xyz_m, wanted_m.astype(np.float32))
            np.testing.assert_allclose(range_m, np.linalg.norm(wanted_m, axis=1), rtol=1e-7)


def test_times_of_points() -> None:
    """480 us for 96 points: 5 us from one to the next, and on into the next packet."""
    _, _, packets = random_packets(LivoxSpec(), 2)
    headers = sensor(packets).column_headers(packets, np.zeros(2, np.int64))
    wanted_ns = START_NS + 5000 * np.arange(192).reshape(2, 96)
    assert np.array_equal(headers.stamp_ns, wanted_ns)
    assert headers.valid.all()
    assert not headers.encoder.any()


def test_times_that_points_do_not_divide_are_cut() -> None:
    """100 ns for 3 points: 0, 33.3, 66.7."""
    _, _, packets = random_packets(LivoxSpec(points=3, interval=1), 1)
    headers = sensor(packets).column_headers(packets, np.zeros(1, np.int64))
    assert (headers.stamp_ns[0] - START_NS).tolist() == [0, 33, 66]


def test_attributes() -> None:
    _, _, packets = random_packets(LivoxSpec(DUAL, points=48, time_type=0))
    lidar = sensor(packets)
    assert (lidar.vendor, lidar.model) == ("Livox", "Livox SDK2")
    assert lidar.mode == "Cartesian 32 bit, dual return"
    assert (lidar.channels, lidar.returns, lidar.columns_per_packet) == (1, 2, 48)
    assert (lidar.packet_size, lidar.records.start, lidar.records.size) == (1380, 36, 28)
    assert lidar.timestamp_mode == "time since power-on"
    assert (lidar.return_types, lidar.imu_port, lidar.notes) == ((0, 0), 56401, ())
    assert lidar.sent_by_me(packets).all()
    assert [model.name for model in livox.MODELS] == ["Livox SDK2"]


@pytest.mark.parametrize(("time_type", "mode"), [(1, "gPTP or PTP"), (2, "GPS"), (5, "NTP")])
def test_clocks(time_type: int, mode: str) -> None:
    _, _, packets = random_packets(LivoxSpec(time_type=time_type))
    assert sensor(packets).timestamp_mode == mode


def test_packets_are_counted() -> None:
    _, _, packets = random_packets(LivoxSpec(first_counter=65534), 4)
    lidar = sensor(packets)
    assert lidar.sequence_modulus == 65536
    assert lidar.sequence(packets).tolist() == [65534, 65535, 0, 1]


def test_lost_packets_do_not_hide_the_counter() -> None:
    _, _, packets = random_packets(LivoxSpec(points=1, interval=50), 400)
    assert sensor(packets[[*range(16), 100, 101, 390, 391]]).sequence_modulus == 65536


@pytest.mark.parametrize("shares_stamp", [False, True])
def test_a_counter_that_starts_over_with_every_frame_names_no_packet(shares_stamp: bool) -> None:
    spec = LivoxSpec(points=1, interval=50, frame_packets=20, shares_stamp=shares_stamp)
    _, _, packets = random_packets(spec, 400)
    lidar = sensor(packets[[*range(16), 100, 101, 390, 391]])
    assert lidar.sequence_modulus == 0
    numbers = lidar.sequence(packets)
    assert len(set(numbers.tolist())) == 400
    assert (numbers >= 0).all()
    assert np.array_equal(lidar.sequence(packets[5:7]), numbers[5:7])
    assert bool(lidar.notes) == shares_stamp


def test_damaged_packets_are_rejected() -> None:
    _, _, packets = random_packets(LivoxSpec(), 6)
    lidar, checking = sensor(packets), sensor(packets, crc="check")
    packets[0, 10] = DUAL
    packets[1, 1] ^= 1
    packets[2, 5] ^= 1
    packets[3, 100] ^= 1
    packets[4, 30] ^= 1
    expected = ["bad_header"] * 3 + ["", "", ""]
    assert [FAULTS[fault] for fault in lidar.faults(packets)] == expected
    expected[3:5] = ["bad_crc"] * 2
    assert [FAULTS[fault] for fault in checking.faults(packets)] == expected


def test_times_beyond_all_clocks_do_not_raise() -> None:
    _, _, packets = random_packets(LivoxSpec(), 2)
    packets[1, 28:36] = 0xFF
    headers = sensor(packets).column_headers(packets, np.zeros(2, np.int64))
    assert headers.stamp_ns[1, 0] == -1


def test_imu_samples() -> None:
    """1 g is 9.80665 m/s2; the halves and quarters below are exact."""
    spec, lidar = LivoxSpec(), sensor(random_packets(LivoxSpec())[2])
    payloads = rows(
        [
            imu_packet(spec, 1000 + n, np.array([0.5, -0.25, n]), np.array([1.0, -0.5, 0.0]))
            for n in range(2)
        ]
    )
    assert payloads.shape[1] == 60
    assert lidar.is_imu(60)
    assert not lidar.is_imu(36 + 48)
    samples = lidar.imu(payloads, 3)
    assert (samples.sensor, samples.stamp_ns.tolist()) == (3, [1000, 1001])
    assert samples.angular_velocity.tolist() == [[0.5, -0.25, 0.0], [0.5, -0.25, 1.0]]
    assert samples.acceleration[0].tolist() == [9.80665, -4.903325, 0.0]
    payloads[0, 10] = CARTESIAN32
    assert lidar.imu(payloads, 3).stamp_ns.tolist() == [1001]


def test_fit() -> None:
    _, _, packets = random_packets(LivoxSpec(), 3)
    assert CALIBRATION.match_score(evidence(packets)) == 100
    packets[0] = 0xFF
    assert CALIBRATION.match_score(evidence(packets)) == 100
    packets[1] = 0xFF
    assert CALIBRATION.match_score(evidence(packets)) == 0
    assert CALIBRATION.match_score(evidence(packets[:0])) == 0
    assert CALIBRATION.match_score(evidence(livox2_packets(0, 24, 1))) == 0
    assert CALIBRATION.match_score(evidence(livox1_packets(2, 1362))) == 0
    assert CALIBRATION.is_shared
