"""Columns of a window to the arrays of a scan; every pixel is written once, to its final row."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from operator import sub
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import F64Array, U8Array
from mlbatch.decode.engine import Engine
from mlbatch.decode.groups import Source
from mlbatch.decode.scan_buffer import ScanBuffer, by_time
from mlbatch.reports.ledger import PointCounts
from mlbatch.types import (
    EXTRAS,
    NO_COLUMNS,
    RecordLayout,
    RunInfo,
    Scan,
    Window,
    WindowColumns,
)

# Counts of the points of a scan, one list per sensor, in the order of `ledger.POINT_COUNTERS`.
PointOutcomes: TypeAlias = Sequence[Sequence[int]]


class Decoder:
    """Decodes windows of columns into scans."""

    def __init__(
        self,
        info: RunInfo,
        sources: Sequence[Source],
        boxes_m: F64Array,
        extras: frozenset[str] = EXTRAS,
        only: int | None = None,
        buffers: int = 1,
        record: RecordLayout | None = None,
        *,
        own_times: bool = False,
    ) -> None:
        """boxes_m: (k, 6), as `Rig.exclude_boxes_m`; extras: optional arrays of the scans.

        only: with `--split` the index of the only sensor in `sources`; buffers: number of scans
        whose arrays are valid at a time; record: layout of the records that the output takes;
        own_times: times of points count from the first column of their sensor.
        """
        self._own_times = own_times
        self._info = info
        self._only = only
        self._extras = extras
        self._slots = max(source.slots for source in sources)
        self._is_organized = info.layout == "organized"
        self._has_reflectivity = "reflectivity" in extras and any(
            source.lidar.has_reflectivity for source in sources
        )
        if record is not None and record.plain is not None and not self._has_reflectivity:
            record = record.plain
        self._engine = Engine(
            sources,
            boxes_m,
            extras if self._has_reflectivity else extras - {"reflectivity"},
            first_sensor=only or 0,
            organized_slots=self._slots if self._is_organized else 0,
            # Points are sorted by arrays.
            record=None if info.sort == "points" else record,
            timescale=info.timescale,
        )
        self._counts = self._engine.counts
        self._buffer = self._new_buffer(0)
        # With `sort` the points before they are sorted; no scan has views of it.
        self._unsorted = self._new_buffer(0)
        self._other_buffers = deque(self._new_buffer(0) for _ in range(buffers - 1))

    @property
    def counts(self) -> list[PointCounts]:
        """Point counters of each sensor."""
        return self._counts

    def scan(self, window: Window, outcomes: PointOutcomes | None = None) -> Scan:
        """Decode the columns of a window; the arrays are valid for as many calls as buffers.

        outcomes: of a scan that an output already contains: its slots are counted and not decoded,
        and the contents of its arrays are undefined.
        """
        if outcomes is not None:
            return self._scan_without_points(window, outcomes)
        self._other_buffers.append(self._buffer)
        self._buffer = self._other_buffers.popleft()
        self._reserve(len(window.columns))
        before = self._written()
        timed = _by_own_times(window) if self._own_times else window.columns
        points = self._engine.decode(timed, window.start_ns, 0, self._buffer)
        if self._info.sort == "points":
            self._sort(points)
        return self._scan(window, points, before)

    def _scan_without_points(self, window: Window, outcomes: PointOutcomes) -> Scan:
        """Return the scan with all but its points; arrays of organized scans have their shapes."""
        if self._is_organized:
            self._reserve(len(window.columns))
        counts = self.counts
        before = self._written()
        own = outcomes if self._only is None else outcomes[self._only : self._only + 1]
        for one, numbers in zip(counts, own, strict=True):
            one.add(numbers)
        scan = self._scan(window, 0, before)
        return replace(scan, points=sum(scan.points_per_sensor))

    def _reserve(self, columns: int) -> None:
        """Make the buffer large enough for so many columns."""
        rows = columns if self._is_organized else columns * self._slots
        if rows > self._buffer.rows:
            self._buffer = self._new_buffer(rows)

    def _sort(self, points: int) -> None:
        """Sort the points of a dense scan by time, then by column."""
        if self._unsorted.rows < self._buffer.rows:
            self._unsorted = self._new_buffer(self._buffer.rows)
        self._buffer, self._unsorted = self._unsorted, self._buffer
        by_time(self._unsorted, points, self._buffer)

    def _new_buffer(self, rows: int) -> ScanBuffer:
        slots = self._slots if self._is_organized else None
        return ScanBuffer(rows, slots, self._engine.record)

    def _written(self) -> list[int]:
        """Return the points so far of each sensor of the run; 0 without a decoder here."""
        points = [one.written for one in self._counts]
        if self._only is None:
            return points
        others = [0] * (len(self._info.sensors) - 1)
        return [*others[: self._only], *points, *others[self._only :]]

    def _scan(self, window: Window, points: int, before: Sequence[int]) -> Scan:
        """before: points of each sensor before this scan."""
        columns = window.columns
        rows = slice(0, len(columns) if self._is_organized else points)
        buffer = self._buffer
        figures = window.figures or (NO_COLUMNS,) * len(self._info.sensors)
        counts, gaps_ns, coverage, overlap, _, _ = zip(*figures, strict=True)
        edge_gap_ns = window.edge_gap_ns or (0,) * len(counts)
        has_column = "column" in self._extras and not self._is_organized
        return Scan(
            info=self._info,
            index=window.index,
            slice=window.slice,
            start_ns=window.start_ns,
            end_ns=window.end_ns,
            complete=window.complete,
            ready_host_ns=window.ready_host_ns,
            xyz=buffer.point[rows, ..., :3],
            intensity=buffer.point[rows, ..., 3],
            reflectivity=buffer.reflectivity[rows] if self._has_reflectivity else None,
            range_m=buffer.range_m[rows] if "range_m" in self._extras else None,
            time_ns=buffer.time_ns[rows],
            ring=buffer.ring[rows],
            return_type=buffer.return_type[rows],
            lidar_id=buffer.lidar_id[rows],
            column=buffer.column[rows] if has_column else None,
            column_stamp_ns=columns.stamp_ns,
            column_lidar_id=self._lidar_id(columns),
            points=points,
            columns_per_sensor=counts,
            points_per_sensor=tuple(map(sub, self._written(), before)),
            max_gap_ns=tuple(map(max, gaps_ns, edge_gap_ns)),
            coverage=coverage,
            overlap=overlap,
            fill=window.fill,
            is_partial=window.is_partial,
            world_from_body=window.world_from_body,
            packed=buffer.packed_points(
                (self._slots, len(columns)) if self._is_organized else (points,),
                self._engine.totals,
            ),
        )

    def _lidar_id(self, columns: WindowColumns) -> U8Array:
        if self._only is not None:
            return np.full(len(columns), self._only, np.uint8)
        return columns.sensor.astype(np.uint8)


def _by_own_times(window: Window) -> WindowColumns:
    """Return the columns with stamps as if all sensors had begun at the start of the scan."""
    columns = window.columns
    first_ns = np.array([one.first_ns for one in window.figures])
    stamp_ns = columns.stamp_ns - (first_ns - window.start_ns)[columns.sensor]
    return replace(columns, stamp_ns=stamp_ns)
