"""Output of decoding: the arrays of a scan."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array

# All of a point but its readings, in one word of 8 bytes that is copied as one. The time, in ns
# after the start of the scan, is the low half, so that it can be added as a number.
LABEL = np.dtype([("time_ns", "<u4"), ("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")])
Labels: TypeAlias = npt.NDArray[np.void]
_NAN = np.float32("nan")


class ScanBuffer:
    """Arrays of one scan, reused by later ones; rows beyond the points of a scan are stale.

    point: (rows, 4) or (rows, slots, 4) float32, x, y, z in m and intensity; range_m: float32;
    reflectivity: uint16; label: LABEL; column: (rows,) uint32, number of the column in the scan,
    empty if organized.
    """

    def __init__(self, rows: int, slots: int | None) -> None:
        """slots: slots of a row of an organized scan; None: dense, a row is a point."""
        shape = (rows,) if slots is None else (rows, slots)
        self.rows = rows
        self.is_organized = slots is not None
        self.point = np.empty((*shape, 4), np.float32)
        self.range_m = np.empty(shape, np.float32)
        self.reflectivity = np.empty(shape, np.uint16)
        self.label = np.empty(shape, LABEL)
        self.column = np.empty(rows if slots is None else 0, np.uint32)
        self.view_labels()

    def view_labels(self) -> None:
        """Make views of the fields of the labels, since to make them costs more than to cut."""
        self.time_ns = self.label["time_ns"]
        self.ring = self.label["ring"]
        self.return_type = self.label["return_type"]
        self.lidar_id = self.label["lidar_id"]

    def clear(self, rows: I64Array) -> None:
        """Empty all slots of some rows: NaN in float arrays, 0 in integer arrays."""
        self.point[rows] = _NAN
        self.range_m[rows] = _NAN
        self.reflectivity[rows] = 0
        self.label.view(np.uint64)[rows] = 0


def by_time(points: ScanBuffer, count: int, out: ScanBuffer) -> None:
    """Copy the first `count` points of a dense scan to `out` by time, then in their order."""
    # Time and number in one word: all differ, so that the fastest sort is a stable one.
    keys = points.label["time_ns"][:count].astype(np.uint64) << np.uint64(32)
    keys |= np.arange(count, dtype=np.uint64)
    keys.sort()
    order = (keys & np.uint64(0xFFFFFFFF)).astype(np.intp)
    pairs = (
        (points.point, out.point),
        (points.range_m, out.range_m),
        (points.reflectivity, out.reflectivity),
        (points.label.view(np.uint64), out.label.view(np.uint64)),
        (points.column, out.column),
    )
    for values, sorted_values in pairs:
        # Without a mode the result would be made twice.
        values.take(order, axis=0, out=sorted_values[:count], mode="clip")
