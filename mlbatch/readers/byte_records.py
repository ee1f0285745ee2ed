"""Records at any places of one array, many at once."""

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
    # Every run of so many bytes as one element; they overlap.
    element = np.dtype((np.void, layout.itemsize))
    count = len(data) - layout.itemsize + 1
    windows: npt.NDArray[np.void] = np.ndarray((count,), element, data, strides=(1,))
    return windows[at].view(layout)


def rows(data: U8Array, start: I64Array, size: int) -> U8Array:
    """Copies (n, size) of the bytes from each `start` on; all must be within `data`."""
    found: U8Array = records(data, np.dtype([("byte", "u1", (size,))]), start)["byte"]
    return found


def single(value: int) -> I64Array:
    """A number as (1,) int64."""
    return np.array([value], np.int64)
