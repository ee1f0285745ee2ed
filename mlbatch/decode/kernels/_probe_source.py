"""The least kernel: whether it compiles tells whether others will."""

from __future__ import annotations

from collections.abc import Callable

from mlbatch.decode.kernels._primitives import Pointer


def build() -> Callable[[Pointer], int]:
    """Gives back the first number of its frame."""

    def kernel(frame: Pointer) -> int:
        return int(frame[0])

    return kernel
