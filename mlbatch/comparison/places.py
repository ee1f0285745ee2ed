"""Where two clouds of one instant differ: times of lidars by place, points that only one has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array
from mlbatch.page.instant import RADIUS_M, Spot
from mlbatch.page.points import CloudPoints
from mlbatch.units import NS_PER_MS

# Sides of the cells whose times are compared, and of those that find neighbours.
_CELL_M = 2.0
_NEAR_M = 0.3
# Distances of the cells: nearer ones are seen over a long time, farther ones by few points.
_NEAREST_M, _FARTHEST_M = 3.0, 40.0
# Above the lowest point of a cell: what is lower is ground, whose rings move as the body nods.
_GROUND_M = 0.3
# Of a lidar in a cell.
_LEAST_POINTS = 8
# A cell that a lidar saw over more of a period contains the seam of two revolutions.
_SEAM = 0.25
# Of the time between lidars that a fused set has more than the window.
_LEAST_GAIN_NS = 5_000_000
# Points without a neighbour in a cell, and their share, that make it a difference.
_LEAST_UNMATCHED, _LEAST_SHARE = 20, 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """Time between the lidars in cells, ascending; lidars: number that see each."""

    cell: I64Array
    apart_ns: F64Array
    lidars: I64Array

    def shared_ms(self) -> tuple[float, float] | None:
        """Median and largest time, ms, of the cells that two lidars see; None without."""
        shared = self.apart_ns[self.lidars > 1] / NS_PER_MS
        return (float(np.median(shared)), float(shared.max())) if len(shared) else None


def cells(points: CloudPoints) -> I64Array:
    """Number of the cell of each point, -1 out of reach, (n,)."""
    away_m = np.hypot(points.xyz[:, 0], points.xyz[:, 1])
    x, y = np.floor((points.xyz[:, :2] + _FARTHEST_M) / _CELL_M).astype(np.int64).T
    inside = (away_m >= _NEAREST_M) & (away_m < _FARTHEST_M)
    return np.where(inside, x * round(2 * _FARTHEST_M / _CELL_M) + y, -1)


def apart(points: CloudPoints, cell: I64Array, period_ns: int) -> Apart:
    """Compare the mean times of the lidars in each cell, but for those with a seam."""
    rows = np.flatnonzero(cell >= 0)
    key = cell[rows] * 256 + points.lidar[rows]
    order = np.argsort(key, kind="stable")
    key, time_ns = key[order], points.time_ns[rows][order]
    edges = np.flatnonzero(np.diff(key, prepend=-1))
    count = np.diff(np.append(edges, len(key)))
    kept = count >= _LEAST_POINTS
    low, high, total = (
        ufunc.reduceat(time_ns, edges)[kept] if len(edges) else time_ns
        for ufunc in (np.minimum, np.maximum, np.add)
    )
    whole, mean = key[edges][kept] // 256, total / count[kept]
    is_clear = ~np.isin(whole, whole[high - low > _SEAM * period_ns])
    whole, mean = whole[is_clear], mean[is_clear]
    number, lidars = np.unique(whole, return_counts=True)
    begin = np.cumsum(lidars) - lidars
    if not len(begin):
        return Apart(number, mean, lidars)
    apart_ns: F64Array = np.maximum.reduceat(mean, begin) - np.minimum.reduceat(mean, begin)
    return Apart(number, apart_ns, lidars)


def difference(fused: CloudPoints, window: CloudPoints, period_ns: int) -> Spot | None:
    """The largest difference; None where the times of lidars are as near in the fused set."""
    mine, theirs = cells(fused), cells(window)
    one, two = apart(fused, mine, period_ns), apart(window, theirs, period_ns)
    both, first, second = np.intersect1d(one.cell, two.cell, return_indices=True)
    gain_ns = one.apart_ns[first] - two.apart_ns[second]
    kept = (one.lidars[first] > 1) & (gain_ns >= _LEAST_GAIN_NS)
    both, gain_ns = both[kept], gain_ns[kept]
    if not len(both):
        return None
    inside = np.flatnonzero(np.isin(mine, both))
    xyz, cell = fused.xyz[inside], np.searchsorted(both, mine[inside])
    low_m = np.full(len(both), np.inf)
    np.minimum.at(low_m, cell, xyz[:, 2])
    above = xyz[:, 2] > low_m[cell] + _GROUND_M
    lone = above.copy()
    lone[above] = _without_neighbour(xyz[above], window.xyz[np.isin(theirs, both)])
    points, unmatched = (np.bincount(cell[rows], minlength=len(both)) for rows in (above, lone))
    moved = (unmatched >= _LEAST_UNMATCHED) & (unmatched >= _LEAST_SHARE * points)
    if moved.any():
        best = int(np.where(moved, unmatched * gain_ns, 0).argmax())
        rows, counts = lone & (cell == best), (int(unmatched[best]), int(points[best]))
    else:
        # Of the cells that differ most the one with the most points.
        worst = gain_ns >= gain_ns.max() - _LEAST_GAIN_NS
        best = int(np.where(worst, np.bincount(cell, minlength=len(both)), 0).argmax())
        rows, counts = cell == best, (0, 0)
    x, y, z = xyz[rows].mean(axis=0, dtype=np.float64).tolist()
    return Spot((x, y, z), float(gain_ns[best]), *counts)


def spot_apart_ms(points: CloudPoints, spot: Spot) -> float | None:
    """Time between the mean times of the lidars around a spot, ms; None for fewer than two."""
    x, y, _ = spot.centre_m
    near = points.take(np.hypot(points.xyz[:, 0] - x, points.xyz[:, 1] - y) < RADIUS_M)
    lidars, count = np.unique(near.lidar, return_counts=True)
    means = [near.time_ns[near.lidar == one].mean() for one in lidars[count >= _LEAST_POINTS]]
    return float(max(means) - min(means)) / NS_PER_MS if len(means) > 1 else None


def _without_neighbour(xyz: F32Array, others: F32Array) -> BoolArray:
    """Points (n,) that have none of the others within half a `_NEAR_M` on each axis."""
    lone = np.ones(len(xyz), np.bool_)
    known = np.unique(_voxels(others))
    for corner in range(8):
        shift = np.array([corner >> axis & 1 for axis in range(3)], np.float32) - 0.5
        rows = np.flatnonzero(lone)
        lone[rows] = ~np.isin(_voxels(xyz[rows] + shift * _NEAR_M), known)
    return lone


def _voxels(xyz: F32Array) -> I64Array:
    x, y, z = np.floor(xyz.astype(np.float64) / _NEAR_M).astype(np.int64).T
    numbers: I64Array = (x << 42) + (y << 21) + z
    return numbers
