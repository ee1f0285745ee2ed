"""The median, as numpy has it."""

from __future__ import annotations

import math

import numpy as np

from mlbatch.types import F64Array, I64Array


def median(values: F64Array | I64Array) -> float:
    """Of all values of an array: that of `numpy.median`, bit by bit; NaN where one of them is.

    numpy's loads all of its masked arrays to look for NaN: a thirtieth of a short run.
    """
    count = values.size
    if not count:
        return math.nan
    low, high = (count - 1) // 2, count // 2
    # NaN comes last.
    ordered = np.partition(values, (low, high, count - 1), axis=None)
    if ordered[-1] != ordered[-1]:
        return math.nan
    return float(ordered[low : high + 1].mean())
