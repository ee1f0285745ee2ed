"""Integrated IMU samples: rest, straight lines and circles by hand, grouping, refusals."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array, I64Array
from mlbatch.errors import RecordingError
from mlbatch.motion.imu import Integrator, standstill
from mlbatch.motion.track import PoseTrack
from mlbatch.units import STANDARD_GRAVITY

HZ = 100
S = 1_000_000_000
START = 1_777_881_600 * S
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])
Samples = tuple[I64Array, F64Array, F64Array]


def samples(seconds: float) -> Samples:
    """An IMU at rest, level."""
    count = round(seconds * HZ) + 1
    stamps: I64Array = START + np.arange(count) * (S // HZ)
    return stamps, np.tile(UP, (count, 1)), np.zeros((count, 3))


def integrated(
    stamps: I64Array, force: F64Array, rate: F64Array, pose: F64Array, name: str = "imu"
) -> PoseTrack:
    """All samples at once; RecordingError if they are shorter than the standstill."""
    track = Integrator(pose, name).push(stamps, force, rate)
    if not len(track.stamp_ns):
        standstill(stamps, force, rate, name)
    return track


def test_at_rest_the_body_stays_whatever_bias_and_tilt() -> None:
    stamps, force, rate = samples(5)
    # Tilted by 30 degrees about x.
    force = np.tile(STANDARD_GRAVITY * np.array([0, 0.5, np.sqrt(0.75)]), (len(force), 1))
    track = integrated(stamps, force, rate + np.array([0.02, -0.01, 0.005]), np.eye(4))
    np.testing.assert_allclose(track.position_m, np.zeros((len(stamps), 3)), atol=1e-9)
    # Up of the world in the body: what was felt.
    expected = [[0, 0.5, np.sqrt(0.75)]] * len(stamps)
    np.testing.assert_allclose(track.rotation[:, 2], expected, atol=1e-9)


def test_a_constant_acceleration_gives_a_parabola() -> None:
    """1 m/s2 along x from 2 s on: at 4 s 2 m/s and 2 m, less half a step of the ramp."""
    stamps, force, rate = samples(4)
    force[stamps >= START + 2 * S, 0] += 1.0
    track = integrated(stamps, force, rate, np.eye(4))
    assert track.position_m[-1, 0] == pytest.approx(2.0, abs=2.0 / HZ + 1e-3)
    np.testing.assert_allclose(track.position_m[:, 1:], np.zeros((len(stamps), 2)), atol=1e-9)


def test_a_turn_in_place_about_the_body_not_about_the_imu() -> None:
    """The IMU is 1 m ahead of the body, which turns at 0.5 rad/s without moving."""
    stamps, force, rate = samples(6)
    turning = stamps >= START + 2 * S
    rate[turning, 2] = 0.5
    # Centripetal, toward the body.
    force[turning, 0] -= 0.25
    # The jump of the velocity of the IMU, 0.5 m/s to the left, within one step.
    force[np.flatnonzero(turning)[0], 1] += 0.5 * HZ
    body_from_imu = np.eye(4)
    body_from_imu[0, 3] = 1.0
    track = integrated(stamps, force, rate, body_from_imu)
    start = track.position_m[0]
    assert np.abs(track.position_m - start).max() < 0.03
    heading = np.arctan2(track.rotation[-1, 1, 0], track.rotation[-1, 0, 0])
    assert heading == pytest.approx(2.0, abs=0.5 / HZ)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_steady_turn_from_the_start_is_no_bias(axis: int) -> None:
    """0.5 rad/s has no deviation, either; taken as a bias the turn would be lost."""
    stamps, force, rate = samples(3)
    rate[:, axis] = 0.5
    with pytest.raises(RecordingError, match=r"in the first second, found a mean of 0\.5"):
        integrated(stamps, force, rate, np.eye(4))
    rate[:, axis] = 0.1
    integrated(stamps, force, rate, np.eye(4))


def moving() -> Samples:
    stamps, force, rate = samples(4)
    random = np.random.default_rng(1)
    late = stamps > START + S
    force[late] += random.normal(0, 0.5, (int(late.sum()), 3))
    rate[late] += random.normal(0, 0.5, (int(late.sum()), 3))
    return stamps, force, rate


@given(st.lists(st.integers(0, 401), max_size=8))
def test_grouping_does_not_matter(cuts: list[int]) -> None:
    """To the bit."""
    stamps, force, rate = moving()
    whole = integrated(stamps, force, rate, np.eye(4))
    integrator = Integrator(np.eye(4))
    edges = [0, *sorted(cuts), len(stamps)]
    parts = [integrator.push(stamps[a:b], force[a:b], rate[a:b]) for a, b in pairwise(edges)]
    for name in ("stamp_ns", "rotation", "position_m"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))


@pytest.mark.parametrize(
    ("hz", "missing", "is_gap"),
    # More than three periods, and 20 ms at least: 3 samples of 100 Hz, 4 of 200 Hz.
    [(100, 2, False), (100, 3, True), (200, 3, False), (200, 4, True), (25, 3, True)],
)
def test_a_gap_ends_the_track(hz: int, missing: int, is_gap: bool) -> None:
    stamps = START + np.arange(4 * hz) * (S // hz)
    kept = (np.arange(4 * hz) < 3 * hz) | (np.arange(4 * hz) >= 3 * hz + missing)
    stamps = stamps[kept]
    force, rate = np.tile(UP, (len(stamps), 1)), np.zeros((len(stamps), 3))
    track = integrated(stamps, force, rate, np.eye(4))
    assert len(track.stamp_ns) == (3 * hz if is_gap else len(stamps))
    integrator = Integrator(np.eye(4))
    integrator.push(stamps[: 3 * hz], force[: 3 * hz], rate[: 3 * hz])
    assert not integrator.is_lost
    integrator.push(stamps[3 * hz :], force[3 * hz :], rate[3 * hz :])
    assert integrator.is_lost == is_gap
    assert integrator.gap_ns == (is_gap * (missing + 1) * S // hz)
    # Nothing is known after it.
    later = integrator.push(stamps[-1:] + S // hz, force[-1:], rate[-1:])
    assert len(later.stamp_ns) == (not is_gap)


def test_a_gap_at_rest_is_none() -> None:
    """0.2 s of the first second, in which the body stands."""
    stamps, force, rate = samples(4)
    kept = (stamps < START + S // 2) | (stamps > START + 7 * S // 10)
    track = integrated(stamps[kept], force[kept], rate[kept], np.eye(4))
    assert len(track.stamp_ns) == int(kept.sum())


@pytest.mark.parametrize(
    ("up", "tilt"),
    [((0, 0, -1), 180), ((1, 0, 0), 90), ((0, -0.6, 0.8), 37)],
)
def test_gravity_points_up_in_the_body(up: tuple[float, ...], tilt: int) -> None:
    """An accelerometer with the other sign, or another frame; 30 degrees are a slope."""
    stamps, force, rate = samples(2)
    force = np.tile(STANDARD_GRAVITY * np.array(up, np.float64), (len(force), 1))
    message = rf"front: expected \+9\.81 m/s2 within 30 degrees .*, {tilt} degrees from it; check"
    with pytest.raises(RecordingError, match=message):
        integrated(stamps, force, rate, np.eye(4), "front")
    # Upright in the body: the IMU is mounted so.
    up_of_imu = np.array(up, np.float64)
    body_from_imu = np.eye(4)
    across = np.array([0.0, 1.0, 0.0]) if up[1] == 0 else np.array([1.0, 0.0, 0.0])
    body_from_imu[:3, :3] = [across, np.cross(up_of_imu, across), up_of_imu]
    integrated(stamps, force, rate, body_from_imu)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("moves", "front: expected the rig to stand in the first second, found deviations"),
        ("g", r"front: expected 9\.81 m/s2 at rest, found 1\.000; check the units"),
        ("short", "front: expected 20 samples in the first second"),
        ("none", "front: expected 20 samples in the first second, found 0"),
    ],
)
def test_an_unusable_imu_is_refused(change: str, expected: str) -> None:
    stamps, force, rate = samples(3)
    if change == "moves":
        rate[:100:2, 1] = 0.3
    elif change == "g":
        force /= STANDARD_GRAVITY
    else:
        count = 50 if change == "short" else 0
        stamps, force, rate = stamps[:count], force[:count], rate[:count]
    with pytest.raises(RecordingError, match=expected):
        integrated(stamps, force, rate, np.eye(4), "front")
