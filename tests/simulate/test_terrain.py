"""Rays against the height field, by short steps, and by planes worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.simulate.terrain import Terrain, rough_terrain

# A plane that rises by 1 in 4 toward x.
PLACE = np.linspace(-8.0, 8.0, 17)
SLOPE = Terrain(np.repeat(PLACE[:, None] / 4, 17, axis=1), 1.0, 8.0)


def cast(
    terrain: Terrain, origin: F64Array, direction: F64Array, limit_m: float = 200.0
) -> F64Array:
    count = len(direction)
    origins = np.broadcast_to(origin, (count, 3)).T
    return terrain.cast(origins, direction.T, np.full(count, limit_m))


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        pytest.param((0, 0, 3), (0, 0, -1), 3.0, id="down"),
        pytest.param((4, 1, 3), (0, 0, -1), 2.0, id="down on the slope"),
        # z = 1 reaches the plane where x / 4 = 1.
        pytest.param((0, 0.3, 1), (1, 0, 0), 4.0, id="level"),
        pytest.param((0, 0, 1), (-1, 0, 0), math.inf, id="level, away from the slope"),
        pytest.param((0, 0, 1), (0, 0, 1), math.inf, id="up"),
        pytest.param((20, 0, 3), (0, 0, -1), math.inf, id="outside"),
        # From outside: down by 1 in 8 from x = 16, z = 3.5, and x / 4 = 3.5 - (16 - x) / 8 at 12,
        # where the grid has ended; at its edge, x = 8, the ray is at 2.5, then above.
        pytest.param((16, 0, 3.5), (-8, 0, -1), math.inf, id="from outside, above"),
        # x / 4 = 2 - (16 - x) / 8 at 0.
        pytest.param((16, 0, 2), (-8, 0, -1), 8 * math.hypot(1, 1 / 8), id="edge from below"),
    ],
)
def test_ray_meets_the_plane(
    origin: tuple[float, ...], direction: tuple[float, ...], expected: float
) -> None:
    ray = np.array([direction]) / math.hypot(*direction)
    assert cast(SLOPE, np.array(origin), ray)[0] == pytest.approx(expected, abs=1e-6)


def test_height_is_bilinear_within_a_cell() -> None:
    terrain = Terrain(np.array([[0.0, 1.0], [2.0, 5.0]]), 2.0, 1.0)
    places = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [0.0, 0.0], [0.0, -1.0]])
    # In the middle the mean of all four corners.
    np.testing.assert_allclose(terrain.height(places), [0, 1, 2, 2, 1], atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_first_crossing_is_found(seed: int) -> None:
    """No point of a ray before its hit is below the ground, and the hit is on it."""
    terrain = rough_terrain(seed, 40.0, 1.0, 1.5, 9.0)
    random = np.random.default_rng(seed)
    azimuth = random.uniform(-math.pi, math.pi, 3000)
    # Mostly grazing.
    climb = random.uniform(-0.25, 0.03, 3000)
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), climb], axis=1)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    origin = np.array([1.3, -2.7, terrain.height(np.array([[1.3, -2.7]]))[0] + 1.4])
    found = cast(terrain, origin, direction, 60.0)
    hit = np.isfinite(found)
    assert 0.5 < hit.mean() < 1.0
    points = origin + found[hit, None] * direction[hit]
    assert np.abs(points[:, 2] - terrain.height(points[:, :2])).max() < 1e-6
    share = np.linspace(0.0, 1.0, 1500)[:-1]
    reach = np.where(hit, found, 37.0)
    along = origin + (share[:, None] * reach)[..., None] * direction
    above = along[..., 2] - terrain.height(along.reshape(-1, 3)[:, :2]).reshape(along.shape[:2])
    assert above[:, hit].min() > -1e-6
    # Rays without a hit within the grid stay above it.
    inside = np.abs(along[..., :2]).max(axis=-1) < 40.0
    assert np.where(inside, above, 1.0)[:, ~hit].min() > 0.0


def test_relief_is_bounded_and_depends_on_the_seed() -> None:
    first = rough_terrain(1, 20.0, 1.0, 0.7, 9.0)
    assert -0.7 <= first.low_m < -0.1
    assert 0.1 < first.high_m <= 0.7
    places = np.random.default_rng(0).uniform(-20, 20, (50, 2))
    assert (first.height(places) == rough_terrain(1, 20.0, 1.0, 0.7, 9.0).height(places)).all()
    assert (first.height(places) != rough_terrain(2, 20.0, 1.0, 0.7, 9.0).height(places)).all()
