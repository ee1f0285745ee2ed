"""Poses from motion: exact twists, motions that determine less, and simulated recordings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.registration import Pose
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.from_motion import MotionPose, poses_of_twists

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
    return twists + np.diff(draw, axis=0) * np.array([SIGMA_M] * 3 + [SIGMA_RAD] * 3)


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
    # Chi-squared of 120 degrees of freedom: 0.01 % lie outside.
    assert 70.0 < sum(squares) < 185.0


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
