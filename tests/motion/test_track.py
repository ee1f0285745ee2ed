"""Interpolated poses, unknown ones, transforms of columns: by hand, and equal to the literal."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.se3 import exp_rotation
from mlbatch.motion.track import MAX_GAP_NS, PoseLine, PoseTrack
from mlbatch.types import instant_ns
from tests.reference.motion import column_moves

S = 1_000_000_000
MS = 1_000_000


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
    poses = np.array([track.at(stamp) for stamp in stamps.tolist()])
    rotation, place = on_a_circle(stamps / S)
    np.testing.assert_allclose(poses[:, :3, :3], rotation, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, 3], place, atol=1e-12)


def test_columns_move_to_the_instant() -> None:
    """A fixed point of the world, seen from each pose, is at one place after the motion."""
    track = circle(np.arange(0.0, 2.0, 0.1))
    stamps: I64Array = np.arange(3 * S // 10, 4 * S // 10, S // 200)
    world = np.array([5.0, -1.0, 0.7])
    rotation, place = on_a_circle(stamps / S)
    seen = np.einsum("nji,nj->ni", rotation, world - place)
    moves = column_moves(track, stamps, 35 * S // 100)
    moved = np.einsum("nij,nj->ni", moves[:, :, :3], seen) + moves[:, :, 3]
    (turn,), (at,) = on_a_circle(np.array([0.35]))
    np.testing.assert_allclose(moved, [turn.T @ (world - at)] * len(stamps), atol=1e-12)
    # They were decimetres apart before.
    assert np.ptp(seen, axis=0).max() > 0.3


@pytest.mark.parametrize(("word", "expected"), [("start", 100), ("middle", 150), ("end", 201)])
def test_instants_of_a_window(word: str, expected: int) -> None:
    assert instant_ns(word, 100, 201) == expected


# -- transforms of columns ----------------------------------------------------------------------


def wild(seed: int, count: int, gap_ns: int, turn: float) -> PoseTrack:
    """Poses with random turns and steps."""
    draw = np.random.default_rng(seed)
    stamps = np.cumsum(draw.integers(1, gap_ns, count))
    return PoseTrack(
        stamps, exp_rotation(draw.normal(0, turn, (count, 3))), draw.normal(0, 3, (count, 3))
    )


@given(st.integers(0, 10**6), st.sampled_from([0.0, 1e-6, 1e-3, 0.4]), st.integers(3, 40))
def test_equal_to_interpolated_poses(seed: int, turn: float, count: int) -> None:
    track = wild(seed, count, MAX_GAP_NS // 4, turn)
    draw = np.random.default_rng(seed + 1)
    low, high = int(track.stamp_ns[0]), int(track.stamp_ns[-1])
    # Some columns are exactly at a pose.
    inside = np.concatenate([draw.integers(low, high + 1, 50), draw.choice(track.stamp_ns, 5)])
    stamps: I64Array = np.sort(inside)
    to_ns = int(draw.integers(low, high + 1))
    line = PoseLine(track)
    assert line.has_poses(stamps, to_ns)
    moves = line.moves(stamps, to_ns)
    assert moves is not None
    expected = column_moves(track, stamps, to_ns)
    np.testing.assert_allclose(moves[:, :, :3], expected[:, :, :3], atol=1e-6)
    np.testing.assert_allclose(moves[:, :, 3], expected[:, :, 3], atol=1e-5)


def test_a_drive_along_x_by_hand() -> None:
    """10 m/s: a column 30 ms after the instant is 0.3 m ahead."""
    track = PoseTrack(
        np.array([0, S // 10]), np.array([np.eye(3)] * 2), np.diag([1.0, 0, 0])[:2, :] * 0
    )
    track.position_m[1] = [1.0, 0, 0]
    moves = PoseLine(track).moves(np.array([0, 30 * MS, 100 * MS]), 0)
    assert moves is not None
    np.testing.assert_allclose(moves[:, 0, 3], [0.0, 0.3, 1.0], atol=1e-7)
    assert not moves[:, 1:, 3].any()
    back = PoseLine(track).moves(np.array([0, 30 * MS, 100 * MS]), S // 10)
    assert back is not None
    np.testing.assert_allclose(back[:, 0, 3], [-1.0, -0.7, 0.0], atol=1e-7)


def test_a_turn_to_the_left_by_hand() -> None:
    """A quarter of a turn in 0.1 s: what is ahead at its end was to the left at its start."""
    track = PoseTrack(
        np.array([0, S // 10]),
        exp_rotation(np.array([[0, 0, 0], [0, 0, np.pi / 2]])),
        np.zeros((2, 3)),
    )
    moves = PoseLine(track).moves(np.array([S // 10]), 0)
    assert moves is not None
    np.testing.assert_allclose(moves[0, :, :3] @ [5, 0, 0], [0, 5, 0], atol=1e-6)


def test_a_body_at_rest_moves_nothing() -> None:
    rest = exp_rotation(np.array([[0.3, -0.2, 1.0]]))
    track = PoseTrack(
        np.arange(5) * S // 10, np.repeat(rest, 5, axis=0), np.full((5, 3), 1234.5678)
    )
    assert PoseLine(track).moves(np.arange(10) * S // 50, S // 10) is None


@pytest.mark.parametrize(
    ("stamps", "to_ns", "has_poses"),
    [
        ([0, 10], 10, True),
        ([-1, 10], 10, False),
        ([0, 10], -1, False),
        ([0, S + MAX_GAP_NS + 1], 0, True),
        # Inside of a gap that is too long.
        ([0, S + 1], 0, False),
        ([0, 10], S + 5, False),
        ([0, S + MAX_GAP_NS + 2], 0, False),
    ],
)
def test_where_poses_are_unknown(stamps: list[int], to_ns: int, has_poses: bool) -> None:
    known = np.array([0, S // 2, S, S + MAX_GAP_NS + 1])
    track = PoseTrack(known, np.array([np.eye(3)] * 4), np.zeros((4, 3)))
    assert PoseLine(track).has_poses(np.array(stamps), to_ns) == has_poses
    empty = PoseTrack(known[:0], np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert not PoseLine(empty).has_poses(np.array(stamps), to_ns)


def test_a_track_that_grows_has_the_same_poses() -> None:
    track = wild(7, 60, 40 * MS, 0.3)
    stamps = np.linspace(track.stamp_ns[30], track.stamp_ns[40], 99).astype(np.int64)
    to_ns = int(track.stamp_ns[35]) + 5
    whole = PoseLine(track).moves(stamps, to_ns)
    line = PoseLine(PoseTrack(track.stamp_ns[:7], track.rotation[:7], track.position_m[:7]))
    for at in range(7, 60, 11):
        own = slice(at, at + 11)
        part = PoseTrack(track.stamp_ns[own], track.rotation[own], track.position_m[own])
        line.extend(part, int(stamps[0]))
    assert line.poses == 60
    assert line.newest_ns == int(track.stamp_ns[-1])
    grown = line.moves(stamps, to_ns)
    assert whole is not None
    np.testing.assert_array_equal(grown, whole)
