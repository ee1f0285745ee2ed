"""Windows to scans, by one thread or several: what is to be decoded, and by whom."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from isal.isal_zlib import crc32

from mlbatch.arrays import I64Array
from mlbatch.decode.decoder import Decoder
from mlbatch.decode.groups import Source
from mlbatch.reports.ledger import PointCounts
from mlbatch.types import NO_COLUMNS, ColumnFigures, Scan, Window
from mlbatch.writers.point_layouts import clipped_points

# Counts of the points of a scan, one list per sensor, in the order of `ledger.POINT_COUNTERS`.
Outcomes: TypeAlias = Sequence[Sequence[int]]
# Gives a decoder of these sensors; with `--split` of one sensor, whose index is the second.
NewDecoder: TypeAlias = Callable[[Sequence[Source], int | None], Decoder]
# Columns at the end of a window that are searched first.
_TAIL = 64


@dataclass(slots=True)
class DecodeTask:
    """The window of one scan, to be decoded."""

    window: Window
    only: int | None  # with `--split` the index of their sensor
    outcomes: Outcomes | None = None  # as in `Decoder.scan`
    is_decoded: bool = False

    @property
    def end_ns(self) -> int:
        """End of the window."""
        return self.window.end_ns

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor whose pixels are still needed."""
        if self.is_decoded:
            return None
        if self.only is not None:
            # In the decoder of one sensor.
            sensor = 0 if self.only == sensor else -1
        return first_ring_index([self.window], sensor)


class Decoded(NamedTuple):
    """A scan and the counts of its points, one list per sensor; empty if not requested."""

    scan: Scan
    outcomes: list[list[int]]


class DecodeWorker:
    """The decoders of one thread, with scratch memory of their own."""

    def __init__(
        self, sources: Sequence[Source], split: bool, new: NewDecoder, counts_clipped: bool
    ) -> None:
        """split: one decoder per sensor, since each task has one sensor.

        counts_clipped: the output has intensities of 8 bits.
        """
        self._sensors = len(sources)
        self._counts_clipped = counts_clipped
        if split:
            self._decoders = [new([source], number) for number, source in enumerate(sources)]
        else:
            self._decoders = [new(sources, None)]

    def decode(self, task: DecodeTask, *, counts_points: bool = False) -> Decoded:
        """Decode a task; the arrays are valid as long as the decoder's buffers last.

        counts_points: give the outcomes.
        """
        decoder = self._decoders[task.only or 0]
        before = [counts.counters for counts in decoder.counts] if counts_points else []
        scan = decoder.scan(task.window, task.outcomes)
        task.is_decoded = True
        # A scan that the output already contains has no points, but their counts.
        if self._counts_clipped and task.outcomes is None:
            clipped = clipped_points(scan)
            for number, counts in enumerate(decoder.counts, start=task.only or 0):
                counts.clipped += clipped[number]
        if not counts_points:
            return Decoded(scan, [])
        after = [counts.counters for counts in decoder.counts]
        outcomes = [
            [late - early for late, early in zip(now, was, strict=True)]
            for now, was in zip(after, before, strict=True)
        ]
        if task.only is not None:
            nothing = [[0] * len(outcomes[0])] * self._sensors
            outcomes = [*nothing[: task.only], *outcomes, *nothing[task.only + 1 :]]
        return Decoded(scan, outcomes)

    @property
    def points(self) -> list[PointCounts]:
        """Point counters of each sensor."""
        return [counts for decoder in self._decoders for counts in decoder.counts]


class DecodePool:
    """The decode workers of a run, and the tasks whose raw packets are still needed."""

    def __init__(
        self,
        sources: Sequence[Source],
        new: NewDecoder,
        *,
        workers: int,
        split: bool,
        counts_clipped: bool = False,
    ) -> None:
        """workers: one per thread."""
        self._rings = [source.ring for source in sources]
        self._split = split
        self._open: list[DecodeTask] = []
        self.workers = [DecodeWorker(sources, split, new, counts_clipped) for _ in range(workers)]

    def tasks(self, window: Window) -> Iterator[DecodeTask]:
        """Yield the tasks of a window: one, or with `--split` one for each sensor in it."""
        if not self._split:
            yield self._task(window, None)
            return
        for number, figures in enumerate(window.figures):
            if not figures.columns:
                continue
            part = window.columns.take(np.flatnonzero(window.columns.sensor == number))
            # In the decoder of one sensor.
            part.sensor[:] = 0
            alone: list[ColumnFigures] = [NO_COLUMNS] * len(window.figures)
            alone[number] = figures
            yield self._task(replace(window, columns=part, figures=alone), number)

    def _task(self, window: Window, only: int | None) -> DecodeTask:
        task = DecodeTask(window, only)
        self._open.append(task)
        return task

    def content(self, task: DecodeTask, before: int) -> int:
        """Checksum of a task's timestamps, of all packets up to its last, and of `before`."""
        columns = task.window.columns
        content = crc32(np.ascontiguousarray(columns.stamp_ns).view(np.uint8).data, before)
        for sensor, ring in enumerate(self._rings):
            if task.only is None:
                last = _last(columns.sensor, sensor)
            else:
                last = len(columns) - 1 if task.only == sensor else None
            if last is not None:
                total = ring.sum_until(int(columns.ring_index[last]))
                content = crc32(total.to_bytes(8, "little"), content)
        return content

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor that a task still needs; None: none."""
        self._open = [task for task in self._open if not task.is_decoded]
        ring_indexes = [task.oldest_ring_index(sensor) for task in self._open]
        return min(
            (ring_index for ring_index in ring_indexes if ring_index is not None), default=None
        )

    def points(self, sensor: int) -> PointCounts:
        """Point counters of a sensor, over all workers."""
        total = PointCounts()
        for worker in self.workers:
            total.add(worker.points[sensor].counters)
        return total


def first_ring_index(windows: Iterable[Window], sensor: int) -> int | None:
    """First ring index of a sensor in windows that wait; None: none."""
    parts = (one.columns.ring_index[one.columns.sensor == sensor] for one in windows)
    return min((int(part.min()) for part in parts if len(part)), default=None)


def _last(sensors: I64Array, sensor: int) -> int | None:
    """Index of the last column of a sensor, None without one; sensors: (n,) of all columns."""
    # Columns of the sensors alternate.
    for count in (_TAIL, len(sensors)):
        own = np.flatnonzero(sensors[-count:] == sensor)
        if len(own):
            return max(0, len(sensors) - count) + int(own[-1])
    return None
