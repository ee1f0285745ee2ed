"""Compiled loops over captures, in place of many passes: the engine `numba`.

What they find is what numpy finds: frames in records, datagrams and fragments in frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.decode.kernels import capture as at

# Columns have room for so many frames at a time.
_ROOM = 1 << 14


@dataclass(slots=True)
class Found:
    """Rows of Ethernet frames: columns of datagrams (5, n) and fragments (8, n); other frames."""

    datagrams: I64Array
    fragments: I64Array
    others: I64Array


class CaptureKernel:
    """The kernel of captures, and its frame; not for several threads at a time."""

    def __init__(self) -> None:
        from mlbatch.decode.kernels import native

        self._kernel = native.load("mlbatch.decode.kernels._capture_source")
        self._frame = np.zeros(at.FRAME_SIZE, np.int64)

    def walk(
        self, data: U8Array, begin: int, end: int, is_swapped: bool, unit_ns: int, most_bytes: int
    ) -> tuple[I64Array, int, int]:
        """Records of `data[begin:end]`: (4, n) columns as in capture.py; where and why they end."""
        if begin < 0 or end > len(data):
            raise IndexError(f"bytes {begin} to {end} of {len(data)}")
        columns, frame = np.empty((4, _ROOM), np.int64), self._frame
        frame[at.TASK], frame[at.BYTES] = at.WALK, _address(data)
        frame[at.BEGIN], frame[at.END], frame[at.IS_SWAPPED] = begin, end, is_swapped
        frame[at.UNIT_NS], frame[at.MOST_BYTES], frame[at.ROOM] = unit_ns, most_bytes, _ROOM
        frame[at.START : at.HOST_NS + 1] = [_address(column) for column in columns]
        count = self._kernel(frame)
        return columns[:, :count], int(frame[at.NEXT]), int(frame[at.WHY])

    def dissect(
        self, data: U8Array, start: I64Array, captured: I64Array, original: I64Array
    ) -> Found:
        """What Ethernet frames (n,) hold that are IPv4 without tags; the others are numbered."""
        count, frame = len(start), self._frame
        inputs = [np.ascontiguousarray(column) for column in (start, captured, original)]
        datagrams, fragments = np.empty((5, count), np.int64), np.empty((8, count), np.int64)
        others = np.empty(count, np.int64)
        frame[at.TASK], frame[at.BYTES], frame[at.SIZE_BYTES] = (
            at.DISSECT,
            _address(data),
            len(data),
        )
        frame[at.START : at.ORIGINAL + 1] = [_address(column) for column in inputs]
        frame[at.FRAMES : at.OTHERS + 1] = [count, *map(_address, (datagrams, fragments, others))]
        found = self._kernel(frame)
        parts, rest = int(frame[at.FRAGMENTS_FOUND]), int(frame[at.OTHERS_FOUND])
        return Found(datagrams[:, :found], fragments[:, :parts], others[:rest])

    def copy_runs(
        self, source: U8Array, start: I64Array, size: I64Array, out: U8Array, at_byte: I64Array
    ) -> None:
        """Copy `source[start[i] : start[i] + size[i]]` to `out[at_byte[i] : ...]` for all i."""
        if not len(start):
            return
        frame = self._frame
        columns = [np.ascontiguousarray(column) for column in (start, size, at_byte)]
        if bool(
            _is_outside(source, columns[0], size).any() | _is_outside(out, at_byte, size).any()
        ):
            raise IndexError("runs beyond their arrays")
        frame[at.TASK], frame[at.RUNS] = at.COPY, len(start)
        frame[at.SOURCE], frame[at.TARGET] = _address(source), _address(out)
        places = (at.SOURCE_AT, at.RUN_BYTES, at.TARGET_AT)
        for place, column in zip(places, columns, strict=True):
            frame[place] = _address(column)
        self._kernel(frame)


def _is_outside(data: U8Array, start: I64Array, size: I64Array) -> BoolArray:
    return np.asarray((start < 0) | (size < 0) | (size > len(data)) | (start > len(data) - size))


def _address(array: U8Array | I64Array) -> int:
    """Where a C-contiguous array lies; nothing else keeps it there."""
    if not array.flags.c_contiguous:
        raise ValueError("wanted an array in one piece")
    return int(array.ctypes.data)
