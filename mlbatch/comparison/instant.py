"""The instant of a recording at which fused sets and windows differ most, found in one pass.

Columns of the last windows are kept, with their raw packets. At some instants all that a set of
that time contains is decoded, and the one with the largest difference is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array
from mlbatch.batching.fusion import MOST_AGE_NS
from mlbatch.batching.sweeps import Sweep, SweepSet, sweeps_of
from mlbatch.page.clouds import CloudPoints
from mlbatch.page.instant import RADIUS_M, InstantSet, SharedInstant, Spot
from mlbatch.pipeline.decode_pool import first_ring_index
from mlbatch.pipeline.sensor import Sensor
from mlbatch.types import Scan, Window, WindowColumns
from mlbatch.units import NS_PER_MS, NS_PER_S

# Sets of an instant are complete by then: approximate time waits a sweep and its tolerance.
_WAIT_NS = 400_000_000
_KEPT_NS = MOST_AGE_NS + _WAIT_NS + 400_000_000
# Windows from one instant to the next, doubled after so many.
_STEP, _INSTANTS = 5, 12
# Of the spans of sets, beyond the largest so far, to look at once.
_LONGER_NS = 5_000_000


class InstantFinder:
    """Takes sets of all policies and windows, in order."""

    def __init__(
        self,
        names: Sequence[str],
        sensors: Sequence[Sensor],
        period_ns: int,
        decode: Callable[[WindowColumns, int, int], Scan],
    ) -> None:
        """names: of the policies, then of windows; decode: `Conversion.plain_scan`."""
        self._best: SharedInstant | None = None
        self._names = names
        self._sensors = sensors
        self._period_ns = period_ns
        self._decode = decode
        self._windows: deque[Window] = deque()
        self._sets: list[deque[SweepSet]] = [deque() for _ in names[:-1]]
        self._first_ns = 0
        self._count = self._looked = 0
        self._step = _STEP
        self._longest_ns = 0
        self._score = (False, 0.0, 0)
        lacking = [sensor.name for sensor in sensors if not sensor.detected.pose.is_known]
        self._why = (
            f"No merged clouds: {', '.join(lacking)} without extrinsics; give them in a rig "
            "(--rig) or in /tf_static."
            if lacking
            else ""
        )

    def add_set(self, policy: int, joined: SweepSet) -> None:
        """Add a set of a policy."""
        sets = self._sets[policy]
        sets.append(joined)
        while _last_ns(sets[0]) < _last_ns(joined) - _KEPT_NS:
            sets.popleft()

    def add(self, window: Window) -> None:
        """Add the next window, after the sets that are complete by then."""
        self._first_ns = self._first_ns or window.start_ns
        self._windows.append(window)
        while self._windows[0].end_ns < window.end_ns - _KEPT_NS:
            self._windows.popleft()
        due = [one for one in self._windows if one.end_ns <= window.end_ns - _WAIT_NS]
        if due and not due[-1].is_partial:
            self._look(due[-1])

    def finish(self) -> None:
        """End of input: look at the last windows of a recording that is too short for others."""
        if self._best is None:
            self._step = 1
            for window in list(self._windows)[:-1]:
                if not window.is_partial:
                    self._look(window)

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor that an instant may need; None: none."""
        return first_ring_index(self._windows, sensor)

    def found(self) -> SharedInstant | None:
        """The instant that differs most so far; None without a set."""
        return self._best and replace(self._best, looked=self._looked)

    # -- an instant ---------------------------------------------------------------------------

    def _look(self, window: Window) -> None:
        """Compare the sets of the end of a window, if it is due or its sets are longer than any."""
        members = self._members(window)
        if len(members) < 2:
            return
        longest_ns = max(_last_ns(one) - _first_ns(one) for one in members.values())
        is_longer = longest_ns > self._longest_ns + _LONGER_NS
        self._longest_ns = max(self._longest_ns, longest_ns)
        self._count += 1
        if self._count % self._step and not is_longer:
            return
        self._looked += 1
        if self._looked % _INSTANTS == 0:
            self._step *= 2
        points = [] if self._why else self._points(window, list(members.values()))
        shown, spot = 0, None
        for number, fused in enumerate(points[:-1]):
            other = difference(fused, points[-1], self._period_ns)
            if other is not None and (spot is None or other.score > spot.score):
                shown, spot = number, other
        score = *((False, 0.0) if spot is None else spot.score), longest_ns
        if score > self._score:
            self._score = score
            self._best = self._instant(window, members, points, shown, spot)

    def _members(self, window: Window) -> dict[str, SweepSet]:
        """Distinct sets that end nearest to a window, up to half a period off; then the window."""
        names: dict[SweepSet, list[str]] = {}
        for name, sets in zip(self._names, self._sets, strict=False):
            nearest = min(sets, key=lambda one: abs(_last_ns(one) - window.end_ns), default=None)
            # Else of another window: the first sets, or after a silence.
            if nearest is None or 2 * abs(_last_ns(nearest) - window.end_ns) > self._period_ns:
                continue
            newest_ns = max(one.first_ns for one in nearest if one is not None)
            kept = tuple(
                one if one is not None and one.first_ns >= newest_ns - MOST_AGE_NS else None
                for one in nearest
            )
            names.setdefault(kept, []).append(name)
        members = {", ".join(those): members for members, those in names.items()}
        return members | {
            self._names[-1]: sweeps_of(window.columns, len(self._sensors), window.end_ns)
        }

    def _points(self, window: Window, members: Sequence[SweepSet]) -> list[CloudPoints]:
        """The points of each set."""
        parts = [one.columns for one in self._windows]
        names = ("stamp_ns", "sensor", "ring_index", "encoder")
        columns = WindowColumns(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
        )
        inside = [_inside(columns, one) for one in members]
        rows = np.flatnonzero(np.logical_or.reduce(inside))
        some = columns.take(rows)
        start_ns, end_ns = int(some.stamp_ns[0]), int(some.stamp_ns[-1])
        scan = self._decode(some, start_ns, end_ns)
        time_ns = scan.time_ns.astype(np.int64) + (start_ns - window.end_ns)
        points = CloudPoints(scan.xyz, scan.lidar_id, time_ns, scan.ring, scan.intensity)
        return [points.take(one[rows][scan.column]) for one in inside]

    def _instant(
        self,
        window: Window,
        members: dict[str, SweepSet],
        points: Sequence[CloudPoints],
        shown: int,
        spot: Spot | None,
    ) -> SharedInstant:
        sets = []
        for number, (name, sweeps) in enumerate(members.items()):
            ages_ms = tuple(_ages_ms(sweep, window.end_ns) for sweep in sweeps)
            if not points:
                sets.append(InstantSet(name, ages_ms))
                continue
            own = points[number]
            spot_ms = None if spot is None else spot_apart_ms(own, spot)
            apart_ms = apart(own, cells(own), self._period_ns).shared_ms()
            sets.append(InstantSet(name, ages_ms, own, spot_ms, apart_ms))
        return SharedInstant(
            at_s=(window.end_ns - self._first_ns) / NS_PER_S,
            looked=0,
            sensors=tuple(sensor.name for sensor in self._sensors),
            poses=tuple(sensor.body_from_sensor for sensor in self._sensors),
            period_ns=self._period_ns,
            columns=np.bincount(window.columns.sensor, minlength=len(self._sensors)),
            sets=tuple(sets),
            shown=shown,
            spot=spot,
            why=self._why,
        )


def _ages_ms(sweep: Sweep | None, instant_ns: int) -> tuple[float, float] | None:
    if sweep is None:
        return None
    return (instant_ns - sweep.first_ns) / NS_PER_MS, (instant_ns - sweep.last_ns) / NS_PER_MS


def _inside(columns: WindowColumns, members: SweepSet) -> BoolArray:
    """Which columns are of a set, (n,)."""
    inside: BoolArray = np.zeros(len(columns), np.bool_)
    for one in filter(None, members):
        is_later = columns.stamp_ns >= one.first_ns
        inside |= (columns.sensor == one.sensor) & is_later & (columns.stamp_ns <= one.last_ns)
    return inside


def _first_ns(members: SweepSet) -> int:
    return min(one.first_ns for one in members if one is not None)


def _last_ns(members: SweepSet) -> int:
    return max(one.last_ns for one in members if one is not None)


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
