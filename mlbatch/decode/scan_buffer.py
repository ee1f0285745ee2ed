"""What decoding starts from and fills: the columns of a window, the arrays of a scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array

# What a point is, in the bytes of one word, so that it moves as one: its time (ns after the start
# of the scan, added as a number to the low half), ring, return type and sensor.
LABEL = np.dtype([("time_ns", "<u4"), ("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")])
Labels: TypeAlias = npt.NDArray[np.void]
_NAN = np.float32("nan")


@dataclass(slots=True)
class WindowColumns:
    """Columns of a scan in their final order; all (n,) int64, stamps in ns."""

    stamp_ns: I64Array
    sensor: I64Array
    place: I64Array
    encoder: I64Array

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def part(self, columns: slice | I64Array) -> WindowColumns:
        """Some of them."""
        return WindowColumns(
            self.stamp_ns[columns], self.sensor[columns], self.place[columns], self.encoder[columns]
        )


class ScanBuffer:
    """Arrays of one scan, reused by the next; rows beyond a scan's points are stale.

    slots: of a row, for organized scans; None: a row is a point.
    """

    def __init__(self, rows: int, slots: int | None) -> None:
        shape = (rows,) if slots is None else (rows, slots)
        self.rows = rows
        self.is_organized = slots is not None
        self.point = np.empty((*shape, 4), np.float32)
        self.range_m = np.empty(shape, np.float32)
        self.reflectivity = np.empty(shape, np.uint16)
        self.label = np.empty(shape, LABEL)
        self.column = np.empty(rows if slots is None else 0, np.uint32)

    def clear(self, rows: I64Array) -> None:
        """Empty slots: NaN for what is measured in metres or as a level, else 0."""
        for real in (self.point, self.range_m):
            real[rows] = _NAN
        for whole in (self.reflectivity, self.label.view(np.uint64)):
            whole[rows] = 0
