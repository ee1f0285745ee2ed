"""Records and byte runs at any places of one array, many at once."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array

# A structured array; numpy has no type for the fields of a dtype.
Records: TypeAlias = npt.NDArray[Any]

# Bytes required after the end of the data: no record layout is longer.
SLACK = 128


def records(data: U8Array, layout: np.dtype[np.void], at: I64Array) -> Records:
    """The `layout` records that begin at bytes `at`; all must be within `data`."""
    return _windows(data, layout.itemsize)[at].view(layout)


def single(value: int) -> I64Array:
    """A number as (1,) int64."""
    return np.array([value], np.int64)


def copy_runs(source: U8Array, start: I64Array, size: I64Array, out: U8Array, at: I64Array) -> None:
    """Copy `source[start[i] : start[i] + size[i]]` to `out[at[i] : ...]` for all i.

    Runs of one size are copied together, as elements of that many bytes: ten times faster than a
    loop over slices. Targets must not overlap each other or any source.
    """
    # np.unique would import numpy.ma.
    for length in sorted(set(size.tolist())):
        if length:
            rows = np.flatnonzero(size == length)
            _windows(out, length)[at[rows]] = _windows(source, length)[start[rows]]


def _windows(data: U8Array, length: int) -> npt.NDArray[np.void]:
    """Every run of `length` bytes of `data` as one element; they overlap."""
    element = np.dtype((np.void, length))
    count = len(data) - length + 1
    windows: npt.NDArray[np.void] = np.ndarray((count,), element, data, strides=(1,))
    return windows
