"""The merge by compiled loops (`native/merge.c`): the same columns and figures as by numpy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch.batching.merge import ColumnMerge, joined
from mlbatch.lidar.geometry import SECTORS
from mlbatch.native.library import Part, address, library
from mlbatch.types import ColumnFigures, Columns, WindowColumns, WindowFigures

_FIGURES = 7
# As in `merge.c`.
MOST_SENSORS = 256
# Of a sensor; more, as of packets that come one by one, cost less when they are joined first.
_MOST_PARTS = 3


class NativeColumnMerge(ColumnMerge):
    """See `ColumnMerge`, which does what the loops leave: columns out of order."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        super().__init__(positions)
        self._library = library()
        self._position_counts = np.array([one or 0 for one in positions], np.int64)
        self._entered = np.zeros((len(positions), SECTORS), np.int64)

    def take_until(self, waiting: Sequence[list[Columns]], until: int) -> WindowColumns:
        """See `ColumnMerge`."""
        if len(waiting) > MOST_SENSORS:
            return super().take_until(waiting, until)
        for own in waiting:
            if len(own) > _MOST_PARTS:
                own[:] = [joined(own)]
        parts = [(sensor, one) for sensor, own in enumerate(waiting) for one in own]
        structs = (Part * len(parts))()
        kept = []
        for struct, (sensor, columns) in zip(structs, parts, strict=True):
            arrays = [
                np.ascontiguousarray(array)
                for array in (columns.stamp_ns, columns.ring_index, columns.encoder)
            ]
            struct.sensor = sensor
            struct.columns = len(columns)
            struct.stamp_ns, struct.ring_index, struct.encoder = map(address, arrays)
            kept.append(arrays)
        taken = np.empty(len(parts), np.int64)
        # One array each, since readers may keep some of them.
        merged = [np.empty(sum(len(one) for _, one in parts), np.int64) for _ in range(4)]
        count = self._library.mlbatch_merge(
            len(parts), structs, until, address(taken), *map(address, merged)
        )
        if count < 0:
            return super().take_until(waiting, until)
        left = zip(parts, taken.tolist(), strict=True)
        for own in waiting:
            own.clear()
        for (sensor, columns), used in left:
            if used < len(columns):
                waiting[sensor].append(columns.take(slice(used, None)))
        stamp_ns, of, ring_index, encoder = (array[:count] for array in merged)
        return WindowColumns(stamp_ns, of, ring_index, encoder)

    def figures(self, merged: WindowColumns, ends: Sequence[int]) -> list[WindowFigures]:
        """See `ColumnMerge`; numpy computes them if a position is beyond the revolution."""
        sensors = len(self._position_counts)
        figures = np.empty((len(ends), sensors, _FIGURES), np.int64)
        bounds = np.array(ends, np.int64)
        columns = [
            np.ascontiguousarray(array)
            for array in (merged.stamp_ns, merged.sensor, merged.encoder)
        ]
        if self._library.mlbatch_figures(
            len(ends),
            address(bounds),
            *map(address, columns),
            sensors,
            address(self._position_counts),
            SECTORS,
            address(self._entered),
            address(figures),
        ):
            return super().figures(merged, ends)
        return [
            [
                ColumnFigures(count, gap_ns, passed / SECTORS, again / SECTORS, first_ns, last_ns)
                for count, gap_ns, passed, again, first_ns, last_ns, _ in window
            ]
            for window in figures.tolist()
        ]
