"""Columns of all sensors in one order, and their figures, window by window: `native/merge.c`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch.lidar.geometry import SECTORS
from mlbatch.native.library import Part, library
from mlbatch.types import ColumnFigures, Columns, WindowColumns, WindowFigures

_NONE = np.empty(0, np.int64)
_FIGURES = 7
# Parts of a sensor's columns. More parts, as of packets that come one by one, are joined first.
_MOST_PARTS = 3


class ColumnMerge:
    """Merges the waiting columns of all sensors."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        """positions: rotor positions of a revolution by sensor; None: columns have rotor words."""
        self._library = library()
        self._positions = np.array([one or 0 for one in positions], np.int64)
        self._entered = np.zeros((len(positions), SECTORS), np.int64)

    def take_until(self, waiting: Sequence[list[Columns]], until: int) -> WindowColumns:
        """Take the columns before `until` from the lists of the sensors.

        The merge of the paper: smallest stamp first; equal ones by sensor, then by delivery.
        """
        for own in waiting:
            if len(own) > _MOST_PARTS:
                own[:] = [joined(own)]
        merged = self._taken(waiting, until)
        if merged is None:
            # Columns of a sensor are not in order: sort by stamp, equal ones by delivery.
            for own in waiting:
                columns = joined(own)
                own[:] = [columns.take(columns.stamp_ns.argsort(kind="stable"))]
            merged = self._taken(waiting, until)
        if merged is None:
            raise RuntimeError("expected columns in the order of their stamps")
        return merged

    def _taken(self, waiting: Sequence[list[Columns]], until: int) -> WindowColumns | None:
        """Do `take_until`; return None and take nothing if a sensor's columns are not in order."""
        parts = [(sensor, one) for sensor, own in enumerate(waiting) for one in own]
        structs = [
            Part(
                sensor=sensor,
                columns=len(columns),
                stamp_ns=np.ascontiguousarray(columns.stamp_ns),
                ring_index=np.ascontiguousarray(columns.ring_index),
                encoder=np.ascontiguousarray(columns.encoder),
            )
            for sensor, columns in parts
        ]
        taken = np.empty(len(parts), np.int64)
        # One array each, since readers may keep some of them.
        merged = [np.empty(sum(len(one) for _, one in parts), np.int64) for _ in range(4)]
        in_a_row = (Part * len(parts))(*structs)
        count = self._library.mlbatch_merge(len(parts), in_a_row, until, taken, *merged)
        if count < 0:
            return None
        for own in waiting:
            own.clear()
        for (sensor, columns), used in zip(parts, taken.tolist(), strict=True):
            if used < len(columns):
                waiting[sensor].append(columns.take(slice(used, None)))
        stamp_ns, of, ring_index, encoder = (array[:count] for array in merged)
        return WindowColumns(stamp_ns, of, ring_index, encoder)

    def figures(self, merged: WindowColumns, ends: Sequence[int]) -> list[WindowFigures]:
        """Return the figures of each window; ends: column after the last of each."""
        sensors = len(self._positions)
        figures = np.empty((len(ends), sensors, _FIGURES), np.int64)
        columns = map(np.ascontiguousarray, (merged.stamp_ns, merged.sensor, merged.encoder))
        self._library.mlbatch_figures(
            *(len(ends), np.array(ends, np.int64), *columns, sensors),
            *(self._positions, SECTORS, self._entered, figures),
        )
        return [
            [
                ColumnFigures(count, gap_ns, passed / SECTORS, again / SECTORS, first_ns, last_ns)
                for count, gap_ns, passed, again, first_ns, last_ns, _ in window
            ]
            for window in figures.tolist()
        ]


def joined(parts: Sequence[Columns]) -> Columns:
    """Columns of all parts, in order."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Columns(_NONE, _NONE, _NONE)
    return Columns(
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.ring_index for part in parts]),
        np.concatenate([part.encoder for part in parts]),
    )
