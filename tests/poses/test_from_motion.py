"""Poses from motion: exact twists, motions that determine less, and simulated recordings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.registration import Pose
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.from_motion import (
    MotionPose,
    Odometry,
    contradiction,
    poses_of_twists,
)
from mlbatch.poses.solve import Cloud

STEPS = 200
NS = 100_000_000
SIGMA_M = 2e-3
SIGMA_RAD = 3e-4


def middles() -> I64Array:
    """Middles of the windows of 10 Hz."""
    return np.arange(STEPS, dtype=np.int64) * NS


def body_twists(motion: str, late_s: float = 0.0) -> F64Array:
    """Twists (STEPS, 6) of a body per 0.1 s: x ahead, z up."""
    s = 0.1 * np.arange(STEPS) - late_s
    twists = np.zeros((STEPS, 6))
    if motion != "standstill":
        twists[:, 0] = 0.4 + 0.1 * np.sin(0.5 * s)
    if motion in {"planar", "full"}:
        twists[:, 5] = 0.06 * np.sin(0.4 * s)
    if motion == "full":
        twists[:, 3] = 0.03 * np.sin(1.1 * s)
        twists[:, 4] = 0.03 * np.cos(0.7 * s)
    return twists


def seen_by(body: F64Array, pose: Pose) -> F64Array:
    """Twists of a sensor at a pose on the body, by velocities of its origin: v + w x p."""
    shift = body[:, :3] + np.cross(body[:, 3:], pose.position_m)
    return np.concatenate([shift @ pose.rotation, body[:, 3:] @ pose.rotation], axis=1)


def noisy(twists: F64Array, seed: int) -> F64Array:
    """Errors of poses, which the next step takes back."""
    draw = np.random.default_rng(seed).normal(size=(STEPS + 1, 6))
    sigma: F64Array = np.repeat([SIGMA_M, SIGMA_RAD], 3)
    found: F64Array = twists + np.diff(draw, axis=0) * sigma
    return found


def mountings(seed: int) -> tuple[Pose, Pose]:
    """Any two poses on a body."""
    rng = np.random.default_rng(seed)
    turns = exp_rotation(rng.normal(size=(2, 3)) * 2.0)
    first, other = (Pose(turn, rng.uniform(-2.0, 2.0, 3)) for turn in turns)
    return first, other


def solved(motion: str, seed: int) -> tuple[MotionPose, F64Array, Pose]:
    """The pose found, its error (6,), m and rad, and the pose of the first lidar."""
    first, other = mountings(seed)
    body = body_twists(motion)
    twists = np.stack([noisy(seen_by(body, first), seed), noisy(seen_by(body, other), seed + 500)])
    (_, found) = poses_of_twists(twists, middles(), ("front", "rear")).poses
    rotation = first.rotation.T @ other.rotation
    position = first.rotation.T @ (other.position_m - first.position_m)
    turn = log_rotation((found.first_from_lidar.rotation @ rotation.T)[None])[0]
    return found, np.concatenate([found.first_from_lidar.position_m - position, turn]), first


def test_exact_twists_give_the_pose_itself() -> None:
    first, other = mountings(4)
    body = body_twists("full")
    twists = np.stack([seen_by(body, first), seen_by(body, other)])
    (_, found) = poses_of_twists(twists, middles(), ("front", "rear")).poses
    expected = first.rotation.T @ (other.position_m - first.position_m)
    np.testing.assert_allclose(found.first_from_lidar.position_m, expected, atol=1e-6)
    np.testing.assert_allclose(
        found.first_from_lidar.rotation, first.rotation.T @ other.rotation, atol=1e-7
    )


def test_errors_are_those_that_are_stated() -> None:
    squares = []
    for seed in range(20):
        found, error, _ = solved("full", seed)
        assert not found.refusal
        assert not found.undetermined
        assert np.abs(error[:3]).max() < 0.02
        assert np.abs(error[3:]).max() < math.radians(0.1)
        squares.append(error @ np.linalg.solve(found.covariance, error))
    # Chi-squared of 120 degrees of freedom: 0.01 % lie above; real errors follow the motion, for
    # which variances are stated three times as large.
    assert 70.0 / 3.0 < sum(squares) < 185.0


@pytest.mark.parametrize("seed", range(5))
def test_planar_motion_leaves_the_axis(seed: int) -> None:
    found, error, first = solved("planar", seed)
    assert not found.refusal
    up = first.rotation.T @ np.array([0.0, 0.0, 1.0])
    assert found.weak.shape == (6, 1)
    assert abs(found.weak[:3, 0] @ up) > 0.999
    assert "shift along the axis of its turns" in found.undetermined[0]
    level = error[:3] - up * (error[:3] @ up)
    assert np.abs(level).max() < 0.02
    assert np.abs(error[3:]).max() < math.radians(0.1)


@pytest.mark.parametrize("seed", range(5))
def test_a_straight_line_leaves_the_turn_about_it(seed: int) -> None:
    found, _, first = solved("straight", seed)
    ahead = first.rotation.T @ np.array([1.0, 0.0, 0.0])
    assert "turn about the direction of travel" in found.refusal
    assert "figure of eight" in found.refusal
    turns = found.weak[3:][:, np.abs(found.weak[3:]).max(axis=0) > 0]
    assert np.abs(turns.T @ ahead).max() > 0.999


@pytest.mark.parametrize("late_s", [0.06, -0.06])
def test_clocks_that_differ_are_named(late_s: float) -> None:
    first, other = mountings(3)
    twists = np.stack(
        [
            noisy(seen_by(body_twists("full"), first), 1),
            noisy(seen_by(body_twists("full", late_s), other), 2),
        ]
    )
    (_, found) = poses_of_twists(twists, middles(), ("front", "rear")).poses
    (words,) = [words for words in found.undetermined if "clock of front" in words]
    assert "60 ms after" in words if late_s > 0 else "60 ms before" in words


def test_refined_poses_that_contradict_the_motion() -> None:
    first, other = mountings(6)
    body = body_twists("planar")
    twists = np.stack([noisy(seen_by(body, first), 1), noisy(seen_by(body, other), 2)])
    motion = poses_of_twists(twists, middles(), ("front", "rear"))
    true = Pose(
        first.rotation.T @ other.rotation,
        first.rotation.T @ (other.position_m - first.position_m),
    )
    start = Pose(np.eye(3), np.zeros(3))
    assert not contradiction(motion, [start, true], ("front", "rear"))
    ahead, up = first.rotation.T[:, 0], first.rotation.T[:, 2]
    # Of a shift along the axis of its turns the motion says little.
    shifted = Pose(true.rotation, true.position_m + 0.05 * up)
    assert not contradiction(motion, [start, shifted], ("front", "rear"))
    shifted = Pose(true.rotation, true.position_m + 0.05 * ahead)
    assert "rear: expected surfaces" in contradiction(motion, [start, shifted], ("front", "rear"))


def test_a_machine_that_stands_is_refused() -> None:
    found, _, _ = solved("standstill", 1)
    assert "expected a machine that moves" in found.refusal


def test_few_windows_are_refused() -> None:
    twists = np.full((2, STEPS, 6), np.nan)
    (_, found) = poses_of_twists(twists, middles(), ("front", "rear")).poses
    assert "expected 30 windows with the motion of both front and rear, found 0" in found.refusal


def test_a_wrong_step_does_not_matter() -> None:
    first, other = mountings(2)
    body = body_twists("full")
    twists = np.stack([noisy(seen_by(body, first), 1), noisy(seen_by(body, other), 2)])
    twists[1, 50] += 0.5
    twists[1, 90:95] = np.nan
    (_, found) = poses_of_twists(twists, middles(), ("front", "rear")).poses
    expected = first.rotation.T @ (other.position_m - first.position_m)
    assert np.abs(found.first_from_lidar.position_m - expected).max() < 0.02


# Half of the edges of a room, m; rays of a lidar, 32 rings of 360.
ROOM_M = np.array([5.0, 3.5, 2.0])
WINDOWS = 24


def pose_at(time_s: F64Array) -> tuple[F64Array, F64Array]:
    """Rotations (n, 3, 3) and places (n, 3) of a lidar that sways while it drives a curve."""
    vector = np.zeros((len(time_s), 3))
    vector[:, 2] = 0.4 * time_s
    vector[:, 0] = 0.02 * np.sin(7.0 * time_s)
    place = np.stack([0.8 * time_s, 0.3 * np.sin(time_s), 0.02 * np.cos(8.0 * time_s)], axis=1)
    return exp_rotation(vector), place


def seen_in_room(start_s: float, mounting: F64Array, seed: int) -> Cloud:
    """A revolution of 0.1 s, in the frame of a lidar that is mounted with a rotation."""
    azimuth = np.repeat(np.arange(360) + 0.3, 32) * (2.0 * math.pi / 360)
    elevation = np.tile(np.linspace(-0.7, 0.7, 32), 360)
    level = np.cos(elevation)
    ray = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    time_s = start_s + azimuth / (2.0 * math.pi) * 0.1
    rotation, place = pose_at(time_s)
    way = np.matmul(rotation, (ray @ mounting.T)[:, :, None])[:, :, 0]
    with np.errstate(divide="ignore"):
        range_m = ((np.sign(way) * ROOM_M - place) / way).min(axis=1)
    range_m += np.random.default_rng(seed).normal(size=len(range_m)) * 0.01
    return Cloud(0, ray * range_m[:, None], time_s - start_s - 0.05)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (math.pi, 0.0, 0.0), (0.7, -0.3, 2.0)])
def test_odometry_in_any_mounting(vector: tuple[float, float, float]) -> None:
    mounting = exp_rotation(np.array([vector]))[0]
    odometry = Odometry()
    errors = []
    for window in range(WINDOWS):
        cloud = seen_in_room(0.1 * window, mounting, window)
        twist = odometry.add(cloud, window * NS, (window + 1) * NS)
        # The window two before, from the middle of the one before that.
        rotation, place = pose_at(np.array([window - 2.5, window - 1.5]) * 0.1)
        poses = [Pose(turn @ mounting, at) for turn, at in zip(rotation, place, strict=True)]
        errors.append(twist - poses[0].twist_to(poses[1]))
    known = np.array(errors)[np.isfinite(errors).all(axis=1)]
    assert len(known) >= WINDOWS - 10
    size = np.sqrt((known**2).mean(axis=0))
    assert size[:3].max() < 5e-3
    assert size[3:].max() < 2e-3
