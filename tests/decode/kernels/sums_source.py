"""A small kernel for the tests of `native.py`: frame (address of int64, how many); their sum."""

from __future__ import annotations

from collections.abc import Callable

from mlbatch.decode.kernels._primitives import Pointer, i8_at, i8_scratch, piece


@piece
def _sum(values: Pointer, count: int) -> int:
    total = 0
    for number in range(count):
        total += values[number]
    return total


def build(times: int) -> Callable[[Pointer], int]:
    """times: factor of the sum."""

    def kernel(frame: Pointer) -> int:
        kept = i8_scratch(4)
        kept[0] = _sum(i8_at(frame[0]), frame[1])
        return int(kept[0] * times)

    return kernel
