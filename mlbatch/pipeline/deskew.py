"""`--deskew`: columns of each window get the transforms that move their points to one instant.

Everything here runs in the thread that batches, before a window goes to the decode workers. So the
result depends on no worker, and shards and resumed runs, which batch everything, get the same.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.batching.grid import Grid
from mlbatch.motion.estimate import Estimate, VelocityEstimator
from mlbatch.motion.registration import ORIGIN, ColumnCloud
from mlbatch.motion.track import PoseLine, PoseTrack
from mlbatch.motion.tum import read_tum
from mlbatch.pipeline.decode_pool import first_ring_index
from mlbatch.pipeline.imu_poses import IMU, ImuPoses, PoseSource
from mlbatch.pipeline.rotation_check import RotationCheck
from mlbatch.reports.motion import MotionLedger, VelocityCounts
from mlbatch.types import Scan, Window, WindowColumns, instant_ns
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.pipeline.conversion import Conversion

CONSTANT_VELOCITY = "constant-velocity"
# Of a window; of more, every second column is read, or every third.
_SLOTS = 1 << 16
# An IMU gives no pose before its first second is complete.
_LEAST_WAIT_NS = 2 * NS_PER_S


def mover_of(run: Conversion) -> Deskew | ConstantVelocity:
    """The object that moves columns for `--deskew`."""
    job = run.job
    points = WindowPoints(run.grid, [sensor.source.slots for sensor in run.sensors], run.plain_scan)
    if job.deskew == CONSTANT_VELOCITY:
        return ConstantVelocity(job.deskew_to, points, len(run.sensors))
    path = Path(job.deskew)
    source = (
        ImuPoses(run.sensors, run.session.setup.frames(), run.topic_offset_ns)
        if job.deskew == IMU
        else PoseSource(path.name, read_tum(path))
    )
    return Deskew(source, job.deskew_to, job.max_wait_ns, points, len(run.sensors))


# -- by poses -------------------------------------------------------------------------------------


class Deskew:
    """Takes windows, yields them with the transforms of their columns, by poses.

    A window waits until they reach its end, at most `--max-wait`, or 2 s. It is moved as a whole:
    if there is no pose at one of its columns, or at its instant, it is left out and its columns are
    counted as `no_pose`, and in `dropped` by sensor.
    """

    def __init__(
        self,
        source: PoseSource,
        to: str,
        max_wait_ns: int | None,
        points: WindowPoints,
        sensors: int,
    ) -> None:
        """to: a word of INSTANTS; max_wait_ns: how long windows wait for poses; None: for ever.

        points: what reads the points of windows, for the check.
        """
        self._counts = MotionLedger(source.name, to)
        self.dropped = [0] * sensors
        self.source = source
        self._max_wait_ns = None if max_wait_ns is None else max(max_wait_ns, _LEAST_WAIT_NS)
        self._waiting: deque[Window] = deque()
        self._check = RotationCheck(points)

    def push(self, window: Window) -> Iterator[Window]:
        """Add the next window."""
        self._waiting.append(window)
        self.source.advance(self._waiting[0].start_ns)
        while self._waiting and self._is_known(self._waiting[0].end_ns, window.end_ns):
            yield from self._moved(self._waiting.popleft())

    def finish(self) -> Iterator[Window]:
        """End of input: no later pose is waited for."""
        if self._waiting:
            self.source.advance(self._waiting[0].start_ns)
        while self._waiting:
            yield from self._moved(self._waiting.popleft())
        self._check.finish(self.source.name)

    def awaits(self, newest_ns: int) -> bool:
        """Whether windows wait for poses that may come; newest_ns: newest stamp of all sensors."""
        if not self._waiting:
            return False
        self.source.advance(self._waiting[0].start_ns)
        return not self._is_known(self._waiting[-1].end_ns, newest_ns)

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor in the windows that wait; None: none."""
        return first_ring_index(self._waiting, sensor)

    @property
    def ledger(self) -> MotionLedger:
        """Counts so far."""
        return replace(
            self._counts,
            source=self.source.name,
            poses=self.source.line.poses,
            gyro_bias=self.source.gyro_bias,
            ended=self.source.ended,
            rotation=self._check.outcome,
        )

    def _is_known(self, end_ns: int, now_ns: int) -> bool:
        """Whether the poses of a window are known at a time, or are not waited for."""
        newest_ns = self.source.line.newest_ns
        if self.source.is_complete or (newest_ns is not None and newest_ns >= end_ns):
            return True
        return self._max_wait_ns is not None and now_ns - end_ns >= self._max_wait_ns

    def _moved(self, window: Window) -> Iterator[Window]:
        columns = window.columns
        counts = self._counts
        counts.columns += len(columns)
        to_ns = instant_ns(self._counts.to, window.start_ns, window.end_ns)
        line = self.source.line
        if not line.has_poses(columns.stamp_ns, to_ns):
            counts.windows_without_poses += 1
            counts.no_pose += len(columns)
            for sensor, figures in enumerate(window.figures):
                self.dropped[sensor] += figures.columns
            return
        self._check.add(window, line, self.source.name, is_last=self.source.is_complete)
        counts.moved += len(columns)
        moves = line.moves(columns.stamp_ns, to_ns)
        columns = replace(columns, moves=moves)
        yield replace(window, columns=columns, world_from_body=line.track.at(to_ns))


# -- by the points of windows ---------------------------------------------------------------------


class WindowCloud(NamedTuple):
    """The points of a window; start_ns, end_ns: of it; slices: that it was cut to."""

    cloud: ColumnCloud
    start_ns: int
    end_ns: int
    slices: list[Window]


class WindowPoints:
    """Takes windows or their slices, reads points of some columns, yields whole windows."""

    def __init__(
        self, grid: Grid, slots: list[int], decode: Callable[[WindowColumns, int, int], Scan]
    ) -> None:
        """slots: of a column of each sensor; decode: `Conversion.plain_scan`."""
        self._grid = grid
        self._slots = slots
        self._decode = decode
        # Slices of the window that is not complete, and their points.
        self._slices: list[Window] = []
        self._clouds: list[ColumnCloud] = []

    def add(self, window: Window) -> Iterator[WindowCloud]:
        """Add the next window or slice; yield windows that are complete."""
        if self._slices and self._slices[-1].index != window.index:
            yield from self.release()
        self._slices.append(window)
        self._clouds.append(self._points(window))
        if window.slice == self._grid.slices - 1:
            yield from self.release()

    def release(self) -> Iterator[WindowCloud]:
        """The window that waits for slices."""
        if not self._slices:
            return
        slices, clouds = self._slices, self._clouds
        self._slices, self._clouds = [], []
        yield WindowCloud(_joined(clouds), *self._span_ns(slices[0]), slices)

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor in the slices that wait; None: none."""
        return first_ring_index(self._slices, sensor)

    def _span_ns(self, window: Window) -> tuple[int, int]:
        """Start and end of the whole window that a slice belongs to; of a set of sweeps its own."""
        slices = self._grid.slices
        if slices == 1:
            return window.start_ns, window.end_ns
        number = self._grid.index_of(window.start_ns) // slices
        return self._grid.bound(number * slices), self._grid.bound((number + 1) * slices)

    def _points(self, window: Window) -> ColumnCloud:
        """Points of some columns; columns of each sensor are taken at equal steps."""
        columns = window.columns
        counts = [int(np.count_nonzero(columns.sensor == one)) for one in range(len(self._slots))]
        total = sum(count * slots for count, slots in zip(counts, self._slots, strict=True))
        step = max(1, -(-total * self._grid.slices // _SLOTS))
        taken: list[I64Array] = [
            np.flatnonzero(columns.sensor == sensor)[::step] for sensor in range(len(self._slots))
        ]
        some = columns.take(np.sort(np.concatenate(taken)))
        start_ns, end_ns = self._span_ns(window)
        time_s: F64Array = (some.stamp_ns - (start_ns + end_ns) // 2) / NS_PER_S
        scan = self._decode(some, window.start_ns, window.end_ns)
        if scan.column is None:
            raise TypeError("expected scans with columns")
        return ColumnCloud(scan.xyz.astype(np.float64), scan.column.astype(np.int64), time_s)


class ConstantVelocity:
    """As `Deskew`, by the velocity that the points give; windows without one are not moved."""

    source: PoseSource | None = None

    def __init__(self, to: str, points: WindowPoints, sensors: int) -> None:
        """to: a word of INSTANTS; points: what reads the points of windows."""
        self.ledger = MotionLedger(CONSTANT_VELOCITY, to, velocity=VelocityCounts())
        self.dropped = [0] * sensors
        self._points = points
        self._estimator = VelocityEstimator()

    def push(self, window: Window) -> Iterator[Window]:
        """Add the next window or slice; yield all slices of complete windows."""
        for whole in self._points.add(window):
            yield from self._moved(whole)

    def finish(self) -> Iterator[Window]:
        """End of input."""
        for whole in self._points.release():
            yield from self._moved(whole)

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor in the slices that wait; None: none."""
        return self._points.oldest_ring_index(sensor)

    def awaits(self, newest_ns: int) -> bool:
        """False: a window needs nothing that is recorded after it."""
        return False

    def _moved(self, whole: WindowCloud) -> Iterator[Window]:
        cloud, start_ns, end_ns, slices = whole
        middle_ns = (start_ns + end_ns) // 2
        estimate = self._estimator.add(cloud, middle_ns, end_ns - start_ns)
        self._count(estimate, slices)
        if estimate.velocity is None or estimate.reason:
            yield from slices
            return
        line = _line(estimate.velocity, start_ns, end_ns)
        for window in slices:
            columns = window.columns
            to_ns = instant_ns(self.ledger.to, window.start_ns, window.end_ns)
            moves = line.moves(columns.stamp_ns, to_ns)
            yield replace(window, columns=replace(columns, moves=moves))

    def _count(self, estimate: Estimate, slices: list[Window]) -> None:
        counts = self.ledger
        columns = sum(len(window.columns) for window in slices)
        counts.columns += columns
        velocity = counts.velocity
        if velocity is None:
            return
        if estimate.residual_m is not None:
            counts.poses += 1
            velocity.residual_m.append(estimate.residual_m)
        if not estimate.reason:
            counts.moved += columns
            return
        velocity.unmoved += columns
        velocity.add_window(estimate.reason, slices[0].index)


def _joined(clouds: list[ColumnCloud]) -> ColumnCloud:
    """The points of all slices of a window."""
    if len(clouds) == 1:
        return clouds[0]
    before = np.cumsum([0, *(len(one.time_s) for one in clouds[:-1])])
    return ColumnCloud(
        np.concatenate([one.points_m for one in clouds]),
        np.concatenate([one.column + base for one, base in zip(clouds, before, strict=True)]),
        np.concatenate([one.time_s for one in clouds]),
    )


def _line(velocity: F64Array, start_ns: int, end_ns: int) -> PoseLine:
    """The poses of a motion with a constant twist, from the start to the end of a window."""
    end = ORIGIN.then(velocity * ((end_ns - start_ns) / NS_PER_S))
    return PoseLine(
        PoseTrack(
            np.array([start_ns, end_ns], np.int64),
            np.stack([ORIGIN.rotation, end.rotation]),
            np.stack([ORIGIN.position_m, end.position_m]),
            CONSTANT_VELOCITY,
        )
    )
