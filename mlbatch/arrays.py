"""Names of array types, and what numpy does with more copies or modules."""

from __future__ import annotations

import math
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

U8Array: TypeAlias = npt.NDArray[np.uint8]
U16Array: TypeAlias = npt.NDArray[np.uint16]
U32Array: TypeAlias = npt.NDArray[np.uint32]
U64Array: TypeAlias = npt.NDArray[np.uint64]
I64Array: TypeAlias = npt.NDArray[np.int64]
F32Array: TypeAlias = npt.NDArray[np.float32]
F64Array: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
_Scalar = TypeVar("_Scalar", bound=np.generic)


def rows_of(array: npt.NDArray[_Scalar], mask: BoolArray) -> npt.NDArray[_Scalar]:
    """Return the rows of an array where a mask (n,) is true; the array itself where all are."""
    return array if mask.all() else array[mask]


def median(values: F64Array | I64Array) -> float:
    """Return the value of `numpy.median` over all elements, bit by bit; NaN if one of them is.

    `numpy.median` imports `numpy.ma` to look for NaN, a thirtieth of the time of a short run.
    """
    count = values.size
    if not count:
        return math.nan
    low = (count - 1) // 2
    high = count // 2
    # NaN is sorted to the end.
    ordered = np.partition(values, (low, high, count - 1), axis=None)
    if ordered[-1] != ordered[-1]:
        return math.nan
    return float(ordered[low : high + 1].mean())
