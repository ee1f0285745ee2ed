"""Foliage against the Beer-Lambert law, and thin stems against the share of a beam they fill."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.simulate.foliage import Crowns
from mlbatch.simulate.lidar_stream import _spread
from mlbatch.simulate.rays import Rays
from mlbatch.simulate.scene import Rectangles, Scene, Stems

RAYS = 100_000


def crown(
    radius_m: float, half_m: float, per_m: float, *, wind_m: float = 0.0, flutters: bool = True
) -> Crowns:
    """A crown around the origin; the wind moves it along x, 0.25 Hz."""
    rows = (radius_m, half_m, per_m, wind_m, 0.25, 0.0, 60.0)
    columns = [np.array([value]) for value in rows]
    return Crowns(np.zeros((1, 3)), *columns, flutters=np.array([flutters]))


def along_x(count: int, y: float = 0.0, z: float = 0.0, time_s: float = 0.0) -> Rays:
    """Rays from x = -50 m."""
    return Rays.of(
        np.tile([-50.0, y, z], (count, 1)), np.tile([1.0, 0.0, 0.0], (count, 1)),
        np.full(count, time_s),
    )  # fmt: skip


def depths(scene: Scene, rays: Rays, seed: int = 1) -> F64Array:
    """Ways into a crown that reaches from x = -20 m to 20 m; inf for rays that pass."""
    return scene.cast(rays, 200.0, np.random.default_rng(seed))[0] - 30.0


def test_mean_free_path_and_share_that_passes() -> None:
    """The optical depth of 40 m is 8: 0.034 % pass, and the mean free path is 1 / k = 5 m."""
    found = depths(Scene((), foliage=crown(20, 20, 0.2)), along_x(RAYS))
    assert found[np.isfinite(found)].mean() == pytest.approx(5.0, rel=0.02)
    thin = depths(Scene((), foliage=crown(20, 20, 0.02)), along_x(RAYS))
    assert np.isinf(thin).mean() == pytest.approx(math.exp(-0.8), rel=0.02)
    # Of those that do not pass half have met a leaf before the median of the truncated law.
    median = -math.log(1.0 - 0.5 * (1.0 - math.exp(-0.8))) / 0.02
    assert (thin[np.isfinite(thin)] < median).mean() == pytest.approx(0.5, abs=0.01)


def test_the_way_through_an_ellipsoid() -> None:
    """At a height of 3 of 5 m the chord is 4/5 of the axis: 2 * 2 * 0.8 = 3.2 m."""
    scene = Scene((), foliage=crown(2, 5, 0.5))
    found = scene.cast(along_x(RAYS, z=3.0), 200.0, np.random.default_rng(1))[0]
    assert np.isinf(found).mean() == pytest.approx(math.exp(-0.5 * 3.2), rel=0.02)
    hit = found[np.isfinite(found)]
    assert hit.min() >= 50.0 - 1.6
    assert hit.max() <= 50.0 + 1.6


def test_crowns_that_overlap_add_their_extinction() -> None:
    one = crown(20, 20, 0.02)
    columns = (one.radius_m, one.half_height_m, one.extinction_per_m, one.wind_m, one.wind_hz)
    twice = [np.repeat(column, 2) for column in (*columns, one.wind_phase, one.reflectivity)]
    both = Crowns(np.zeros((2, 3)), *twice, flutters=np.array([True, True]))
    found = depths(Scene((), foliage=both), along_x(RAYS))
    assert np.isinf(found).mean() == pytest.approx(math.exp(-1.6), rel=0.02)


def test_leaves_hide_what_is_behind_them_in_shells_of_distance() -> None:
    """Walls at all distances: the share that reaches one is exp(-k times the way)."""
    places = np.array([-44.0, -38.0, -30.0, -15.0, 5.0, 40.0])
    count = len(places)
    columns = [np.full(count, value) for value in (2.0, 2.0, 0.1, 0.0, 0.0, 0.0, 60.0)]
    centre = np.column_stack([places, np.zeros(count), np.zeros(count)])
    foliage = Crowns(centre, *columns, flutters=np.full(count, True))
    wall = Rectangles(
        np.array([[45.0, -5.0, -5.0]]), np.array([[0.0, 10.0, 0.0]]), np.array([[0.0, 0.0, 10.0]]),
        np.array([9.0]),
    )  # fmt: skip
    found, level = Scene((wall,), foliage=foliage).cast(
        along_x(RAYS), 200.0, np.random.default_rng(3)
    )
    assert (level == 9.0).mean() == pytest.approx(math.exp(-0.1 * 4 * count), abs=0.004)
    assert (found[level == 9.0] == 95.0).all()
    for number, place in enumerate(places):
        inside = (found > place + 48.0) & (found < place + 52.0)
        reached = math.exp(-0.4 * number)
        assert inside.mean() == pytest.approx(reached * (1 - math.exp(-0.4)), abs=0.005)


def test_leaves_flutter_by_the_generator_or_rest() -> None:
    fluttering, resting = (
        Scene((), foliage=crown(20, 20, 0.2, flutters=flutters)) for flutters in (True, False)
    )
    first, again, other = (depths(fluttering, along_x(1000), seed) for seed in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any()
    rested = depths(resting, along_x(1000), 1)
    # The same leaf for the same ray; leaves of other rays are exponential as well.
    assert (rested == rested[0]).all()
    assert (rested == depths(resting, along_x(1000), 2)).all()
    grid = Rays.of(
        np.stack(np.meshgrid([-50.0], np.arange(-9, 9, 0.06), np.arange(-9, 9, 0.06)), -1)
        .reshape(-1, 3), np.tile([1.0, 0, 0], (90_000, 1)), np.zeros(90_000),
    )  # fmt: skip
    found = resting.cast(grid, 200.0)[0]
    enters = -np.sqrt(400.0 - (grid.origin_m[1:] ** 2).sum(axis=0)) + 50.0
    into = (found - enters)[np.isfinite(found)]
    assert into.mean() == pytest.approx(5.0, rel=0.03)


def test_wind_moves_a_crown() -> None:
    """After a quarter of 4 s the crown is 1 m further along x."""
    dense = Scene((), foliage=crown(2, 2, 1e6, wind_m=1.0))
    still, moved = (
        float(dense.cast(along_x(1, time_s=at), 200.0, np.random.default_rng(1))[0][0])
        for at in (0.0, 1.0)
    )
    assert (still, moved) == pytest.approx((48.0, 49.0), abs=1e-4)


def test_a_thin_stem_is_met_by_its_share_of_the_beam() -> None:
    """At 20 m the beam has a standard deviation of 20 m * 0.5 degrees / 2.355 = 74.1 mm.

    A stem of 50 mm on each side of the axis fills erf(50 / (74.1 sqrt 2)) of a Gaussian.
    """
    stem = Stems(np.array([[20.0, 0.0, -9.0]]), *(np.array([v]) for v in (18.0, 0.05, 0.05, 60.0)))
    rays = Rays.of(np.zeros((RAYS, 3)), np.tile([1.0, 0, 0], (RAYS, 1)), np.zeros(RAYS))
    _spread(rays, math.radians(0.5), np.random.default_rng(1))
    assert np.sqrt((rays.direction**2).sum(axis=0)) == pytest.approx(1.0, abs=1e-12)
    found = Scene((stem,)).cast(rays, 100.0)[0]
    sigma = 20 * math.radians(0.5) / 2.354820045
    assert np.isfinite(found).mean() == pytest.approx(
        math.erf(0.05 / sigma / math.sqrt(2)), abs=5e-3
    )
