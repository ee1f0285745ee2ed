"""Check of the poses of lidars against what they see of the same surfaces (`poses/check.py`).

The thread that batches decodes some columns of pairs of windows, at growing distances, until the
outcome is settled. So it depends on no worker, and a long recording costs no more than a short one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.pipeline.sensor import Sensor
from mlbatch.reports.poses import PoseFigures
from mlbatch.types import Scan, Window, WindowColumns
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.poses.check import Begun, PoseComparison
    from mlbatch.poses.solve import Cloud

# Most slots of a lidar in a window of the first place, and of later places: if all is clear, and
# if more points pay. Of more, every second column is read, or every third.
_FIRST_SLOTS, _FEW_SLOTS, _MANY_SLOTS = 1 << 14, 1 << 13, 1 << 15
# Points (n, 3) of a lidar in a window or slice, and their stamps (n,).
_Points: TypeAlias = tuple[F64Array, I64Array]
# Nearer points are of the machine, farther ones too sparse to show surfaces.
_NEAREST_M, _FARTHEST_M = 1.0, 60.0


class PoseCheck:
    """Takes windows or their slices; `figures` once all are there.

    is_over: more windows would change nothing.
    """

    def __init__(
        self,
        sensors: Sequence[Sensor],
        slices: int,
        decode: Callable[[WindowColumns, int, int], Scan],
    ) -> None:
        """slices: of a window; decode: `Conversion.plain_scan`."""
        self._sensors = sensors
        self._slots = [sensor.source.slots for sensor in sensors]
        self._slices = slices
        self._decode = decode
        self._comparison: PoseComparison | None = None
        self.is_over = False
        # Windows so far, and the number of the next one that begins a place.
        self._windows = -1
        self._next = 1
        # Index of the newest window; a place after its first window, and the end of that.
        self._index: int | None = None
        self._begun: Begun | None = None
        self._instant_ns = 0
        # Slices of the newest window, if it is read.
        self._parts: list[list[_Points]] = []

    def add(self, window: Window) -> None:
        """Add the next window, or slice."""
        if self.is_over or window.is_partial:
            return
        if window.index != self._index:
            if window.start_ns != self._instant_ns:
                self._begun = None
            self._windows += 1
            self._index = window.index
            self._parts = []
        if self._windows < self._next:
            return
        self._parts.append([self._points(window, lidar) for lidar in range(len(self._sensors))])
        if window.slice == self._slices - 1:
            self._compare(window)

    def figures(self) -> PoseFigures:
        """Return the outcome for each pair of lidars."""
        if self._comparison is None or not self._comparison.places:
            return PoseFigures("fewer than three windows")
        return PoseFigures(pairs=self._comparison.figures())

    def _points(self, window: Window, lidar: int) -> _Points:
        """Points of a lidar in columns at equal steps."""
        most = _FIRST_SLOTS
        if self._comparison is not None and self._comparison.places:
            most = _MANY_SLOTS if self._comparison.needs_more else _FEW_SLOTS
        rows = np.flatnonzero(window.columns.sensor == lidar)
        step = max(1, round(len(rows) * self._slots[lidar] * self._slices / most))
        scan = self._decode(window.columns.take(rows[::step]), window.start_ns, window.end_ns)
        away_m = scan.xyz - self._sensors[lidar].body_from_sensor[:3, 3].astype(np.float32)
        squared = np.einsum("ni,ni->n", away_m, away_m)
        kept = (squared > _NEAREST_M**2) & (squared < _FARTHEST_M**2)
        return scan.xyz[kept].astype(np.float64), scan.time_ns[kept] + np.int64(window.start_ns)

    def _compare(self, window: Window) -> None:
        """Compare the clouds of a window that is complete."""
        # Loaded once there is something to compare.
        from mlbatch.poses.check import PoseComparison

        if self._comparison is None:
            names = [sensor.name for sensor in self._sensors]
            poses = [sensor.body_from_sensor for sensor in self._sensors]
            self._comparison = PoseComparison(names, poses, _as_radians(self._sensors))
        if self._begun is None:
            self._instant_ns = window.end_ns
            self._begun = self._comparison.begin(self._clouds())
        else:
            self._comparison.complete(self._begun, self._clouds())
            self._begun = None
        if self._begun is None:
            self._next = 2 * self._next + 1
            self.is_over = self._comparison.is_settled

    def _clouds(self) -> list[Cloud]:
        """Take the points of each lidar in the newest window."""
        from mlbatch.poses.solve import Cloud

        clouds = []
        for lidar, parts in enumerate(zip(*self._parts, strict=True)):
            points_m, stamp_ns = map(np.concatenate, zip(*parts, strict=True))
            origin_m = self._sensors[lidar].body_from_sensor[:3, 3]
            time_s = (stamp_ns - self._instant_ns) / NS_PER_S
            clouds.append(Cloud(lidar, points_m, time_s, origin_m))
        self._parts = []
        return clouds


def _as_radians(sensors: Sequence[Sensor]) -> list[F64Array] | None:
    """Poses if the angles of the rig were meant as radians; None where they cannot have been."""
    poses = []
    largest = 0.0
    for sensor in sensors:
        angles = () if sensor.rig is None else sensor.rig.rotation_rpy_deg
        if not angles or max(map(abs, angles)) > math.pi + 0.01:
            return None
        largest = max(largest, *map(abs, angles))
        pose = sensor.body_from_sensor
        poses.append(from_rpy_deg(tuple(pose[:3, 3]), tuple(map(math.degrees, angles))))
    return poses if largest else None
