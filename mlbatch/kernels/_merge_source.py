"""A kernel that joins the points of several kinds of sensors, column by column."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mlbatch.kernels import frame as at
from mlbatch.kernels._primitives import (
    Pointer,
    c16_at,
    f4_at,
    i8_at,
    i8_scratch,
    moved,
    piece,
    u2_at,
    u4_at,
)

_MOST_KINDS = 256
_POINT, _LABEL, _RANGE, _REFLECTIVITY = range(4)


def build() -> Callable[[Pointer], int]:
    """Takes the frame MERGED to MERGE_SIZE of `frame.py`; gives the number of points."""
    copy = _copy()

    def kernel(frame: Pointer) -> int:
        # How far each kind has come.
        done = i8_scratch(_MOST_KINDS)
        for kind in range(_MOST_KINDS):
            done[kind] = 0
        kinds, sensors = i8_at(frame[at.MERGE_KIND]), i8_at(frame[at.MERGE_SENSOR])
        points, parts = i8_at(frame[at.MERGE_POINTS]), i8_at(frame[at.MERGE_PARTS])
        row = 0
        for column in range(frame[at.MERGED]):
            kind = kinds[sensors[column]]
            count = points[column]
            copy(frame, moved(parts, kind * at.PLANES), done[kind], row, count)
            if frame[at.MERGE_COLUMN] != 0:
                numbers = u4_at(frame[at.MERGE_COLUMN])
                for place in range(row, row + count):
                    numbers[place] = np.uint32(frame[at.MERGE_NUMBER] + column)
            done[kind] += count
            row += count
        return row

    return kernel


def _copy() -> Callable[[Pointer, Pointer, int, int, int], None]:
    @piece
    def copy(frame: Pointer, part: Pointer, begin: int, row: int, count: int) -> None:
        """Rows of one kind to rows of the scan."""
        point, label = c16_at(part[_POINT]), i8_at(part[_LABEL])
        out_point, out_label = c16_at(frame[at.MERGE_POINT]), i8_at(frame[at.MERGE_LABEL])
        for number in range(count):
            out_point[row + number] = point[begin + number]
        for number in range(count):
            out_label[row + number] = label[begin + number]
        if frame[at.MERGE_RANGE] != 0:
            ranges, out_ranges = f4_at(part[_RANGE]), f4_at(frame[at.MERGE_RANGE])
            for number in range(count):
                out_ranges[row + number] = ranges[begin + number]
        if frame[at.MERGE_REFLECTIVITY] != 0:
            told, out = u2_at(part[_REFLECTIVITY]), u2_at(frame[at.MERGE_REFLECTIVITY])
            for number in range(count):
                out[row + number] = told[begin + number]

    return copy
