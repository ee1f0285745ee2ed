"""Columns of all sensors in one order, and their figures, window by window."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.lidar.geometry import SECTORS, sectors
from mlbatch.types import (
    NO_COLUMNS,
    ColumnFigures,
    Columns,
    WindowColumns,
    WindowFigures,
)

_NONE = np.empty(0, np.int64)


class ColumnMerge:
    """Merges the waiting columns of all sensors, by numpy."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        """positions: rotor positions of a revolution by sensor; None: columns have rotor words."""
        self._positions = positions

    def take_until(self, waiting: Sequence[list[Columns]], until: int) -> WindowColumns:
        """Take the columns before `until` from the lists of the sensors.

        The stable sort is the merge of the paper: smallest stamp first.
        """
        taken = []
        for own in waiting:
            due, left = split_at(joined(own), until)
            taken.append(due)
            own[:] = [left] if len(left) else []
        merged = joined(taken)
        sensor = np.arange(len(taken)).repeat([len(columns) for columns in taken])
        order = merged.stamp_ns.argsort(kind="stable")
        columns = merged.take(order)
        return WindowColumns(columns.stamp_ns, sensor[order], columns.ring_index, columns.encoder)

    def figures(self, merged: WindowColumns, ends: Sequence[int]) -> list[WindowFigures]:
        """Return the figures of each window; ends: column after the last of each."""
        bounds = pairwise([0, *ends])
        return [self._of_window(merged.take(slice(begin, end))) for begin, end in bounds]

    def _of_window(self, columns: WindowColumns) -> WindowFigures:
        if len(self._positions) == 1:
            return [_figures(columns.stamp_ns, columns.encoder, self._positions[0])]
        # One sort of bytes costs less than a mask for each sensor.
        order = columns.sensor.astype(np.uint8).argsort(kind="stable")
        stamp_ns = columns.stamp_ns[order]
        encoder = columns.encoder[order]
        counts = np.bincount(columns.sensor, minlength=len(self._positions))
        ends = counts.cumsum().tolist()
        begins = [0, *ends[:-1]]
        return [
            _figures(stamp_ns[begin:end], encoder[begin:end], positions)
            for begin, end, positions in zip(begins, ends, self._positions, strict=True)
        ]


def column_merge(engine: str, positions: Sequence[int | None]) -> ColumnMerge:
    """Return the merge of an engine, numpy or native; positions: as of `ColumnMerge`."""
    if engine != "native":
        return ColumnMerge(positions)
    # Imported on demand: the library may be missing.
    from mlbatch.batching.native_merge import NativeColumnMerge

    return NativeColumnMerge(positions)


def _figures(stamp_ns: I64Array, encoder: I64Array, positions: int | None) -> ColumnFigures:
    """Figures of the columns (n,) of one sensor; positions: see `sectors`."""
    if not len(stamp_ns):
        return NO_COLUMNS
    gap_ns = int((stamp_ns[1:] - stamp_ns[:-1]).max(initial=0))
    sector = sectors(encoder, positions)
    # A sector counts once each time that the rotor enters it.
    entered = sector[1:][sector[1:] != sector[:-1]]
    passes = np.bincount(entered, minlength=SECTORS)
    passes[sector[0]] += 1
    passed = int(np.count_nonzero(passes))
    passed_again = int(np.count_nonzero(passes > 1))
    return ColumnFigures(
        len(stamp_ns),
        gap_ns,
        passed / SECTORS,
        passed_again / SECTORS,
        int(stamp_ns[0]),
        int(stamp_ns[-1]),
    )


def split_at(columns: Columns, until: int) -> tuple[Columns, Columns]:
    """Columns with stamps before `until`, and the others; each in their order."""
    stamp = columns.stamp_ns
    if bool((stamp[1:] >= stamp[:-1]).all()):
        at = int(stamp.searchsorted(until))
        return columns.take(slice(None, at)), columns.take(slice(at, None))
    due = stamp < until
    return columns.take(due), columns.take(~due)


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
