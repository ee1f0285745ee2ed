"""Check of the poses of lidars against what they see of the same surfaces (`poses/check.py`).

The thread that batches decodes some columns of pairs of windows, at growing distances, until the
outcome is settled. So it depends on no worker, and a long recording costs no more than a short one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.decode.decoder import Decoder, ScanHeader
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.pipeline.sensor import Sensor
from mlbatch.reports.poses import PoseFigures
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.batching.windows import Window
    from mlbatch.poses.check import PoseComparison

# Of a lidar in a window, until surfaces match and then; of more, every second column is read, or
# every third.
_SLOTS, _MORE_SLOTS = 1 << 14, 1 << 15
# Points (n, 3) of a window or slice, their times (n,) in ns, their lidars (n,).
_Points: TypeAlias = tuple[F32Array, I64Array, U8Array]
# Nearer points are of the machine, farther ones too sparse to show surfaces.
_NEAREST_M, _FARTHEST_M = 1.0, 60.0


class PoseCheck:
    """Takes windows or their slices; `figures` once all are there."""

    def __init__(
        self, sensors: Sequence[Sensor], slices: int, new_decoder: Callable[[], Decoder]
    ) -> None:
        """slices: of a window; new_decoder: called with the first window that is read."""
        self._sensors = sensors
        self._slots = [sensor.source().slots for sensor in sensors]
        self._origins_m = [sensor.body_from_sensor[:3, 3] for sensor in sensors]
        self._slices = slices
        self._new_decoder = new_decoder
        self._decoder: Decoder | None = None
        self._comparison: PoseComparison | None = None
        self._is_over = False
        # Windows so far, and the number of the next one that begins a place.
        self._windows = -1
        self._index: int | None = None
        self._next = 1
        # Windows of a place by index.
        self._place: dict[int, list[_Points]] = {}

    def add(self, window: Window) -> None:
        """Add the next window, or slice."""
        if self._is_over or window.is_partial:
            return
        if window.index != self._index:
            self._index = window.index
            self._windows += 1
            if self._windows < self._next:
                return
            if not self._place or window.index - 1 in self._place:
                self._place[window.index] = []
            else:
                self._place = {window.index: []}
        if window.index not in self._place:
            return
        self._place[window.index].append(self._points(window))
        if len(self._place) == 2 and window.slice == self._slices - 1:
            self._compare(window)
            self._place = {}
            self._next = 2 * self._next + 1

    @property
    def is_over(self) -> bool:
        """Whether more windows would change nothing."""
        return self._is_over

    def figures(self) -> PoseFigures:
        """What is known of each pair of lidars."""
        if self._comparison is None:
            return PoseFigures("fewer than three windows")
        return PoseFigures(pairs=self._comparison.figures())

    def _points(self, window: Window) -> _Points:
        """Points of some columns; columns of a sensor are taken at equal steps."""
        columns = window.columns
        is_common = self._comparison is not None and self._comparison.is_common
        most = _MORE_SLOTS if is_common else _SLOTS
        taken: list[I64Array] = []
        for number, slots in enumerate(self._slots):
            rows = np.flatnonzero(columns.sensor == number)
            step = max(1, round(len(rows) * slots * self._slices / most))
            taken.append(rows[::step])
        some = columns.take(np.sort(np.concatenate(taken)))
        if self._decoder is None:
            self._decoder = self._new_decoder()
        header = ScanHeader(
            window.index, window.slice, window.start_ns, window.end_ns, window.complete, 0
        )
        scan = self._decoder.scan(some, header)
        stamp_ns = scan.time_ns.astype(np.int64) + window.start_ns
        return scan.xyz.copy(), stamp_ns, scan.lidar_id.copy()

    def _compare(self, last: Window) -> None:
        """Compare the clouds of a place."""
        # Loaded once there is something to compare.
        from mlbatch.poses.check import PoseComparison
        from mlbatch.poses.solve import Cloud

        if self._comparison is None:
            names = [sensor.name for sensor in self._sensors]
            poses = [sensor.body_from_sensor for sensor in self._sensors]
            self._comparison = PoseComparison(names, poses, _as_radians(self._sensors))
        clouds = []
        for parts in self._place.values():
            points_m, stamp_ns, lidar = (
                np.concatenate(arrays) for arrays in zip(*parts, strict=True)
            )
            time_s = (stamp_ns - last.start_ns) / NS_PER_S
            for number, origin_m in enumerate(self._origins_m):
                own = np.flatnonzero(lidar == number)
                away_m = points_m[own] - origin_m.astype(np.float32)
                squared = np.einsum("ni,ni->n", away_m, away_m)
                rows = own[(squared > _NEAREST_M**2) & (squared < _FARTHEST_M**2)]
                clouds.append(
                    Cloud(number, points_m[rows].astype(np.float64), time_s[rows], origin_m)
                )
        self._comparison.add(clouds)
        self._is_over = self._comparison.is_settled


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
