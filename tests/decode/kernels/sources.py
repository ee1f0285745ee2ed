"""A small kernel for tests, and the marker that skips such tests without numba."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.decode.kernels import is_installed, native

SUMS = "tests.decode.kernels.sums_source"
needs_numba = pytest.mark.skipif(
    not is_installed(), reason="numba is not installed: pip install mlbatch[fast]"
)


def total(values: list[int], times: int) -> int:
    """Result of the kernel of SUMS for some numbers."""
    numbers = np.array(values, np.int64)
    frame = np.array([numbers.ctypes.data, len(numbers)], np.int64)
    return native.load(SUMS, times)(frame)
