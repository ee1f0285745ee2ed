"""The grid of windows, once more in plain Python: a proof shares no code with what it proves.

CONTRACT.md, section 1: `bound(k) = ceil(k * 1e9 / rate)` of the exact rational rate; slice j of
window k is number q = k * slices + j of a grid `slices` times as fine.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

_NS = 10**9


@dataclass(frozen=True, slots=True)
class Lines:
    """The lines of the grid, in ns."""

    rate: Fraction
    slices: int

    def bound(self, q: int) -> int:
        """First nanosecond of slice q."""
        whole, rest = divmod(q * _NS * self.rate.denominator, self.rate.numerator * self.slices)
        return whole + (rest > 0)

    def number(self, stamp_ns: int) -> int:
        """The slice that holds a stamp."""
        q = stamp_ns * self.rate.numerator * self.slices // (_NS * self.rate.denominator)
        return q + 1 if self.bound(q + 1) <= stamp_ns else q
