"""Random stems of a forest: places, radii and heights, clear of the way of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.terrain import Terrain

_M2_PER_HECTARE = 10_000.0
# Stems begin a little below the ground, which slopes.
_BURIED_M = 0.5


@dataclass(frozen=True, slots=True)
class Forest:
    """Stems of one kind; area_m: x0, y0, x1, y1; taper: radius at the top over that at the base.

    clearance_m: from the way of the body to the bark.
    """

    area_m: tuple[float, float, float, float]
    per_hectare: float
    radius_m: tuple[float, float]
    height_m: tuple[float, float]
    taper: float
    clearance_m: float
    reflectivity: float


def grown(
    forest: Forest, seed: Sequence[int], way_m: F64Array, terrain: Terrain | None
) -> list[tuple[object, ...]]:
    """Return (base, height, radius, top radius, reflectivity) of stems; way_m: (n, 3)."""
    x0, y0, x1, y1 = forest.area_m
    random = np.random.default_rng(seed)
    count = round(forest.per_hectare * (x1 - x0) * (y1 - y0) / _M2_PER_HECTARE)
    place = random.uniform((x0, y0), (x1, y1), (count, 2))
    radius = random.uniform(*forest.radius_m, count)
    height = random.uniform(*forest.height_m, count)
    ground = np.zeros(count) if terrain is None else terrain.height(place)
    rows: list[tuple[object, ...]] = []
    for row in range(count):
        away = np.hypot(*(way_m[:, :2] - place[row]).T).min()
        if away >= radius[row] + forest.clearance_m:
            base = (place[row, 0], place[row, 1], ground[row] - _BURIED_M)
            top = radius[row] * forest.taper
            rows.append((base, height[row] + _BURIED_M, radius[row], top, forest.reflectivity))
    return rows
