"""Pieces of the decoding kernel: the readings of one column to ranges and levels.

Pixels are taken apart into planes first, so that all loops run over beams and nothing else, as many
as the kernel is compiled for, and are vectorised. Where a pixel is made of whole words, fields are
bits of these; else a distance is two bytes, with a byte for the level behind.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import (
    TOGETHER,
    Pointer,
    bits,
    f4_at,
    i8_at,
    moved,
    piece,
    take_apart,
    u1_at,
    u4_at,
)

# Of the row of bit fields of a return.
_LEVEL, _REFLECTIVITY, _FIELDS = 3, 6, 9
_RUN = 3

# `(frame, record, return, planes, ranges, levels, reflectivities)`; planes: scratch of `step * pad`
# words or bytes, all zero before the first column.
Reader = Callable[[Pointer, int, int, Pointer, Pointer, Pointer, Pointer], None]


@cache
def reader_of(word: str, step: int, pad: int) -> Reader:
    """For pixels of `step` bytes."""
    return _words_reader(step // 4, pad) if word == "<u4" else _bytes_reader(word, step, pad)


def _words_reader(step: int, pad: int) -> Reader:
    """Fields are bits of whole words, `step` words from channel to channel."""

    spread = _spread(step, pad)

    @piece
    def read(
        frame: Pointer,
        record: int,
        which: int,
        planes: Pointer,
        ranges: Pointer,
        levels: Pointer,
        others: Pointer,
    ) -> None:
        run, fields = moved(i8_at(frame[at.RUNS]), which * _RUN), i8_at(frame[at.FIELDS])
        scale = f4_at(frame[at.SCALE])
        factor, divisor, silent = scale[0], scale[1], np.int32(frame[at.SILENT])
        first, row = which * pad, which * _FIELDS
        if step == 1 and run[2] == pad:
            # Already a plane, and whole.
            planes = u4_at(record + run[0])
        else:
            spread(u4_at(record + run[0]), run[2], planes)
        words = moved(planes, fields[row] * pad)
        shift, mask = fields[row + 1], fields[row + 2]
        for beam in range(pad):
            distance = bits(words[beam], shift, mask)
            metres = np.float32(distance) * factor / divisor
            ranges[first + beam] = metres if distance > silent else np.float32(0)
        words = moved(planes, fields[row + _LEVEL] * pad)
        shift, mask = fields[row + _LEVEL + 1], fields[row + _LEVEL + 2]
        for beam in range(pad):
            levels[first + beam] = np.float32(bits(words[beam], shift, mask))
        if frame[at.HAS_REFLECTIVITY] != 0:
            words = moved(planes, fields[row + _REFLECTIVITY] * pad)
            shift, mask = fields[row + _REFLECTIVITY + 1], fields[row + _REFLECTIVITY + 2]
            for beam in range(pad):
                others[first + beam] = bits(words[beam], shift, mask)

    return read


def _bytes_reader(word: str, step: int, pad: int) -> Reader:
    """A distance of two bytes and a level behind it, in several runs of channels."""

    low, high = (0, pad) if word == "<u2" else (pad, 0)
    level = 2 * pad
    spread = _spread(step, pad)

    @piece
    def read(
        frame: Pointer,
        record: int,
        which: int,
        planes: Pointer,
        ranges: Pointer,
        levels: Pointer,
        others: Pointer,
    ) -> None:
        runs, fields = i8_at(frame[at.RUNS]), i8_at(frame[at.FIELDS])
        scale = f4_at(frame[at.SCALE])
        factor, divisor, silent = scale[0], scale[1], np.int32(frame[at.SILENT])
        mask, first = fields[which * _FIELDS + 2], which * pad
        for number in range(which * frame[at.RUN_COUNT], (which + 1) * frame[at.RUN_COUNT]):
            run = moved(runs, number * _RUN)
            spread(u1_at(record + run[0]), run[2], moved(planes, run[1]))
        for beam in range(pad):
            pixel: Any = np.int32(planes[low + beam]) | np.int32(planes[high + beam]) << 8
            distance = bits(pixel, 0, mask)
            metres = np.float32(distance) * factor / divisor
            ranges[first + beam] = metres if distance > silent else np.float32(0)
            levels[first + beam] = np.float32(planes[level + beam])
        dark = i8_at(frame[at.DARK])
        for number in range(frame[at.DARK_COUNT]):
            ranges[first + dark[number]] = np.float32(0)

    return read


def _spread(step: int, pad: int) -> Callable[[Pointer, int, Pointer], None]:
    """Pixels of a run of channels to planes."""

    @piece
    def spread(pixels: Pointer, channels: int, planes: Pointer) -> None:
        if channels < TOGETHER:
            for channel in range(channels):
                for number in range(step):
                    planes[number * pad + channel] = pixels[channel * step + number]
            return
        for begin in range(0, channels, TOGETHER):
            # The last ones may be moved twice: nothing lies behind them that may be read.
            channel = min(begin, channels - TOGETHER)
            take_apart(moved(pixels, channel * step), moved(planes, channel), step, pad)

    return spread
