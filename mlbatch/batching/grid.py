"""The absolute grid of windows; every bound of a window or slice is computed here.

Bounds are Python integers, rounded up once from the exact rational. They do not drift (15 Hz has no
whole period in ns) and do not overflow (a product of an int64 stamp and a rate would).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction

from mlbatch.errors import UsageError
from mlbatch.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class Grid:
    """Windows of 1 / rate seconds since time 0, each divided into `slices` equal slices.

    Slice j of window k has the number q = k * slices + j and covers [bound(q), bound(q + 1)). With
    one slice per window, q is the number of the window.
    """

    rate: Fraction
    slices: int = 1
    # Slices in `_per_ns` nanoseconds: of the rate, which gives its parts slowly.
    _count: int = field(init=False, repr=False, compare=False)
    _per_ns: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the values; UsageError where there would be no windows."""
        if self.rate <= 0:
            raise UsageError(f"rate: expected a positive number of Hz, found {self.rate}")
        if self.slices < 1:
            raise UsageError(f"slices: expected 1 or more per window, found {self.slices}")
        object.__setattr__(self, "_count", self.rate.numerator * self.slices)
        object.__setattr__(self, "_per_ns", NS_PER_S * self.rate.denominator)

    def bound(self, q: int) -> int:
        """First nanosecond of slice `q`: ceil(q * 1e9 / (rate * slices))."""
        return -(-q * self._per_ns // self._count)

    def index_of(self, stamp_ns: int) -> int:
        """The slice q with bound(q) <= stamp_ns < bound(q + 1)."""
        # For an integer n, n >= ceil(x) is the same as n >= x, so the floor is exact.
        return int(stamp_ns) * self._count // self._per_ns

    def floor_bound(self, stamp_ns: int) -> int:
        """First nanosecond of the slice that contains `stamp_ns`."""
        return self.bound(self.index_of(stamp_ns))

    def first_window(self, t0max_ns: int) -> int:
        """Eq. (1): k0, the number of the first window that begins after `t0max_ns`.

        k0 counts windows; its first slice is k0 * slices. If `t0max_ns` is itself a bound, k0 is
        the window one period later ("larger than" in the paper).
        """
        scaled = int(t0max_ns) * self.rate.numerator
        return scaled // (NS_PER_S * self.rate.denominator) + 1
