"""Pieces of the decoding kernel: which slots of a column are wanted, and what returns are.

Source: docs/sources/outputs.md section 3 for the types of returns; `decode.projector` does the same
in numpy. Elements are `return * pad + beam`; those beyond the beams hold no return.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, f4_at, i8_at, moved, piece

_FIRST_STRONG, _BOTH, _ONLY = 3, 9, 7
_TYPE_BIT = 48
_COLUMNS, _FOUND, _SINGLE, _IN_RANGE, _OUTSIDE = range(5)

Marking = Callable[[Pointer, int, Pointer, Pointer, Pointer], None]
Labelling = Callable[[Pointer, int, int, Pointer, Pointer, Pointer], None]


@cache
def marking(pad: int, returns: int) -> Marking:
    """`(frame, member, ranges, points, keep)`: what is wanted, and the ledger of the others."""
    drop_repeated, cut_boxes, count = _drop_repeated(pad, returns), _cut_boxes(), _count()
    elements = returns * pad

    @piece
    def mark(frame: Pointer, member: int, ranges: Pointer, points: Pointer, keep: Pointer) -> None:
        counts = moved(i8_at(frame[at.COUNTS]), member * 5)
        counts[_COLUMNS] += 1
        for element in range(elements):
            keep[element] = ranges[element] > np.float32(0)
        left = count(keep, elements)
        counts[_FOUND] += left
        if frame[at.DROPS_REPEATED] != 0:
            drop_repeated(ranges, keep)
            left = count(keep, elements)
        counts[_SINGLE] += left
        if frame[at.LIMITS] != 0:
            limits = moved(f4_at(frame[at.LIMITS]), member * 2)
            low, high = limits[0], limits[1]
            for element in range(elements):
                metres = ranges[element]
                keep[element] &= np.uint8(metres >= low) & np.uint8(metres <= high)
            left = count(keep, elements)
        counts[_IN_RANGE] += left
        if frame[at.BOX_COUNT] != 0:
            cut_boxes(f4_at(frame[at.BOXES]), frame[at.BOX_COUNT], elements, points, keep)
            left = count(keep, elements)
        counts[_OUTSIDE] += left

    return mark


def _drop_repeated(pad: int, returns: int) -> Callable[[Pointer, Pointer], None]:
    """Returns that an earlier return of their beam equals in range are not wanted."""

    @piece
    def drop(ranges: Pointer, keep: Pointer) -> None:
        for which in range(1, returns):
            for earlier in range(which):
                for beam in range(pad):
                    element = which * pad + beam
                    keep[element] &= np.uint8(ranges[element] != ranges[earlier * pad + beam])

    return drop


def _count() -> Callable[[Pointer, int], int]:
    """How many elements are wanted."""

    @piece
    def count(keep: Pointer, elements: int) -> int:
        total = 0
        for element in range(elements):
            total += keep[element]
        return total

    return count


def _cut_boxes() -> Callable[[Pointer, int, int, Pointer, Pointer], None]:
    """Points inside of boxes are not wanted."""

    @piece
    def cut(boxes: Pointer, count: int, elements: int, points: Pointer, keep: Pointer) -> None:
        for number in range(count):
            box = moved(boxes, number * 6)
            for element in range(elements):
                inside = np.uint8(1)
                for axis in range(3):
                    metres = points[4 * element + axis]
                    inside &= np.uint8(metres >= box[axis]) & np.uint8(metres <= box[3 + axis])
                keep[element] &= inside ^ np.uint8(1)

    return cut


@cache
def labelling(pad: int, returns: int) -> Labelling:
    """`(frame, row, offset_ns, ranges, levels, labels)`: time, ring, type, sensor of all elements.

    row: among the labels; offset_ns: stamp of the column after the start of the scan.
    """
    elements = returns * pad
    # Without a second return there is no type to be told.
    other = pad * (returns > 1)

    @piece
    def label(
        frame: Pointer,
        row: int,
        offset_ns: int,
        ranges: Pointer,
        levels: Pointer,
        labels: Pointer,
    ) -> None:
        words = moved(i8_at(frame[at.LABELS]), row * elements)
        for element in range(elements):
            labels[element] = words[element] + offset_ns
        if frame[at.TYPED] == 0:
            return
        # Numbers of types differ by the bits that these tests give; a lone return is told by all.
        level_counts, twice = frame[at.TYPED] - 1, frame[at.SENT_TWICE]
        for beam in range(pad):
            first, second = ranges[beam], ranges[other + beam]
            kind = _FIRST_STRONG + np.int64(first > second)
            kind += np.int64(levels[beam] < levels[other + beam]) * 2 * level_counts
            alone = np.int64(first == np.float32(0)) | np.int64(second == np.float32(0))
            alone |= np.int64(first == second) & twice
            labels[beam] |= (kind | alone * _ONLY) << _TYPE_BIT
            labels[other + beam] |= (_BOTH - kind | alone * _ONLY) << _TYPE_BIT

    return label
