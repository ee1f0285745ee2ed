"""Random trees and shrubs of a forest, clear of the way of the body: stems and crowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.simulate.terrain import Terrain

_M2_PER_HECTARE = 10_000.0
# Stems begin a little below the ground, which slopes.
_BURIED_M = 0.5
_LEAST_CROWN_M = 0.1


@dataclass(frozen=True, slots=True)
class CrownPlan:
    """Crowns of one kind, each value from a range; low_m: height of the lower end.

    wind_m, wind_hz: amplitude and frequency of the sway.
    """

    low_m: tuple[float, float]
    radius_m: tuple[float, float]
    extinction_per_m: tuple[float, float]
    wind_m: tuple[float, float]
    wind_hz: tuple[float, float]
    flutters: bool
    reflectivity: float


@dataclass(frozen=True, slots=True)
class Forest:
    """Plants of one kind; area_m: x0, y0, x1, y1; taper: radius at the top over that at the base.

    radius_m: of stems, None for shrubs; clearance_m: from the way of the body to the bark, or to
    the middle of a shrub.
    """

    area_m: tuple[float, float, float, float]
    per_hectare: float
    radius_m: tuple[float, float] | None
    height_m: tuple[float, float]
    taper: float
    clearance_m: float
    reflectivity: float
    crown: CrownPlan | None


Row: TypeAlias = tuple[object, ...]


def grown(
    forest: Forest, seed: Sequence[int], way_m: F64Array, terrain: Terrain | None
) -> tuple[list[Row], list[Row]]:
    """Return the values of Stems and of Crowns, one row per plant; way_m: (n, 3)."""
    x0, y0, x1, y1 = forest.area_m
    random = np.random.default_rng(seed)
    count = round(forest.per_hectare * (x1 - x0) * (y1 - y0) / _M2_PER_HECTARE)
    place = random.uniform((x0, y0), (x1, y1), (count, 2))
    radius = random.uniform(*(forest.radius_m or (0.0, 0.0)), count)
    height = random.uniform(*forest.height_m, count)
    ground = np.zeros(count) if terrain is None else terrain.height(place)
    crowns = [] if forest.crown is None else _crowns(forest.crown, random, height)
    stems: list[Row] = []
    leaves: list[Row] = []
    for row, (x, y) in enumerate(place):
        if np.hypot(*(way_m[:, :2] - place[row]).T).min() < radius[row] + forest.clearance_m:
            continue
        if forest.radius_m is not None:
            base = (x, y, ground[row] - _BURIED_M)
            top = radius[row] * forest.taper
            stems.append((base, height[row] + _BURIED_M, radius[row], top, forest.reflectivity))
        if crowns:
            middle_m, *values = crowns[row]
            leaves.append(((x, y, ground[row] + middle_m), *values))
    return stems, leaves


def _crowns(
    plan: CrownPlan, random: np.random.Generator, height_m: F64Array
) -> list[tuple[float, ...]]:
    """Return the values of Crowns for plants; instead of centres, heights above the ground."""
    count = len(height_m)
    ranges = (plan.low_m, plan.radius_m, plan.extinction_per_m, plan.wind_m, plan.wind_hz)
    low, radius, extinction, wind, hz = (random.uniform(*one, count) for one in ranges)
    phase = random.uniform(0.0, 2.0 * np.pi, count)
    half = 0.5 * np.maximum(height_m - low, _LEAST_CROWN_M)
    flutters = np.full(count, plan.flutters)
    level = np.full(count, plan.reflectivity)
    return list(
        zip(low + half, radius, half, extinction, wind, hz, phase, level, flutters, strict=True)
    )
