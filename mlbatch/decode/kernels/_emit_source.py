"""Pieces of the decoding kernel: the wanted elements of a column to their final rows.

A dense scan is written one row past its end at most slots of a column: what is not wanted is
overwritten by the next point. There always is such a row, since rows are as many as slots.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import (
    Pointer,
    c16_at,
    f4_at,
    i8_at,
    moved,
    piece,
    u2_at,
    u4_at,
)

# Scratch of a column: points as pairs of doubles (16 bytes a point), and planes.
Planes = tuple[Pointer, Pointer, Pointer, Pointer, Pointer]
# Words of the labels that are not made yet, and what has to be added to them.
Words = tuple[Pointer, int]
Emitting = Callable[[Pointer, int, int, int, Planes, Words], int]
_LIDAR_ID_BIT = 56
_NAN = np.float32("nan")


@cache
def emitting(lanes: int) -> Emitting:
    """`(frame, column, table, row, planes, words)` gives the next row; lanes: of the CPU, or 1.

    planes: points, labels, ranges, reflectivities, and what is wanted. Labels are looked at where
    the frame has an order or a width, else made of the words.
    """
    lay = _lay_many() if lanes > 1 else _lay_one()
    dense, ordered, organized = _dense(lay, lanes), _ordered(), _organized()

    @piece
    def emit(
        frame: Pointer,
        column: int,
        table: int,
        row: int,
        planes: Planes,
        words: Words,
    ) -> int:
        points, labels, ranges, others, keep = planes
        if frame[at.WIDTH] != 0:
            return row + organized(frame, column, points, labels, ranges, others, keep)
        if frame[at.ORDER] != 0:
            after = ordered(frame, column, table, row, points, labels, ranges, others, keep)
        else:
            after = dense(frame, row, points, words, ranges, others, keep)
        if frame[at.COLUMN] != 0:
            out, number = u4_at(frame[at.COLUMN]), frame[at.FIRST_NUMBER] + column
            for place in range(row, after):
                out[place] = np.uint32(number)
        return after

    return emit


# `(frame, row, begin, end, points, words, keep)` gives the row after the slots from begin on.
Laying = Callable[[Pointer, int, int, int, Pointer, Words, Pointer], int]


def _lay_one() -> Laying:
    """Points and labels, one after the other."""

    @piece
    def lay(
        frame: Pointer,
        row: int,
        begin: int,
        end: int,
        points: Pointer,
        words: Words,
        keep: Pointer,
    ) -> int:
        point, label = c16_at(frame[at.POINT]), i8_at(frame[at.LABEL])
        known, offset_ns = words
        for slot in range(begin, end):
            point[row] = points[slot]
            label[row] = known[slot] + offset_ns
            row += keep[slot]
        return row

    return lay


def _lay_many() -> Laying:
    """The same, as many as fit into a register at once; slots are whole registers."""
    from mlbatch.decode.kernels._lanes import LANES, packed

    @piece
    def lay(
        frame: Pointer,
        row: int,
        begin: int,
        end: int,
        points: Pointer,
        words: Words,
        keep: Pointer,
    ) -> int:
        point, label = c16_at(frame[at.POINT]), i8_at(frame[at.LABEL])
        known, offset_ns = words
        for slot in range(begin, end, LANES):
            own, told = moved(points, slot), moved(known, slot)
            chosen, here, there = moved(keep, slot), moved(point, row), moved(label, row)
            row += packed(chosen, own, told, offset_ns, here, there)
        return row

    return lay


def _dense(
    lay: Laying, lanes: int
) -> Callable[[Pointer, int, Pointer, Words, Pointer, Pointer, Pointer], int]:
    """Elements as they lie; of sensors with one return."""
    one = _lay_one()

    @piece
    def dense(
        frame: Pointer,
        row: int,
        points: Pointer,
        words: Words,
        ranges: Pointer,
        others: Pointer,
        keep: Pointer,
    ) -> int:
        # No more than the slots of the column are written to, as rows are as many as slots.
        whole = frame[at.SLOTS] // lanes * lanes
        after = lay(frame, row, 0, whole, points, words, keep)
        after = one(frame, after, whole, frame[at.SLOTS], points, words, keep)
        if frame[at.RANGE] != 0:
            out, place = f4_at(frame[at.RANGE]), row
            for slot in range(frame[at.SLOTS]):
                out[place] = ranges[slot]
                place += keep[slot]
        if frame[at.REFLECTIVITY] != 0:
            told, place = u2_at(frame[at.REFLECTIVITY]), row
            for slot in range(frame[at.SLOTS]):
                told[place] = others[slot]
                place += keep[slot]
        return after

    return dense


def _ordered() -> Callable[
    [Pointer, int, int, int, Pointer, Pointer, Pointer, Pointer, Pointer], int
]:
    """Elements in the order of firing, channel, return."""

    @piece
    def ordered(
        frame: Pointer,
        column: int,
        table: int,
        row: int,
        points: Pointer,
        labels: Pointer,
        ranges: Pointer,
        others: Pointer,
        keep: Pointer,
    ) -> int:
        point, label = c16_at(frame[at.POINT]), i8_at(frame[at.LABEL])
        order = moved(i8_at(frame[at.ORDER]), table * frame[at.ORDER_STEP])
        after = row
        for slot in range(frame[at.SLOTS]):
            element = order[slot]
            point[after] = points[element]
            label[after] = labels[element]
            after += keep[element]
        if frame[at.RANGE] != 0:
            out, place = f4_at(frame[at.RANGE]), row
            for slot in range(frame[at.SLOTS]):
                out[place] = ranges[order[slot]]
                place += keep[order[slot]]
        if frame[at.REFLECTIVITY] != 0:
            told, place = u2_at(frame[at.REFLECTIVITY]), row
            for slot in range(frame[at.SLOTS]):
                told[place] = others[order[slot]]
                place += keep[order[slot]]
        return after

    return ordered


def _organized() -> Callable[[Pointer, int, Pointer, Pointer, Pointer, Pointer, Pointer], int]:
    """Every element to the slot of its row, the other slots empty; gives how many there are."""

    @piece
    def organized(
        frame: Pointer,
        column: int,
        points: Pointer,
        labels: Pointer,
        ranges: Pointer,
        others: Pointer,
        keep: Pointer,
    ) -> int:
        width, place = frame[at.WIDTH], i8_at(frame[at.SLOT])
        row = (frame[at.FIRST_NUMBER] + column) * width
        point, label = moved(c16_at(frame[at.POINT]), row), moved(i8_at(frame[at.LABEL]), row)
        reals, metres = f4_at(frame[at.POINT] + 16 * row), f4_at(frame[at.RANGE] + 4 * row)
        told = u2_at(frame[at.REFLECTIVITY] + 2 * row)
        sensor = labels[0] >> _LIDAR_ID_BIT << _LIDAR_ID_BIT
        for slot in range(width):
            for axis in range(4):
                reals[4 * slot + axis] = _NAN
            label[slot] = sensor
            metres[slot] = _NAN
            told[slot] = 0
        count = 0
        order = i8_at(frame[at.ORDER])
        for number in range(frame[at.SLOTS]):
            element = order[number] if frame[at.ORDER] != 0 else number
            if keep[element] != 0:
                slot = place[element]
                point[slot] = points[element]
                label[slot] = labels[element]
                metres[slot] = ranges[element]
                told[slot] = others[element]
                count += 1
        return count

    return organized
