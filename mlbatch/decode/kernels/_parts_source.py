"""A kernel that copies what numpy decoded of some kinds of sensors, column by column.

Takes the frame of `frame.py`, as the kernel that decodes does.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, c16_at, f4_at, i8_at, piece, u2_at, u4_at


def build() -> Callable[[Pointer], int]:
    """Gives the row after the points of the columns."""
    copy = _copy()

    def kernel(frame: Pointer) -> int:
        points = i8_at(frame[at.POINTS])
        row = frame[at.ROW]
        for column in range(frame[at.BEGIN], frame[at.END]):
            count = points[column]
            copy(frame, row, frame[at.NUMBER], count)
            if frame[at.COLUMN] != 0:
                numbers = u4_at(frame[at.COLUMN])
                for place in range(row, row + count):
                    numbers[place] = np.uint32(frame[at.FIRST_NUMBER] + column)
            frame[at.NUMBER] += count
            row += count
        return int(row)

    return kernel


def _copy() -> Callable[[Pointer, int, int, int], None]:
    @piece
    def copy(frame: Pointer, row: int, begin: int, count: int) -> None:
        """Rows of the part, from `begin` on, to rows of the scan."""
        point, out_point = c16_at(frame[at.PART_POINT]), c16_at(frame[at.POINT])
        label, out_label = i8_at(frame[at.PART_LABEL]), i8_at(frame[at.LABEL])
        for number in range(count):
            out_point[row + number] = point[begin + number]
        for number in range(count):
            out_label[row + number] = label[begin + number]
        if frame[at.RANGE] != 0:
            ranges, out_ranges = f4_at(frame[at.PART_RANGE]), f4_at(frame[at.RANGE])
            for number in range(count):
                out_ranges[row + number] = ranges[begin + number]
        if frame[at.REFLECTIVITY] != 0:
            told, out = u2_at(frame[at.PART_REFLECTIVITY]), u2_at(frame[at.REFLECTIVITY])
            for number in range(count):
                out[row + number] = told[begin + number]

    return copy
