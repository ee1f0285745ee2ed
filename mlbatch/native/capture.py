"""Compiled loops over captures: frames in records, bytes of packets."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array, U64Array
from mlbatch.native.library import library

# Why a walk ended: no room for more frames, no whole record, a frame that is too long.
NO_ROOM, CUT, TOO_LONG = range(3)
# Room for frames of one walk.
_ROOM = 1 << 14


class CaptureLoops:
    """The loops over captures."""

    def __init__(self) -> None:
        self._library = library()

    def walk(
        self, data: U8Array, begin: int, end: int, is_swapped: bool, unit_ns: int, most_bytes: int
    ) -> tuple[I64Array, int, int]:
        """Return the records of `data[begin:end]`, where they end, and why there.

        The records are columns (4, n): first byte, captured and original length, receive time.
        """
        if begin < 0 or end > len(data):
            raise IndexError(f"bytes {begin} to {end} of {len(data)}")
        columns = np.empty((4, _ROOM), np.int64)
        stop = np.empty(2, np.int64)
        count = self._library.mlbatch_walk(
            data, begin, end, is_swapped, unit_ns, most_bytes, _ROOM, columns, stop
        )
        place, why = stop.tolist()
        return columns[:, :count], place, why

    def copy_runs(
        self, source: U8Array, start: I64Array, size: I64Array, out: U8Array, at_byte: I64Array
    ) -> None:
        """Copy `source[start[i] : start[i] + size[i]]` to `out[at_byte[i] : ...]` for all i."""
        if not len(start):
            return
        start, size, at_byte = map(np.ascontiguousarray, (start, size, at_byte))
        if bool(_is_outside(source, start, size).any() | _is_outside(out, at_byte, size).any()):
            raise IndexError("runs outside of their arrays")
        self._library.mlbatch_copy(len(start), source, start, size, out, at_byte)

    def sums(self, data: U8Array, start: I64Array, size: int) -> U64Array:
        """Return the checksums (n,) of packets of a size: sums of their 64-bit words, modulo 2^64.

        Of a size that is no multiple of 8, the last 8 bytes are a word as well; of less than 8, the
        bytes are summed. Every change of a single byte changes the sum; words that change places
        do not.
        """
        found = np.empty(len(start), np.uint64)
        if not len(start):
            return found
        start = np.ascontiguousarray(start)
        if int(start.min()) < 0 or int(start.max()) + size > len(data):
            raise IndexError("packets outside of their array")
        self._library.mlbatch_sums(len(start), data, start, size, found)
        return found


def _is_outside(data: U8Array, start: I64Array, size: I64Array) -> BoolArray:
    return np.asarray((start < 0) | (size < 0) | (size > len(data)) | (start > len(data) - size))
