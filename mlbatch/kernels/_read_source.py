"""Pieces of the decoding kernel: the readings of one column to ranges and levels.

Loops run over beams and nothing else, so that they are vectorised. Where a pixel is made of whole
words, fields are bits of these; else a distance is two bytes, with a byte for the level behind.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from mlbatch.kernels import frame as at
from mlbatch.kernels._primitives import Pointer, bits, f4_at, i8_at, piece, u1_at, u4_at

# Of the row of bit fields of a return.
_LEVEL, _REFLECTIVITY, _FIELDS = 3, 6, 9
_RUN = 3

Reader = Callable[[Pointer, int, int, Pointer, Pointer, Pointer], None]


@cache
def reader_of(word: str, step: int, pad: int) -> Reader:
    """`(frame, record, return, ranges, levels, reflectivities)` for pixels of `step` bytes."""
    return _words_reader(step // 4, pad) if word == "<u4" else _bytes_reader(word, step, pad)


def _words_reader(step: int, pad: int) -> Reader:
    """Fields are bits of whole words, `step` words from channel to channel."""

    @piece
    def read(
        frame: Pointer, record: int, which: int, ranges: Pointer, levels: Pointer, others: Pointer
    ) -> None:
        runs, fields = i8_at(frame[at.RUNS]), i8_at(frame[at.FIELDS])
        scale = f4_at(frame[at.SCALE])
        factor, divisor, silent = scale[0], scale[1], frame[at.SILENT]
        first, row = which * pad, which * _FIELDS
        begin, beams = record + runs[which * _RUN], runs[which * _RUN + 2]
        words = u4_at(begin + 4 * fields[row])
        shift, mask = fields[row + 1], fields[row + 2]
        for beam in range(beams):
            distance = bits(words[beam * step], shift, mask)
            metres = np.float32(distance) * factor / divisor
            ranges[first + beam] = metres if distance > silent else np.float32(0)
        words = u4_at(begin + 4 * fields[row + _LEVEL])
        shift, mask = fields[row + _LEVEL + 1], fields[row + _LEVEL + 2]
        for beam in range(beams):
            levels[first + beam] = np.float32(bits(words[beam * step], shift, mask))
        if frame[at.HAS_REFLECTIVITY] != 0:
            words = u4_at(begin + 4 * fields[row + _REFLECTIVITY])
            shift, mask = fields[row + _REFLECTIVITY + 1], fields[row + _REFLECTIVITY + 2]
            for beam in range(beams):
                others[first + beam] = bits(words[beam * step], shift, mask)

    return read


def _bytes_reader(word: str, step: int, pad: int) -> Reader:
    """A distance of two bytes and a level behind it, in several runs of channels."""

    low, high = (0, 1) if word == "<u2" else (1, 0)

    @piece
    def read(
        frame: Pointer, record: int, which: int, ranges: Pointer, levels: Pointer, others: Pointer
    ) -> None:
        runs, fields = i8_at(frame[at.RUNS]), i8_at(frame[at.FIELDS])
        scale = f4_at(frame[at.SCALE])
        factor, divisor, silent = scale[0], scale[1], frame[at.SILENT]
        mask = fields[which * _FIELDS + 2]
        for run in range(which * frame[at.RUN_COUNT], (which + 1) * frame[at.RUN_COUNT]):
            pixels = u1_at(record + runs[run * _RUN])
            first = which * pad + runs[run * _RUN + 1]
            for beam in range(runs[run * _RUN + 2]):
                place = beam * step
                number = pixels[place + low] | pixels[place + high] << 8
                distance = bits(number, 0, mask)
                metres = np.float32(distance) * factor / divisor
                ranges[first + beam] = metres if distance > silent else np.float32(0)
                levels[first + beam] = np.float32(pixels[place + 2])
        dark = i8_at(frame[at.DARK])
        for number in range(frame[at.DARK_COUNT]):
            ranges[which * pad + dark[number]] = np.float32(0)

    return read
