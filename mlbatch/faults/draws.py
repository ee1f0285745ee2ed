"""Random numbers that depend only on the packet that they are drawn for.

The n-th number of SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators,
OOPSLA 2014) is a function of n. So a fault affects the same packets however a recording is cut
into batches, files or containers.
"""

from __future__ import annotations

import zlib
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array

U64Array: TypeAlias = npt.NDArray[np.uint64]

_STEP = 0x9E3779B97F4A7C15
_WORD = 2**64 - 1
# Bits of a float's significand: probabilities up to 1 become integer thresholds.
_PROBABILITY_BITS = 53


def stream_state(seed: int, fault: int, sensor: str) -> int:
    """Start of the number sequence of a fault (its index in the list) and a sensor."""
    state = 0
    for word in (seed & _WORD, fault, zlib.crc32(sensor.encode())):
        state = int(_mixed(np.array([(state ^ word) + _STEP & _WORD], np.uint64))[0])
    return state


def draw(state: U64Array, number: I64Array) -> U64Array:
    """The number-th number (from 0) of each sequence; both (n,)."""
    step = np.uint64(_STEP)
    return _mixed(state + (number.astype(np.uint64) + np.uint64(1)) * step)


def is_below(drawn: U64Array, probability: float) -> BoolArray:
    """Whether each number is in the lowest part, of this size (0 to 1), of all numbers."""
    limit = np.uint64(round(probability * 2**_PROBABILITY_BITS))
    below: BoolArray = drawn >> np.uint64(64 - _PROBABILITY_BITS) < limit
    return below


def second_draw(drawn: U64Array) -> U64Array:
    """Another number for each, independent of whether the first one was below a probability."""
    return _mixed(drawn + np.uint64(_STEP))


def _mixed(state: U64Array) -> U64Array:
    """The output function of SplitMix64."""
    state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    mixed: U64Array = state ^ state >> np.uint64(31)
    return mixed
