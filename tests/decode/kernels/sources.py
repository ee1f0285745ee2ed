"""A small kernel to test with, and where such tests are skipped."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.decode.kernels import is_installed, native

SUMS = "tests.decode.kernels.sums_source"
needs_numba = pytest.mark.skipif(
    not is_installed(), reason="numba is not installed: pip install mlbatch[fast]"
)


def total(values: list[int], times: int) -> int:
    """What the kernel of SUMS makes of numbers."""
    numbers = np.array(values, np.int64)
    frame = np.array([numbers.ctypes.data, len(numbers)], np.int64)
    return native.load(SUMS, times)(frame)
