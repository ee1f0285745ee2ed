"""Time stamps of pcapng interfaces as int64 nanoseconds, exactly (rounded down).

Options if_tsresol and if_tsoffset: draft-ietf-opsawg-pcapng, section 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array
from mlbatch.units import NS_PER_S

U64Array: TypeAlias = npt.NDArray[np.uint64]

_BINARY = 0x80
# Up to here the nanoseconds of a second times the ticks of a second stay below 2^64.
_MOST_EXACT = 1 << 34
# Stamps beyond int64 nanoseconds come from damaged files; they stay at the bound.
_MOST_S = (1 << 63) // NS_PER_S - 1


@dataclass(frozen=True, slots=True)
class Resolution:
    """Ticks in a second, and the seconds at tick 0."""

    per_second: int
    offset_s: int

    @classmethod
    def of(cls, code: int, offset_s: int) -> Resolution:
        """From if_tsresol: n for 10^-n s, or 0x80 | n for 2^-n s."""
        exponent = code & ~_BINARY
        return cls((2 if code & _BINARY else 10) ** exponent, offset_s)

    def ns(self, ticks: U64Array) -> I64Array:
        """(n,) nanoseconds of (n,) ticks."""
        if self.per_second > _MOST_EXACT:
            return self._slow_ns(ticks)
        per_second = np.uint64(self.per_second)
        seconds = ticks // per_second
        rest_ns = (ticks % per_second) * np.uint64(NS_PER_S) // per_second
        # Bounded so that the sum of both stays within int64.
        whole = np.minimum(seconds, np.uint64(1 << 62)).astype(np.int64)
        offset_s = min(max(self.offset_s, -(1 << 61)), 1 << 61)
        whole_ns: I64Array = np.clip(whole + offset_s, -_MOST_S, _MOST_S) * NS_PER_S
        whole_ns += rest_ns.astype(np.int64)
        return whole_ns

    def _slow_ns(self, ticks: U64Array) -> I64Array:
        bound_ns = _MOST_S * NS_PER_S
        exact = [
            tick * NS_PER_S // self.per_second + self.offset_s * NS_PER_S for tick in ticks.tolist()
        ]
        return np.array([min(max(ns, -bound_ns), bound_ns) for ns in exact], np.int64)
