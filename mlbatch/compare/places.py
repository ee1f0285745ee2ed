"""Where two clouds of one instant differ: times of lidars by place, points that only one has."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array

RADIUS_M = 2.5  # of a spot
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
class Points:
    """Points of several sets; xyz: (n, 3) m, body frame; lidar, time_ns: (n,)."""

    xyz: F32Array
    lidar: U8Array
    time_ns: I64Array

    def take(self, rows: BoolArray | I64Array) -> Points:
        """Some of the points."""
        return Points(self.xyz[rows], self.lidar[rows], self.time_ns[rows])

    def cells(self) -> I64Array:
        """Number of the cell of each point, -1 out of reach, (n,)."""
        away_m = np.hypot(self.xyz[:, 0], self.xyz[:, 1])
        x, y = np.floor((self.xyz[:, :2] + _FARTHEST_M) / _CELL_M).astype(np.int64).T
        inside = (away_m >= _NEAREST_M) & (away_m < _FARTHEST_M)
        return np.where(inside, x * round(2 * _FARTHEST_M / _CELL_M) + y, -1)


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """Time between the lidars in cells, ascending; lidars: number that see each."""

    cell: I64Array
    apart_ns: F64Array
    lidars: I64Array

    def shared_ms(self) -> tuple[float, float] | None:
        """Median and largest time, ms, of the cells that two lidars see; None without."""
        shared = self.apart_ns[self.lidars > 1] / 1e6
        return (float(np.median(shared)), float(shared.max())) if len(shared) else None


def apart(points: Points, cell: I64Array, period_ns: int) -> Apart:
    """Compare the mean times of the lidars in each cell, but for those with a seam."""
    rows = np.flatnonzero(cell >= 0)
    key = cell[rows] * 256 + points.lidar[rows]
    order = np.argsort(key, kind="stable")
    key, time_ns = key[order], points.time_ns[rows][order].astype(np.float64)
    edges = np.flatnonzero(np.diff(key, prepend=-1))
    if not len(edges):
        return Apart(edges, np.zeros(0), edges)
    count = np.diff(np.append(edges, len(key)))
    mean = np.add.reduceat(time_ns, edges) / count
    spread = np.maximum.reduceat(time_ns, edges) - np.minimum.reduceat(time_ns, edges)
    seen = count >= _LEAST_POINTS
    whole = key[edges][seen] // 256
    seam = np.unique(whole[spread[seen] > _SEAM * period_ns])
    kept = ~np.isin(whole, seam)
    whole, mean = whole[kept], mean[seen][kept]
    begin = np.flatnonzero(np.diff(whole, prepend=-1))
    if not len(begin):
        return Apart(begin, np.zeros(0), begin)
    longest: F64Array = np.maximum.reduceat(mean, begin) - np.minimum.reduceat(mean, begin)
    return Apart(whole[begin], longest, np.diff(np.append(begin, len(whole))))


@dataclass(frozen=True, slots=True)
class Difference:
    """A cell where a fused set differs from the window; gain_ns: more time between its lidars.

    centre_m: of what differs; unmatched: points of the set there, of `points` above the ground,
    without a point of the window near.
    """

    centre_m: tuple[float, float, float]
    gain_ns: float
    unmatched: int = 0
    points: int = 0

    @property
    def score(self) -> tuple[bool, float]:
        """What differs in place precedes what differs in time."""
        return self.unmatched > 0, self.gain_ns * max(1, self.unmatched)


def difference(fused: Points, window: Points, period_ns: int) -> Difference | None:
    """The largest difference; None where the times of lidars are as near in the fused set."""
    cells = fused.cells(), window.cells()
    one, two = (apart(*pair, period_ns) for pair in zip((fused, window), cells, strict=True))
    both, mine, theirs = np.intersect1d(one.cell, two.cell, return_indices=True)
    gain_ns = one.apart_ns[mine] - two.apart_ns[theirs]
    kept = (one.lidars[mine] > 1) & (gain_ns >= _LEAST_GAIN_NS)
    both, gain_ns = both[kept], gain_ns[kept]
    if not len(both):
        return None
    some = [
        points.take(np.isin(cell, both))
        for points, cell in zip((fused, window), cells, strict=True)
    ]
    cell = np.searchsorted(both, some[0].cells())
    low_m = np.full(len(both), np.inf)
    np.minimum.at(low_m, cell, some[0].xyz[:, 2])
    above = some[0].xyz[:, 2] > low_m[cell] + _GROUND_M
    lone = above & _without_neighbour(some[0].xyz, some[1].xyz)
    points, unmatched = (np.bincount(cell[rows], minlength=len(both)) for rows in (above, lone))
    moved = (unmatched >= _LEAST_UNMATCHED) & (unmatched >= _LEAST_SHARE * points)
    score = np.where(moved, unmatched, 0) * gain_ns
    if moved.any():
        best = int(score.argmax())
        rows = lone & (cell == best)
    else:
        # Of the cells that differ most the one with the most points.
        worst = gain_ns >= gain_ns.max() - _LEAST_GAIN_NS
        best = int(np.where(worst, np.bincount(cell, minlength=len(both)), 0).argmax())
        rows = cell == best
    x, y, z = some[0].xyz[rows].mean(axis=0, dtype=np.float64).tolist()
    counts = (int(unmatched[best]), int(points[best])) if moved.any() else (0, 0)
    return Difference((x, y, z), float(gain_ns[best]), *counts)


def mean_times_ns(
    points: Points, centre_m: Iterable[float], sensors: int
) -> tuple[float | None, ...]:
    """Mean time of the points of each lidar around a spot; None for few."""
    x, y, _ = centre_m
    near = np.hypot(points.xyz[:, 0] - x, points.xyz[:, 1] - y) < RADIUS_M
    times = [points.time_ns[near & (points.lidar == number)] for number in range(sensors)]
    return tuple(float(own.mean()) if len(own) >= _LEAST_POINTS else None for own in times)


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
