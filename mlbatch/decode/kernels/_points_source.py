"""Pieces of the decoding kernel: ranges of one column to points in the body frame.

Source: the formulas of `lidar.geometry`, whose `Tabled` and `Turning` do the same in numpy, step
by step in float32. Each piece is `(frame, place, ranges, levels, points, scratch)`: place is
(member, encoder word, firing table among those of all members, number among the columns of the
kind); points are x, y, z and level; scratch is 8 * pad floats.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, f4_at, i8_at, moved, piece

Place = tuple[int, int, int, int]
Projecting = Callable[[Pointer, Place, Pointer, Pointer, Pointer, Pointer], None]
_VECTORS, _AXES = 3, 3
# Bits of VECTORS.
_FLAT, _LEVEL, _ORIGINS = 0, 3, 6
# Of a rotor word.
_SPEED_AT, _SPEED_SIGN, _SPEED_STEP = 32, 1 << 23, 2.0**-48 * 2 * np.pi


@cache
def projecting(kind: str, pad: int, returns: int) -> Projecting:
    """kind: `tabled` or `turning`."""
    return _tabled(pad, returns) if kind == "tabled" else _turning(pad, returns)


def _tabled(pad: int, returns: int) -> Projecting:
    """Directions and origins from rows of a table; a sensor fires all beams at once."""

    @piece
    def project(
        frame: Pointer,
        place: Place,
        ranges: Pointer,
        levels: Pointer,
        points: Pointer,
        scratch: Pointer,
    ) -> None:
        member, word, _, _ = place
        row = word + i8_at(frame[at.FIRST_ROW])[member]
        row = min(max(row, 0), frame[at.ROWS] - 1)
        along = moved(f4_at(frame[at.DIRECTION]), row * _AXES * pad)
        origin = moved(f4_at(frame[at.ORIGIN]), row * _AXES)
        x, y, z = origin[0], origin[1], origin[2]
        reach = moved(f4_at(frame[at.REACH]), member * pad)
        for which in range(returns):
            first = which * pad
            for beam in range(pad):
                element = first + beam
                reached = ranges[element] + reach[beam]
                points[4 * element] = reached * along[beam] + x
                points[4 * element + 1] = reached * along[pad + beam] + y
                points[4 * element + 2] = reached * along[2 * pad + beam] + z
                points[4 * element + 3] = levels[element]

    return project


def _turning(pad: int, returns: int) -> Projecting:
    """Directions and origins from the rotor's angle as each beam fires."""

    turn_on, combine, lay = _turn_on(pad), _combine(pad), _lay(pad)

    @piece
    def project(
        frame: Pointer,
        place: Place,
        ranges: Pointer,
        levels: Pointer,
        points: Pointer,
        scratch: Pointer,
    ) -> None:
        member, word, table, number = place
        cosine, sine = moved(scratch, 3 * pad), moved(scratch, 4 * pad)
        for beam in range(pad):
            cosine[beam] = f4_at(frame[at.COSINE])[number]
            sine[beam] = f4_at(frame[at.SINE])[number]
        field = word >> _SPEED_AT & (2 * _SPEED_SIGN - 1)
        speed = np.float32(np.float64((field ^ _SPEED_SIGN) - _SPEED_SIGN) * _SPEED_STEP)
        if frame[at.FIRING] != 0 and speed != np.float32(0):
            turn_on(cosine, sine, speed, moved(f4_at(frame[at.FIRING]), table * pad))
        first = member * _VECTORS * _AXES * pad
        directions = moved(f4_at(frame[at.DIRECTION]), first)
        origins = moved(f4_at(frame[at.ORIGIN]), first)
        vectors = i8_at(frame[at.VECTORS])[member]
        begin = moved(scratch, 5 * pad)
        for axis in range(_AXES):
            here = axis * pad
            combine(moved(directions, here), vectors >> axis, cosine, sine, moved(scratch, here))
            turning = vectors >> (axis + _ORIGINS)
            combine(moved(origins, here), turning, cosine, sine, moved(begin, here))
        for which in range(returns):
            metres, level = moved(ranges, which * pad), moved(levels, which * pad)
            if frame[at.REACH] != 0:
                reach = moved(f4_at(frame[at.REACH]), member * pad)
                for beam in range(pad):
                    cosine[beam] = metres[beam] + reach[beam]
                lay(cosine, level, scratch, begin, moved(points, 4 * which * pad))
            else:
                lay(metres, level, scratch, begin, moved(points, 4 * which * pad))

    return project


def _lay(pad: int) -> Callable[[Pointer, Pointer, Pointer, Pointer, Pointer], None]:
    """Points of one return: r * direction + origin, all that belongs to a point at once."""

    @piece
    def lay(
        metres: Pointer, level: Pointer, along: Pointer, begin: Pointer, points: Pointer
    ) -> None:
        for beam in range(pad):
            points[4 * beam] = metres[beam] * along[beam] + begin[beam]
            points[4 * beam + 1] = metres[beam] * along[pad + beam] + begin[pad + beam]
            points[4 * beam + 2] = metres[beam] * along[2 * pad + beam] + begin[2 * pad + beam]
            points[4 * beam + 3] = level[beam]

    return lay


def _turn_on(pad: int) -> Callable[[Pointer, Pointer, np.float32, Pointer], None]:
    """Cosines and sines go on to the angle at which their beam fires; see `geometry.Turning`."""

    @piece
    def turn_on(cosine: Pointer, sine: Pointer, speed: np.float32, firing_ns: Pointer) -> None:
        for beam in range(pad):
            before, aside = cosine[beam], sine[beam]
            turned = speed * firing_ns[beam]
            half = turned * np.float32(0.5)
            back = (half * before + aside) * turned
            on = (before - half * aside) * turned
            cosine[beam] = before - back
            sine[beam] = aside + on

    return turn_on


def _combine(pad: int) -> Callable[[Pointer, int, Pointer, Pointer, Pointer], None]:
    """cos * V1 + sin * V2 + V3 of one axis; as in numpy, what is zero for all beams is left out."""
    axes = _AXES * pad

    @piece
    def combine(vectors: Pointer, flags: int, cosine: Pointer, sine: Pointer, out: Pointer) -> None:
        if flags & 1 << _FLAT == 0:
            for beam in range(pad):
                out[beam] = vectors[2 * axes + beam]
        elif flags & 1 << _LEVEL == 0:
            for beam in range(pad):
                out[beam] = cosine[beam] * vectors[beam] + sine[beam] * vectors[axes + beam]
        else:
            for beam in range(pad):
                turned = cosine[beam] * vectors[beam] + sine[beam] * vectors[axes + beam]
                out[beam] = turned + vectors[2 * axes + beam]

    return combine
