"""Output of decoding: the arrays of a scan."""

from __future__ import annotations

import math

import numpy as np

from mlbatch.types import PACKED_ROOM, PackedPoints, PackedTotals, RecordLayout

# All of a point but its readings, in one word of 8 bytes that is copied as one. The time, in ns
# after the start of the scan, is the low half, so that it can be added as a number.
LABEL = np.dtype([("time_ns", "<u4"), ("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")])


class ScanBuffer:
    """Arrays of one scan, reused by later ones; rows beyond the points of a scan are stale.

    point: (rows, 4) or (rows, slots, 4) float32, x, y, z in m and intensity; range_m: float32;
    reflectivity: uint16; label: LABEL; column: (rows,) uint32, number of the column in the scan,
    empty if organized. record: layout of packed records, None without; with them the other arrays
    have no rows. packed: bytes of the records.
    """

    def __init__(self, rows: int, slots: int | None, record: RecordLayout | None = None) -> None:
        """slots: slots of a row of an organized scan; None: dense, a row is a point."""
        self.rows = rows
        self.is_organized = slots is not None
        self.record = record
        # Zeros: what is between pieces is never written.
        size = 0 if record is None else PACKED_ROOM + rows * (slots or 1) * record.step + 1
        self.packed = np.zeros(size, np.uint8)
        if record is not None:
            rows = 0
        shape = (rows,) if slots is None else (rows, slots)
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

    def packed_points(
        self, shape: tuple[int, ...], totals: PackedTotals | None
    ) -> PackedPoints | None:
        """Return the records of a scan of this shape; None if points are not packed."""
        if self.record is None:
            return None
        end = PACKED_ROOM + math.prod(shape) * self.record.step
        return PackedPoints(self.packed, PACKED_ROOM, end, shape, totals)


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
