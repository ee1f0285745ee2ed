"""Places of a recording: windows that follow each other, kept while all others are read.

They are spread over the recording, whose length need not be known: of those that are kept every
second one goes when they are too many, and from then on every second one is skipped. A view that
was kept before shows nothing new, so that few places of a machine at rest are kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import F32Array, F64Array
from mlbatch.poses.solve import Cloud, Place
from mlbatch.types import Scan
from mlbatch.units import NS_PER_S

# Windows of a place: their surfaces, compared with each other, give the motion.
WINDOWS = 2
# Places that are kept at the end are half as many or more.
MOST_PLACES = 20
# Of a machine at rest.
_MOST_AT_REST = 3
# Columns of a window are thinned to about this many points of a lidar.
_MOST_POINTS = 65_000
# A lidar with fewer points in a window is missing from it.
_FEWEST_POINTS = 500
# Farther points are too few a square metre, m.
MOST_RANGE_M = 60.0
# Nearer points are on the machine, which moves with the lidars, m.
LEAST_RANGE_M = 1.5
# Views differ where the mean distances in half of the directions do by more, m.
_SAME_VIEW_M = 0.05
_DIRECTIONS = 48
_VIEW_RANGE_M = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class KeptPlace:
    """A place: its clouds; start_ns: of its first window; view: (d,), mean distances, m."""

    clouds: Place
    start_ns: int
    view: F64Array


@dataclass(slots=True)
class Places:
    """Places of a recording in the order of time.

    windows: of the recording; lacking: by lidar, windows without enough points of it.
    """

    kept: list[KeptPlace]
    windows: int
    lacking: list[int]

    def fitted(self) -> list[Place]:
        """Places that poses are solved on."""
        return [one.clouds for number, one in enumerate(self.kept) if not _is_held_out(number)]

    def held_out(self) -> list[Place]:
        """Every third place, which the poses are measured on."""
        return [one.clouds for number, one in enumerate(self.kept) if _is_held_out(number)]


def _is_held_out(number: int) -> bool:
    return number % 3 == 1


@dataclass(slots=True)
class _Spread:
    """Items spread over a sequence of unknown length, at most `most`."""

    most: int
    kept: list[KeptPlace] = field(default_factory=list)
    stride: int = 1
    count: int = 0

    def is_next(self) -> bool:
        """Whether the next item is kept."""
        return self.count % self.stride == 0

    def add(self, item: KeptPlace) -> None:
        """Keep an item, with room for it if need be."""
        if len(self.kept) == self.most:
            self.kept = self.kept[::2]
            self.stride *= 2
        if self.is_next():
            self.kept.append(item)
        self.count += 1


@dataclass(slots=True)
class _Begun:
    """A place after its first window, which ends at end_ns."""

    spread: _Spread
    clouds: list[Cloud]
    start_ns: int
    end_ns: int
    view: F64Array


def places_of(scans: Iterable[Scan], lidars: int) -> Places:
    """Choose places of the scans of a recording; arrays of a scan are read before the next."""
    moved, at_rest = _Spread(MOST_PLACES), _Spread(_MOST_AT_REST)
    found = Places([], 0, [0] * lidars)
    begun: _Begun | None = None
    view = np.full(_DIRECTIONS, np.inf)
    for scan in scans:
        found.windows += 1
        points = np.bincount(scan.lidar_id, minlength=lidars)
        for lidar in np.flatnonzero(points < _FEWEST_POINTS).tolist():
            found.lacking[lidar] += 1
        if (points < _FEWEST_POINTS).any():
            begun = None
        elif begun is not None and begun.end_ns == scan.start_ns:
            clouds = [*begun.clouds, *_clouds(scan, lidars, scan.start_ns)]
            begun.spread.add(KeptPlace(clouds, begun.start_ns, begun.view))
            begun = None
        else:
            seen = _view(scan.xyz)
            differs = not _is_same(view, seen)
            view = seen if differs else view
            spread = moved if differs else at_rest
            begun = None
            if spread.is_next():
                clouds = list(_clouds(scan, lidars, scan.end_ns))
                begun = _Begun(spread, clouds, scan.start_ns, scan.end_ns, seen)
            else:
                spread.count += 1
    kept = moved.kept + at_rest.kept[: max(0, _MOST_AT_REST - len(moved.kept))]
    found.kept = sorted(kept, key=lambda one: one.start_ns)
    return found


def _clouds(scan: Scan, lidars: int, instant_ns: int) -> Iterator[Cloud]:
    """The points of each lidar in a scan, thinned by whole columns; times from an instant."""
    sensors = scan.info.sensors
    time_s = (scan.time_ns.astype(np.int64) + (scan.start_ns - instant_ns)) / NS_PER_S
    for lidar in range(lidars):
        rows = np.flatnonzero(scan.lidar_id == lidar)
        step = -(-len(rows) // _MOST_POINTS)
        if step > 1 and scan.column is not None:
            # Columns of this lidar up to each column.
            ordinal = np.cumsum(scan.column_lidar_id == lidar)
            rows = rows[ordinal[scan.column[rows]] % step == 0]
        origin_m = sensors[lidar].body_from_sensor[:3, 3]
        yield Cloud(lidar, scan.xyz[rows].astype(np.float64), time_s[rows], origin_m)


def _view(xyz_m: F32Array) -> F64Array:
    """Mean distances of points (p, 3) by direction in the plane: (d,), m, NaN where there is none.

    Far points count as near ones: they come and go.
    """
    x, y = xyz_m[::4, 0], xyz_m[::4, 1]
    sector = np.floor(np.arctan2(y, x) * (_DIRECTIONS / (2 * np.pi))).astype(np.int64)
    sector %= _DIRECTIONS
    away_m = np.minimum(np.hypot(x, y), _VIEW_RANGE_M).astype(np.float64)
    count = np.bincount(sector, minlength=_DIRECTIONS)
    total = np.bincount(sector, weights=away_m, minlength=_DIRECTIONS)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _is_same(one: F64Array, other: F64Array) -> bool:
    """Whether the machine has not moved between two views."""
    off_m = np.abs(one - other)
    return bool(np.isfinite(off_m).any() and np.nanmedian(off_m) <= _SAME_VIEW_M)
