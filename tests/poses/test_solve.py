"""Poses of lidars from clouds made by hand, with known errors; scenes that leave some open."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import exp_rotation, exp_transform, log_rotation
from mlbatch.poses.solve import (
    FINE,
    Known,
    Problem,
    Solution,
    State,
    better_start,
    find_poses,
    moved,
    solve,
)
from tests.poses.clouds import CORRIDOR, END, GROUND, ROOM, WALL, Face, Rig, motion

TWIST = np.array([1.2, 0.3, -0.1, 0.05, -0.04, 0.5])
FAR = motion((0.5, -0.6, 0.3), (7.0, -9.0, 14.0))
NEAR = motion((0.05, -0.04, 0.03), (0.5, -0.4, 0.6))
# A turn by 1 rad counts as much as a shift by this, m.
LEVER_M = 10.0
SEEDS = 4


def errors(rig: Rig, found: Solution) -> F64Array:
    """Of each lidar but the first: (lidars - 1, 6), m and rad."""
    rows = []
    for wrong, correction in zip(rig.wrong[1:], found.state.corrections[1:], strict=True):
        turn = correction.rotation @ wrong.rotation
        shift = correction.rotation @ wrong.position_m + correction.position_m
        rows.append(np.concatenate([shift, log_rotation(turn[None])[0]]))
    return np.array(rows)


def solved(rig: Rig, faces: tuple[Face, ...], seed: int, count: int = 9000) -> Solution:
    rng = np.random.default_rng(seed)
    sides = (faces,) * len(rig.wrong)
    return find_poses([rig.place(rng, sides, count) for _ in range(2)], len(rig.wrong))


@pytest.mark.parametrize("lidars", [2, 3])
def test_far_guesses_are_corrected_in_a_room(lidars: int) -> None:
    rig = Rig((ORIGIN, FAR, motion((-0.3, 0.2, -0.4), (-6, 8, -9)))[:lidars], TWIST)
    found = solved(rig, ROOM, 0)
    assert found.weak.shape == (6 * (lidars - 1), 0)
    error = errors(rig, found)
    assert np.abs(error[:, :3]).max() < 0.003
    assert np.abs(error[:, 3:]).max() < np.deg2rad(0.03)
    np.testing.assert_allclose(found.state.twists, [TWIST, TWIST], atol=0.05)
    assert set(found.matched) >= {(0, 0), (0, 1), (1, 1)}


def test_stated_deviations_cover_the_errors() -> None:
    rig = Rig((ORIGIN, NEAR), TWIST)
    inside = []
    for seed in range(12):
        found = solved(rig, ROOM, seed, 6000)
        assert found.weak.shape[1] == 0
        sigma = np.sqrt(np.diag(found.covariance))
        inside += list(np.abs(errors(rig, found).ravel()) <= 2 * sigma)
    assert np.mean(inside) >= 0.95


def span(*directions: tuple[float, ...]) -> F64Array:
    """Orthonormal columns (6, k), of shifts in m and turns by the lever."""
    columns: F64Array = np.linalg.qr(np.array(directions, float).T)[0]
    return columns


X, Y, Z = np.eye(6)[:3]
ROLL, PITCH, YAW = np.eye(6)[3:]


@pytest.mark.parametrize(
    ("faces", "open_directions"),
    [
        pytest.param(CORRIDOR, span(X), id="corridor"),
        pytest.param((GROUND,), span(X, Y, YAW), id="bare plane"),
        pytest.param((GROUND, WALL), span(X), id="ground and a wall"),
        pytest.param((GROUND, WALL, END), np.zeros((6, 0)), id="ground and two walls"),
    ],
)
def test_directions_that_the_scene_leaves_open_are_named(
    faces: tuple[Face, ...], open_directions: F64Array
) -> None:
    rig = Rig((ORIGIN, NEAR), TWIST)
    for seed in range(SEEDS):
        found = solved(rig, faces, seed)
        assert found.weak.shape == open_directions.shape
        # The same space: what is left of the one outside the other.
        outside = open_directions - found.weak @ (found.weak.T @ open_directions)
        assert np.abs(outside).max(initial=0.0) < 0.1
        # What is determined is right, and stated as known; what is open as not known.
        units = np.array([1.0] * 3 + [1 / LEVER_M] * 3)
        error = (errors(rig, found)[0] / units) @ _rest(found.weak)
        assert np.abs(error).max() < 0.01
        spread = found.covariance / units[:, None] / units
        for direction in open_directions.T:
            assert direction @ spread @ direction > 0.5


def _rest(weak: F64Array) -> F64Array:
    """Directions (6, k) across the weak ones."""
    if not weak.shape[1]:
        return np.eye(6)
    rest: F64Array = np.linalg.svd(weak)[0][:, weak.shape[1] :]
    return rest


def test_lidars_that_see_nothing_in_common_leave_all_open() -> None:
    left: tuple[Face, ...] = (
        ((-9, 3, 0), (18, 0, 0), (0, 0, 3)),
        ((-9, 3, 0), (18, 0, 0), (0, 5, 0)),
    )
    right: tuple[Face, ...] = (((-9, -3, 0), (18, 0, 0), (0, 0, 3)),)
    rig = Rig((ORIGIN, NEAR), TWIST)
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        found = find_poses([rig.place(rng, (left, right), 6000)], 2)
        assert found.weak.shape == (6, 6)
        assert (0, 1) not in found.matched
        assert np.diag(found.covariance)[:3].min() > 0.5


def test_a_search_that_ends_badly_begins_elsewhere() -> None:
    """A guess beyond 20 degrees, from which a search finds the floor of a room alone."""
    rig = Rig((ORIGIN, motion((-0.72, -0.62, -0.31), (12, -16, 24))), TWIST)
    rng = np.random.default_rng(3)
    places = [rig.place(rng, (ROOM, ROOM), 9000) for _ in range(2)]
    ended = find_poses(places, 2)
    assert ended.weak.shape == (6, 3)
    better = better_start(places, ended.state)
    assert better is not None
    found = find_poses(places, 2, guess=better)
    assert found.weak.shape == (6, 0)
    assert np.abs(errors(rig, found)[0, :3]).max() < 0.003
    assert better_start(places, found.state) is None


@pytest.mark.parametrize("faces", [CORRIDOR, (GROUND,)])
def test_no_start_determines_what_the_scene_leaves_open(faces: tuple[Face, ...]) -> None:
    rig = Rig((ORIGIN, motion((-0.72, -0.62, -0.31), (12, -16, 3))), TWIST)
    rng = np.random.default_rng(4)
    places = [rig.place(rng, (faces, faces), 9000) for _ in range(2)]
    better = better_start(places, State.start(2, 2))
    assert find_poses(places, 2, guess=better).weak.shape[1] > 0


@pytest.mark.parametrize(("sigma_m", "is_enough"), [(0.002, True), (0.02, False)])
def test_what_is_known_without_surfaces_closes_what_they_leave_open(
    sigma_m: float, is_enough: bool
) -> None:
    """On a bare plane x, y and yaw, as motion on flat ground says; the plane fixes the rest."""
    rig = Rig((ORIGIN, NEAR), TWIST)
    rng = np.random.default_rng(7)
    sigma = np.array([sigma_m, sigma_m, np.inf, np.inf, np.inf, sigma_m / LEVER_M, np.inf])
    drawn = np.where(np.isfinite(sigma[:6]), sigma[:6], [0, 0, 0.3, 0.002, 0.002, 0])
    drawn *= rng.normal(size=6)
    turn = exp_rotation(drawn[None, 3:])[0] @ NEAR.rotation.T
    stated = Pose(turn, drawn[:3] - turn @ NEAR.position_m)
    known = Known(State([ORIGIN, stated], np.zeros((0, 6)), np.zeros(2)), [np.diag(sigma**-2.0)])
    places = [rig.place(rng, ((GROUND,),) * 2, 9000) for _ in range(2)]
    found = find_poses(places, 2, known=known)
    if not is_enough:
        assert found.weak.shape[1] > 0
        return
    assert found.weak.shape == (6, 0)
    deviation = np.sqrt(np.diag(found.covariance))
    error = errors(rig, found)[0]
    assert (np.abs(error) < 4 * deviation).all()
    assert deviation[[0, 1]] == pytest.approx(np.hypot(sigma_m, 0.001), rel=0.3)
    assert np.abs(error[[2, 3, 4]] / [1, 1 / LEVER_M, 1 / LEVER_M]).max() < 0.003


def test_without_points_all_is_open() -> None:
    rig = Rig((ORIGIN, ORIGIN), np.zeros(6))
    found = find_poses([rig.place(np.random.default_rng(0), (ROOM, ROOM), 0)], 2)
    assert found.weak.shape == (6, 6)
    assert found.matched == {}


def test_delays_are_found_where_the_rig_turns() -> None:
    rig = Rig((ORIGIN, NEAR), np.array([1.0, 0.2, 0.0, 0.1, -0.1, 0.9]), (0.0, 0.012))
    for seed in range(2):
        rng = np.random.default_rng(seed)
        turned = Rig(rig.wrong, -rig.twist, rig.late_s)
        places = [one.place(rng, (ROOM, ROOM), 9000) for one in (rig, turned)]
        found = find_poses(places, 2, delays=True)
        assert found.weak.shape == (7, 0)
        assert found.state.delay_s[1] == pytest.approx(0.012, abs=2e-3)
        assert np.abs(errors(rig, found)[0, :3]).max() < 0.004


def test_a_delay_is_open_at_standstill() -> None:
    rig = Rig((ORIGIN, NEAR), np.zeros(6), (0.0, 0.012))
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        found = find_poses([rig.place(rng, (ROOM, ROOM), 9000) for _ in range(2)], 2, delays=True)
        assert found.weak.shape == (7, 1)
        assert abs(found.weak[6, 0]) > 0.99


def test_a_guess_is_where_the_search_begins() -> None:
    rig = Rig((ORIGIN, FAR), TWIST)
    rng = np.random.default_rng(5)
    places = [rig.place(rng, (ROOM, ROOM), 20_000)]
    back = Pose(FAR.rotation.T, -FAR.rotation.T @ FAR.position_m)
    begin = State([ORIGIN, back], np.zeros((1, 6)), np.zeros(2))
    found = solve(Problem(places, 2), begin, FINE)
    assert np.abs(errors(rig, found)[0, :3]).max() < 0.006


def test_points_move_as_the_exponential_of_the_twist() -> None:
    rng = np.random.default_rng(6)
    points_m, time_s = rng.uniform(-50, 50, (200, 3)), rng.uniform(-0.2, 0.2, 200)
    twist = np.array([20.0, -3.0, 1.0, 0.4, -0.3, 1.4])
    rotation, shift = exp_transform(time_s[:, None] * twist[:3], time_s[:, None] * twist[3:])
    wanted = np.einsum("nij,nj->ni", rotation, points_m) + shift
    np.testing.assert_allclose(moved(points_m, time_s, twist), wanted, atol=1e-4)
    assert moved(points_m, time_s, np.zeros(6)) is points_m
