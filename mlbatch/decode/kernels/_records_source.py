"""Pieces of kernels: where the records of columns lie."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, fetch, i8_at, moved, piece

_RING = 5
NO_RECORD = 0
# Records are asked for so many columns before they are read: neighbours in a scan lie apart, so
# that no CPU foresees where.
AHEAD, _LINE_BYTES = 2, 64


@cache
def asking() -> Callable[[Pointer, int], int]:
    """`(frame, column)` gives the address of a column's record."""

    @piece
    def ask(frame: Pointer, column: int) -> int:
        """The record is asked for; NO_RECORD if it is of other kinds."""
        member = i8_at(frame[at.MEMBER])[i8_at(frame[at.SENSOR])[column]]
        if member < 0:
            return NO_RECORD
        ring = moved(i8_at(frame[at.RINGS]), member * _RING)
        place, part = i8_at(frame[at.PLACE])[column], 0
        if ring[2] != 1:
            part = place % ring[2]
            place = place // ring[2]
        record = int(ring[0] + place % ring[1] * ring[3] + part * ring[4])
        for byte in range(0, frame[at.RECORD_BYTES] + _LINE_BYTES - 1, _LINE_BYTES):
            fetch(record + byte)
        return record

    return ask
