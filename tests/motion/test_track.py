"""Interpolated poses, unknown ones, and the transforms of columns: hand-worked motions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.track import MAX_GAP_NS, PoseTrack
from mlbatch.types import instant_ns
from tests.reference.motion import column_motion

S = 1_000_000_000


def turns(yaw_rad: F64Array) -> F64Array:
    cosine, sine, nothing = np.cos(yaw_rad), np.sin(yaw_rad), np.zeros(len(yaw_rad))
    rows = [[cosine, -sine, nothing], [sine, cosine, nothing], [nothing, nothing, nothing + 1]]
    found: F64Array = np.array(rows).transpose(2, 0, 1)
    return found


def on_a_circle(time_s: F64Array) -> tuple[F64Array, F64Array]:
    """2 m around the origin, 1 rad/s, looking ahead: a constant twist."""
    place = np.column_stack([2 * np.cos(time_s), 2 * np.sin(time_s), 0 * time_s])
    return turns(time_s + math.pi / 2), place


def circle(time_s: F64Array) -> PoseTrack:
    return PoseTrack(np.rint(time_s * S).astype(np.int64), *on_a_circle(time_s), "circle")


def test_constant_twist_is_interpolated_exactly() -> None:
    track = circle(np.arange(0.0, 4.0, 0.4))
    times = np.linspace(0.0, 3.59, 500)
    stamps: I64Array = np.rint(times * S).astype(np.int64)
    poses = track.at(stamps)
    rotation, place = on_a_circle(stamps / S)
    assert poses.known.all()
    np.testing.assert_allclose(poses.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(poses.position_m, place, atol=1e-12)


def test_poses_outside_and_in_gaps_are_unknown() -> None:
    track = circle(np.array([1.0, 1.2, 1.2 + MAX_GAP_NS / S, 3.0, 3.1]))
    stamps = np.array([0.99, 1.0, 1.1, 1.5, 1.7, 2.0, 3.0, 3.05, 3.1, 3.11])
    found = track.at(np.rint(stamps * S).astype(np.int64))
    expected = [False, True, True, True, True, False, True, True, True, False]
    assert found.known.tolist() == expected
    np.testing.assert_array_equal(found.rotation[~found.known], [np.eye(3)] * 3)


def test_an_empty_track_knows_nothing() -> None:
    empty = PoseTrack(np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert not empty.at(np.array([5, 6])).known.any()


def test_columns_move_to_the_instant() -> None:
    """A fixed point of the world, seen from each pose, is at one place after the motion."""
    track = circle(np.arange(0.0, 2.0, 0.1))
    stamps: I64Array = np.arange(3 * S // 10, 4 * S // 10, S // 200)
    world = np.array([5.0, -1.0, 0.7])
    rotation, place = on_a_circle(stamps / S)
    seen = np.einsum("nji,nj->ni", rotation, world - place)
    motion = column_motion(track, stamps, 35 * S // 100)
    moved = np.einsum("nij,nj->ni", motion.rotation, seen) + motion.translation_m
    (turn,), (at,) = on_a_circle(np.array([0.35]))
    np.testing.assert_allclose(moved, [turn.T @ (world - at)] * len(stamps), atol=1e-12)
    # They were decimetres apart before.
    assert np.ptp(seen, axis=0).max() > 0.3
    assert not motion.no_pose.any()


def test_columns_without_a_pose_stay() -> None:
    track = circle(np.arange(0.0, 2.0, 0.1))
    stamps = np.array([-S, 0, S, 3 * S])
    motion = column_motion(track, stamps, S)
    assert motion.no_pose.tolist() == [True, False, False, True]
    np.testing.assert_array_equal(motion.rotation[[0, 3]], [np.eye(3)] * 2)
    np.testing.assert_array_equal(motion.translation_m[[0, 3]], np.zeros((2, 3)))
    np.testing.assert_allclose(motion.rotation[2], np.eye(3), atol=1e-12)
    assert column_motion(track, stamps, 5 * S).no_pose.all()


@pytest.mark.parametrize(("word", "expected"), [("start", 100), ("middle", 150), ("end", 201)])
def test_instants_of_a_window(word: str, expected: int) -> None:
    assert instant_ns(word, 100, 201) == expected
