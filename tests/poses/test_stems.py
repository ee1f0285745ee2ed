"""Axes of stems against cylinders of known axes and radii."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import exp_rotation
from mlbatch.poses.stems import Stems, stem_distances, stems
from tests.poses.clouds import faces_points, stem_points

FEET_M = np.array(
    [[6, 0, 0], [4, 5, 0.2], [-3, 7, 0], [-8, 1, -0.2], [-5, -6, 0], [2, -7, 0], [9, -4, 0.1]]
)
# Cells of a layer, m; a stem through several layers is found in each.
LAYERS = 3


def forest(rng: np.random.Generator, origin_m: F64Array, radius_m: float) -> F64Array:
    """Points of all stems as seen from an origin, and of the ground."""
    parts = [stem_points(rng, foot_m, radius_m, origin_m, 320) for foot_m in FEET_M]
    ground = faces_points(rng, (((-10, -10, -0.6), (20, 0, 0), (0, 20, 0)),), 4000)
    cloud = np.concatenate([*parts, ground])
    return cloud + 0.01 * rng.standard_normal(cloud.shape)


def misses(found: Stems, turn: F64Array) -> F64Array:
    """Distances (k, 2) of axes from those of the nearest stems, level."""
    upright = found.axis_m @ turn
    apart = upright[:, None, :2] - FEET_M[None, :, :2]
    nearest = np.argmin(np.linalg.norm(apart, axis=2), axis=1)
    missed: F64Array = apart[np.arange(len(upright)), nearest]
    return missed


def test_the_mean_of_the_side_that_is_seen_lies_pi_by_4_radii_before_the_axis() -> None:
    rng = np.random.default_rng(0)
    seen = stem_points(rng, np.array([10.0, 0.0, 0.0]), 0.2, np.zeros(3), 100_000)
    # Of the half circle: the mean of sqrt(1 - u2) over u from -1 to 1 is pi / 4, of u2 1 / 3.
    assert 10.0 - seen[:, 0].mean() == pytest.approx(np.pi / 4 * 0.2, abs=5e-4)
    assert seen[:, 1].var() == pytest.approx(0.2**2 / 3, rel=0.02)


@pytest.mark.parametrize("radius_m", [0.08, 0.15, 0.3])
@pytest.mark.parametrize("tilt_deg", [0.0, 12.0])
def test_axes_and_radii_are_found_from_one_side(radius_m: float, tilt_deg: float) -> None:
    rng = np.random.default_rng(1)
    origin_m = np.array([0.5, -0.5, 2.0])
    turn = exp_rotation(np.deg2rad([[tilt_deg, -tilt_deg / 2, 0.0]]))[0]
    cloud = forest(rng, origin_m, radius_m) @ turn.T
    found = stems(cloud, np.zeros(len(cloud)), turn @ origin_m)
    assert len(found) >= LAYERS * len(FEET_M) - 4
    assert found.along @ turn[:, 2] > np.cos(np.deg2rad(1.0))
    missed = misses(found, turn)
    # Means of 80 points at random across the width, and the radius from their variance.
    assert np.median(np.abs(missed)) < 0.01 + 0.03 * radius_m
    # An error of the model would move all axes to or from the lidar.
    view = (found.axis_m @ turn - origin_m)[:, :2]
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    assert abs(np.mean((missed * view).sum(axis=1))) < 0.004 + 0.03 * radius_m
    assert np.median(found.radius_m) == pytest.approx(radius_m, rel=0.12)


def test_walls_plants_and_ground_are_no_stems() -> None:
    rng = np.random.default_rng(2)
    wall = faces_points(rng, (((6, -6, 0), (0, 12, 0), (0, 0, 4)),), 20_000)
    bush_m = FEET_M + np.array([-2.0, 0.0, 1.0])
    bushes = (bush_m[:, None] + rng.normal(0, 0.15, (len(FEET_M), 300, 3))).reshape(-1, 3)
    cloud = np.concatenate([wall, bushes])
    assert len(stems(cloud, np.zeros(len(cloud)), np.zeros(3))) == 0


def test_two_lidars_on_different_sides_agree_on_the_axes() -> None:
    rng = np.random.default_rng(3)
    shift_m = np.array([0.08, -0.05, 0.0])
    first, second = np.array([0.0, 3.0, 2.0]), np.array([0.0, -3.0, 2.0])
    seen = [forest(rng, origin_m, 0.2) for origin_m in (first, second)]
    seen[1] = seen[1] + shift_m
    one, other = (
        stems(cloud, np.full(len(cloud), when), origin_m)
        for cloud, when, origin_m in zip(seen, (0.0, 0.1), (first, second), strict=True)
    )
    found = stem_distances(one, other, 0.97, 0.3)
    assert found is not None
    assert len(found) >= 2 * LAYERS * len(FEET_M) - 8
    wanted = found.normal @ shift_m
    assert np.median(np.abs(found.distance_m - wanted)) < 0.016
    assert abs(np.median(found.distance_m - wanted)) < 0.004
    assert found.time_s.mean(axis=0).tolist() == pytest.approx([0.0, 0.1])


def test_without_points_there_are_no_stems() -> None:
    nothing = stems(np.zeros((0, 3)), np.zeros(0), np.zeros(3))
    assert len(nothing) == 0
    assert len(stem_distances(nothing, nothing, 0.97, 1.0)) == 0
