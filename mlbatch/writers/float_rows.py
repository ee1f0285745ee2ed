"""Files of float32 rows without a header, and the list of their times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import F32Array
from mlbatch.types import Scan
from mlbatch.units import NS_PER_S
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.point_layouts import Values, seconds_toward_zero
from mlbatch.writers.scan_folder import Entry

TIMES_TXT = "times.txt"
Column: TypeAlias = Callable[[Scan], Values]

# Columns of the files, in order; all values are exact but times, which are rounded toward zero.
XYZI: tuple[Column, ...] = (
    lambda scan: scan.xyz[:, 0],
    lambda scan: scan.xyz[:, 1],
    lambda scan: scan.xyz[:, 2],
    lambda scan: scan.intensity,
)
XYZIR: tuple[Column, ...] = (*XYZI, lambda scan: scan.ring)
TIME_AND_LIDAR: tuple[Column, ...] = (
    lambda scan: seconds_toward_zero(scan.time_ns),
    lambda scan: scan.lidar_id,
)


class RowEncoder:
    """Encodes scans as a row of float32 a point, in a buffer that is reused."""

    def __init__(self, columns: tuple[Column, ...]) -> None:
        self._columns = columns
        self._rows: F32Array = np.zeros((0, len(columns)), dtype="<f4")

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the rows of all points."""
        count = len(scan.time_ns)
        if len(self._rows) < count:
            self._rows = np.zeros((count * 5 // 4, len(self._columns)), dtype="<f4")
        rows = self._rows[:count]
        for number, values in enumerate(self._columns):
            rows[:, number] = values(scan)
        return [rows.reshape(-1).view(np.uint8).data]


def times_text(entries: Sequence[Entry]) -> str:
    """Return a line a scan: its start in seconds of the common clock, with 9 decimals."""
    return "".join(
        f"{entry.start_ns // NS_PER_S}.{entry.start_ns % NS_PER_S:09d}\n" for entry in entries
    )
