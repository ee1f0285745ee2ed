"""Pieces of the decoding kernel: the wanted elements of a column to their final rows.

A dense scan is written one row past its end at most slots of a column: what is not wanted is
overwritten by the next point. There always is such a row, since rows are as many as slots.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from mlbatch.kernels import frame as at
from mlbatch.kernels._primitives import (
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
Emitting = Callable[[Pointer, int, int, int, Pointer, Pointer, Pointer, Pointer, Pointer], int]
_LIDAR_ID_BIT = 56
_NAN = np.float32("nan")


@cache
def emitting() -> Emitting:
    """`(frame, column, table, row, points, labels, ranges, others, keep)` gives the next row.

    others: reflectivities.
    """
    dense, ordered, organized = _dense(), _ordered(), _organized()

    @piece
    def emit(
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
        if frame[at.WIDTH] != 0:
            return row + organized(frame, column, points, labels, ranges, others, keep)
        if frame[at.ORDER] != 0:
            after = ordered(frame, column, table, row, points, labels, ranges, others, keep)
        else:
            after = dense(frame, row, points, labels, ranges, others, keep)
        if frame[at.COLUMN] != 0:
            out, number = u4_at(frame[at.COLUMN]), frame[at.FIRST_NUMBER] + column
            for place in range(row, after):
                out[place] = np.uint32(number)
        if frame[at.POINTS] != 0:
            i8_at(frame[at.POINTS])[column] = after - row
        return after

    return emit


def _dense() -> Callable[[Pointer, int, Pointer, Pointer, Pointer, Pointer, Pointer], int]:
    """Elements as they lie; of sensors with one return."""

    @piece
    def dense(
        frame: Pointer,
        row: int,
        points: Pointer,
        labels: Pointer,
        ranges: Pointer,
        others: Pointer,
        keep: Pointer,
    ) -> int:
        point, label = c16_at(frame[at.POINT]), i8_at(frame[at.LABEL])
        after = row
        for slot in range(frame[at.SLOTS]):
            point[after] = points[slot]
            label[after] = labels[slot]
            after += keep[slot]
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
