"""Compiled loops over captures: frames in records, datagrams and fragments in frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array, U64Array
from mlbatch.native.library import address, library

# Why a walk ended: no room for more frames, no whole record, a frame that is too long.
NO_ROOM, CUT, TOO_LONG = range(3)
# Room for frames of one walk.
_ROOM = 1 << 14
# Open sets of fragments that `join` leaves out, at most.
JOIN_SETS = 64


class Found(NamedTuple):
    """Rows of Ethernet frames: columns of datagrams (5, n) and fragments (8, n); other frames."""

    datagrams: I64Array
    fragments: I64Array
    others: I64Array


class CaptureLoops:
    """The loops over captures; the same results as numpy's."""

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
            address(data),
            begin,
            end,
            is_swapped,
            unit_ns,
            most_bytes,
            _ROOM,
            address(columns),
            address(stop),
        )
        place, why = stop.tolist()
        return columns[:, :count], place, why

    def dissect(
        self, data: U8Array, start: I64Array, captured: I64Array, original: I64Array
    ) -> Found:
        """Return what Ethernet frames (n,) contain that are IPv4 without tags, and the others."""
        count = len(start)
        inputs = [np.ascontiguousarray(column) for column in (start, captured, original)]
        datagrams = np.empty((5, count), np.int64)
        fragments = np.empty((8, count), np.int64)
        others = np.empty(count, np.int64)
        found = np.empty(2, np.int64)
        whole = self._library.mlbatch_dissect(
            address(data),
            len(data),
            count,
            *map(address, inputs),
            *map(address, (datagrams, fragments, others, found)),
        )
        parts, rest = found.tolist()
        return Found(datagrams[:, :whole], fragments[:, :parts], others[:rest])

    def join(
        self,
        data: U8Array,
        fragments: I64Array,
        receive_ns: I64Array,
        most_ns: int,
        open_sets: Sequence[tuple[int, int, int]],
    ) -> tuple[I64Array, I64Array]:
        """Join fragments whose frames follow each other, moving them together within `data`.

        fragments: columns (8, n) as `dissect` found them; receive_ns: (n,) rising. Sets that are
        open, at most JOIN_SETS, or have other fragments before are left, as are those that took
        longer than `most_ns`. Return columns of datagrams (5, n), and rows of what is left.
        """
        count = fragments.shape[1]
        start, size = fragments[6:]
        if bool(_is_outside(data, start, size).any()) or len(receive_ns) != count:
            raise IndexError("fragments outside of their array")
        fragments, receive_ns = map(np.ascontiguousarray, (fragments, receive_ns))
        sets = np.zeros((JOIN_SETS, 3), np.int64)
        sets[: len(open_sets)] = np.array(open_sets, np.int64).reshape(-1, 3)
        datagrams = np.empty((5, count), np.int64)
        rest = np.empty(count, np.int64)
        left = np.empty(1, np.int64)
        whole = self._library.mlbatch_join(
            address(data),
            count,
            address(fragments),
            address(receive_ns),
            most_ns,
            len(open_sets),
            JOIN_SETS,
            *map(address, (sets, datagrams, rest, left)),
        )
        return datagrams[:, :whole], rest[: int(left[0])]

    def copy_runs(
        self, source: U8Array, start: I64Array, size: I64Array, out: U8Array, at_byte: I64Array
    ) -> None:
        """Copy `source[start[i] : start[i] + size[i]]` to `out[at_byte[i] : ...]` for all i."""
        if not len(start):
            return
        start, size, at_byte = map(np.ascontiguousarray, (start, size, at_byte))
        if bool(_is_outside(source, start, size).any() | _is_outside(out, at_byte, size).any()):
            raise IndexError("runs outside of their arrays")
        self._library.mlbatch_copy(
            len(start),
            address(source),
            address(start),
            address(size),
            address(out),
            address(at_byte),
        )

    def gather(self, data: U8Array, start: I64Array, ranges: I64Array, out: U8Array) -> None:
        """Copy ranges (k, 2), first byte and bytes, of packets to the same bytes of rows of `out`.

        start: (n,) of the packets in `data`; out: (n, bytes of a packet).
        """
        if not len(start):
            return
        start, ranges = map(np.ascontiguousarray, (start, ranges))
        size = out.shape[1]
        is_wrong = int(start.min()) < 0 or int(start.max()) + size > len(data)
        if is_wrong or int(ranges.min()) < 0 or int(ranges.sum(axis=1).max()) > size:
            raise IndexError("packets outside of their array")
        self._library.mlbatch_gather(
            len(start),
            address(data),
            address(start),
            len(ranges),
            address(ranges),
            size,
            address(out),
        )

    def sums(self, data: U8Array, start: I64Array, size: int) -> U64Array:
        """Return the checksums (n,) of packets of a size; as `packet_ring.packet_sums`."""
        found = np.empty(len(start), np.uint64)
        if not len(start):
            return found
        start = np.ascontiguousarray(start)
        if int(start.min()) < 0 or int(start.max()) + size > len(data):
            raise IndexError("packets outside of their array")
        self._library.mlbatch_sums(len(start), address(data), address(start), size, address(found))
        return found


def _is_outside(data: U8Array, start: I64Array, size: I64Array) -> BoolArray:
    return np.asarray((start < 0) | (size < 0) | (size > len(data)) | (start > len(data) - size))
