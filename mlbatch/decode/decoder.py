"""Raw columns of a window to the arrays of a scan: every pixel is written once, to its final row.

Sensors whose pixels look alike are decoded together, by passes of numpy (`tiles.py`) or by compiled
loops (`compiled.py`); both give the same bytes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import F64Array, U8Array
from mlbatch.decode.coverage import NO_COLUMNS, ColumnStatistics, ColumnStats
from mlbatch.decode.numpy_engine import NumpyEngine
from mlbatch.decode.projector import Extras, Projector, Source, tile_columns
from mlbatch.decode.scan_buffer import ScanBuffer, WindowColumns
from mlbatch.report.ledger import PointCounts
from mlbatch.types import EXTRAS, RunInfo, Scan

__all__ = ["Decoder", "ScanHeader", "Source", "WindowColumns"]

# What became of the slots of every sensor of a run, in the order of `ledger.POINT_FATES`.
PointOutcomes: TypeAlias = Sequence[Sequence[int]]


@dataclass(frozen=True, slots=True)
class ScanHeader:
    """What a scan says of itself; see Scan."""

    index: int
    slice: int
    start_ns: int
    end_ns: int
    complete: bool
    ready_host_ns: int


class Decoder:
    """Turns the columns of windows into scans; `only` (a sensor) serves `--split`."""

    def __init__(
        self,
        info: RunInfo,
        sources: Sequence[Source],
        boxes_m: F64Array,
        extras: Extras = EXTRAS,
        only: int | None = None,
        buffers: int = 1,
        engine: str = "numpy",
    ) -> None:
        """buffers: the arrays of so many scans are valid at a time; engine: numpy or numba."""
        self._info = info
        self._only = only
        self._extras = extras
        self._slots = max(source.slots for source in sources)
        columns = tile_columns(self._slots)
        # Rotor positions of a turn, None for those that columns tell themselves.
        angles = [source.lidar.beams.angle_rad for source in sources]
        positions = [None if one is None else len(one) for one in angles]
        groups = _alike(sources, together=engine == "numpy")
        first = only or 0
        self._projectors = [
            Projector(
                [(first + number, sources[number]) for number in group],
                columns,
                boxes_m,
                extras,
            )
            for group in groups
        ]
        # Of each sensor: its projector, and its number there.
        self._seat = np.empty((len(sources), 2), np.int64)
        for which, group in enumerate(groups):
            self._seat[group] = [(which, member) for member in range(len(group))]
        self._organized = info.layout == "organized"
        self._has_reflectivity = "reflectivity" in extras and any(
            source.lidar.has_reflectivity for source in sources
        )
        shown = extras if self._has_reflectivity else extras - {"reflectivity"}
        wide = self._slots if self._organized else 0
        if engine == "numba":
            # Loaded only here, as what it needs may not be there.
            from mlbatch.decode.numba_engine import CompiledColumnStatistics, NumbaEngine

            self._outliner: ColumnStatistics = CompiledColumnStatistics(positions)
            self._kinds: NumpyEngine | NumbaEngine = NumbaEngine(
                self._projectors, self._seat, columns, first, shown, wide
            )
        else:
            self._outliner = ColumnStatistics(positions)
            self._kinds = NumpyEngine(self._projectors, self._seat, columns, first, shown)
        self._buffer = self._new_buffer(0)
        self._others = deque(self._new_buffer(0) for _ in range(buffers - 1))

    @property
    def counts(self) -> list[PointCounts]:
        """The ledger of pixels of each sensor."""
        return [self._projectors[which].counts[member] for which, member in self._seat]

    def scan(
        self, due: WindowColumns, label: ScanHeader, outcomes: PointOutcomes | None = None
    ) -> Scan:
        """Decode the columns of one window; the arrays are valid until as many calls as buffers.

        outcomes: given where an output already holds the points; their arrays then mean nothing.
        """
        if outcomes is not None:
            return self._outline(due, label, outcomes)
        self._others.append(self._buffer)
        self._buffer = self._others.popleft()
        self._fit(len(due))
        points = self._kinds.decode(due, label.start_ns, 0, self._buffer)
        return self._scan(due, label, points)

    def _outline(self, due: WindowColumns, label: ScanHeader, outcomes: PointOutcomes) -> Scan:
        """All of a scan but its points; organized, its arrays have their shapes."""
        if self._organized:
            self._fit(len(due))
        counts = self.counts
        before = sum(one.written for one in counts)
        own = outcomes if self._only is None else outcomes[self._only : self._only + 1]
        for one, numbers in zip(counts, own, strict=True):
            one.add(numbers)
        points = sum(one.written for one in counts) - before
        return replace(self._scan(due, label, 0), points=points)

    def _fit(self, columns: int) -> None:
        rows = columns if self._organized else columns * self._slots
        if rows > self._buffer.rows:
            self._buffer = self._new_buffer(rows)

    def _new_buffer(self, rows: int) -> ScanBuffer:
        return ScanBuffer(rows, self._slots if self._organized else None)

    def _lidar_id(self, due: WindowColumns, columns: slice) -> U8Array:
        sensor = due.sensor[columns]
        if self._only is not None:
            return np.full(len(sensor), self._only, np.uint8)
        return sensor.astype(np.uint8)

    def _scan(self, due: WindowColumns, label: ScanHeader, points: int) -> Scan:
        rows, buffer = slice(0, len(due) if self._organized else points), self._buffer
        lidar_id = self._lidar_id(due, slice(None))
        own = self._outlines(due)
        has_column = "column" in self._extras and not self._organized
        return Scan(
            info=self._info,
            index=label.index,
            slice=label.slice,
            start_ns=label.start_ns,
            end_ns=label.end_ns,
            complete=label.complete,
            ready_host_ns=label.ready_host_ns,
            xyz=buffer.point[rows, ..., :3],
            intensity=buffer.point[rows, ..., 3],
            reflectivity=buffer.reflectivity[rows] if self._has_reflectivity else None,
            range_m=buffer.range_m[rows] if "range_m" in self._extras else None,
            time_ns=buffer.label["time_ns"][rows],
            ring=buffer.label["ring"][rows],
            return_type=buffer.label["return_type"][rows],
            lidar_id=buffer.label["lidar_id"][rows],
            column=buffer.column[rows] if has_column else None,
            column_stamp_ns=due.stamp_ns,
            column_lidar_id=lidar_id,
            points=points,
            columns_per_sensor=tuple(one.columns for one in own),
            max_gap_ns=tuple(one.max_gap_ns for one in own),
            coverage=tuple(one.coverage for one in own),
            overlap=tuple(one.overlap for one in own),
        )

    def _outlines(self, due: WindowColumns) -> list[ColumnStats]:
        """What the columns of each sensor are."""
        outlines = self._outliner.measure(due)
        if self._only is None:
            return outlines
        nothing = [NO_COLUMNS] * (len(self._info.sensors) - 1)
        return [*nothing[: self._only], *outlines, *nothing[self._only :]]


def _alike(sources: Sequence[Source], *, together: bool) -> list[list[int]]:
    """Numbers of the sensors, grouped by what their pixels look like.

    together: also those that say their angle themselves, if their beams fire at the same times;
    compiled loops follow the rotor of one sensor only.
    """
    groups: dict[tuple[str | int | bool | bytes, ...], list[int]] = {}
    for number, source in enumerate(sources):
        kind: tuple[str | int | bool | bytes, ...] = source.lidar.pixel_layout
        if source.lidar.beams.angle_rad is None:
            kind = (*kind, *_firing(source)) if together else (number,)
        if source.lidar.projection(source.body_from_sensor, 1) is not None:
            kind = (number,)
        groups.setdefault(kind, []).append(number)
    return list(groups.values())


def _firing(source: Source) -> tuple[str | bool | bytes, ...]:
    """What sensors have in common whose beams fire alike, and whose returns mean the same."""
    lidar = source.lidar
    tables = lidar.firing_ns.tobytes(), lidar.channel.tobytes()
    return (*tables, lidar.typed_by, lidar.sends_twice, source.keep_repeated)
