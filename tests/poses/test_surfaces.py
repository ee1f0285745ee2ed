"""Planes in cells, and their distances, against geometry worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import exp_rotation
from mlbatch.poses.surfaces import Moments, distances, planes


def patch(rng: np.random.Generator, normal: F64Array, noise_m: float, count: int) -> F64Array:
    """Points around (0.5, 0.5, 0.5) on a plane, in the middle of a cell of 1 m."""
    across = np.linalg.svd(normal[None])[2][1:]
    flat = rng.uniform(-0.4, 0.4, (count, 2)) @ across
    found: F64Array = flat + 0.5 + noise_m * rng.standard_normal((count, 1)) * normal
    return found


def test_a_plane_has_the_normal_of_its_points_and_the_variance_of_their_mean() -> None:
    rng = np.random.default_rng(0)
    normal = np.array([1.0, 2.0, 2.0]) / 3.0
    tilt, offset, stated = [], [], []
    for _ in range(200):
        found = planes(patch(rng, normal, 0.02, 400), np.full(400, 0.5), 1.0)
        (at,) = np.flatnonzero(np.abs(found.normal @ normal) > 0.9)[:1]
        tilt.append(1 - abs(float(found.normal[at] @ normal)))
        offset.append(float((found.mean_m[at] - 0.5) @ normal))
        stated.append(float(found.noise[at]))
        assert found.time_s[at] == pytest.approx(0.5)
    assert max(tilt) < 1e-3
    # Noise by the root of the number of points, and the roughness that is always assumed.
    assert np.std(offset) == pytest.approx(0.02 / np.sqrt(400), rel=0.3)
    assert np.mean(stated) == pytest.approx(0.02**2 / 400 + 0.004**2, rel=0.1)


@pytest.mark.parametrize(
    ("points", "is_plane"),
    [
        ("plane", True),
        ("line", False),
        ("blob", False),
        ("few", False),
    ],
)
def test_only_flat_pieces_of_surfaces_are_planes(points: str, is_plane: bool) -> None:
    rng = np.random.default_rng(1)
    flat = patch(rng, np.array([0.0, 0.0, 1.0]), 0.005, 300)
    cloud = {
        "plane": flat,
        "line": flat * [1, 0, 1] + [0, 0.5, 0],
        "blob": rng.uniform(0.02, 0.98, (300, 3)),
        "few": flat[:5],
    }[points]
    assert bool(len(planes(cloud, np.zeros(len(cloud)), 1.0).key)) is is_plane


def test_moments_of_doubled_cells_are_those_of_the_points() -> None:
    rng = np.random.default_rng(2)
    points_m, time_s = rng.uniform(-20, 20, (5000, 3)), rng.random(5000)
    found = Moments.of_points(points_m, time_s, 0.5).doubled().doubled()
    wanted = Moments.of_points(points_m, time_s, 2.0)
    assert found.edge_m == 2.0
    assert (found.key == wanted.key).all()
    assert (found.count == wanted.count).all()
    np.testing.assert_allclose(found.total, wanted.total, atol=1e-9)


def test_distances_are_along_the_normal_from_the_first_to_the_second() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        turn = exp_rotation(rng.uniform(-0.2, 0.2, (1, 3)))[0]
        normal = turn @ [0.0, 0.0, 1.0]
        first = planes(patch(rng, normal, 0.002, 500), np.zeros(500), 1.0)
        shifted = patch(rng, normal, 0.002, 500) + 0.03 * normal + [0.05, -0.05, 0.0] @ turn.T
        second = planes(shifted, np.ones(500), 1.0)
        found = distances(first, second, 0.97, 0.1)
        assert len(found) == 1
        along = found.distance_m[0] * found.normal[0]
        np.testing.assert_allclose(along, 0.03 * normal, atol=2e-3)
        assert found.time_s[0].tolist() == pytest.approx([0.0, 1.0])


def test_planes_that_are_far_or_not_parallel_are_not_compared() -> None:
    rng = np.random.default_rng(4)
    up, aside = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.6, 0.8])
    first = planes(patch(rng, up, 0.002, 500), np.zeros(500), 1.0)
    tilted = planes(patch(rng, aside, 0.002, 500), np.zeros(500), 1.0)
    raised = planes(patch(rng, up, 0.002, 500) + 0.3 * up, np.zeros(500), 1.0)
    assert len(distances(first, tilted, 0.97, 0.2)) == 0
    assert len(distances(first, raised, 0.97, 0.2)) == 0
    assert len(distances(first, raised, 0.97, 0.4)) == 1
