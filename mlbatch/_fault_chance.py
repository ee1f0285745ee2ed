"""Chance that depends on what it is about, and on nothing that was drawn before.

Numbers of SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, OOPSLA
2014), a generator whose n-th number is a function of n. So the same packet meets the same fault
however a recording is cut into batches, files or containers.
"""

from __future__ import annotations

import zlib
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.types import BoolArray, I64Array

U64Array: TypeAlias = npt.NDArray[np.uint64]

_STEP = 0x9E3779B97F4A7C15
_WORD = 2**64 - 1
# As many bits as a float holds: shares up to 1 become whole thresholds.
_SHARE_BITS = 53


def source(seed: int, fault: int, sensor: str) -> int:
    """Where the numbers of a fault (by its place in the list) and a sensor begin."""
    state = 0
    for word in (seed & _WORD, fault, zlib.crc32(sensor.encode())):
        state = int(_mixed(np.array([(state ^ word) + _STEP & _WORD], np.uint64))[0])
    return state


def draw(source: U64Array, number: I64Array) -> U64Array:
    """The number-th (from 0) number of each source, both (n,)."""
    step = np.uint64(_STEP)
    return _mixed(source + (number.astype(np.uint64) + np.uint64(1)) * step)


def falls_below(drawn: U64Array, share: float) -> BoolArray:
    """Which of the numbers lie in the lowest `share` (0 to 1) of all there can be."""
    limit = np.uint64(round(share * 2**_SHARE_BITS))
    below: BoolArray = drawn >> np.uint64(64 - _SHARE_BITS) < limit
    return below


def again(drawn: U64Array) -> U64Array:
    """A second number for each, independent of whether the first fell below a share."""
    return _mixed(drawn + np.uint64(_STEP))


def _mixed(state: U64Array) -> U64Array:
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    mixed: U64Array = state ^ state >> np.uint64(31)
    return mixed
