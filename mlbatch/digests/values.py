"""JSON values, and numbers as short texts give them back."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float | bool | None"

# Digits of means: sums of float64 may differ in the last ones between processors.
_MEAN_DIGITS = 10


def values(array: npt.NDArray[Any]) -> Json:
    """Numbers of an array as nested lists; reals in the digits that give them back, NaN as null."""
    if array.ndim:
        return [values(one) for one in array]
    if array.dtype.kind != "f":
        found: int = array.item()
        return found
    return _real(float(str(array[()])))


def mean(array: npt.NDArray[Any]) -> Json:
    """Means over the first axis, rounded."""
    found = np.mean(array, axis=0, dtype=np.float64)
    rounded = [_real(float(f"{one:.{_MEAN_DIGITS}g}")) for one in np.atleast_1d(found)]
    return rounded[0] if found.ndim == 0 else list(rounded)


def _real(value: float) -> float | None:
    return value if math.isfinite(value) else None
