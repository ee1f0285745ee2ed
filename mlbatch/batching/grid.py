"""The absolute grid of windows (CONTRACT.md section 1): all scan boundaries come from here.

Bounds are Python integers, rounded up once from the exact rational: no drift, also at 15 Hz, and
no overflow (products of int64 stamps and rates would).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from mlbatch.errors import UsageError
from mlbatch.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class Grid:
    """Windows of 1 / rate seconds since time 0, each cut into `slices` equal slices.

    Slices are numbered through: slice j of window k is q = k * slices + j, and covers
    [bound(q), bound(q + 1)), half open. With one slice q is the window itself.
    """

    rate: Fraction
    slices: int = 1

    def __post_init__(self) -> None:
        """Refuse a grid without windows."""
        if self.rate <= 0:
            raise UsageError(f"rate: wanted a positive number of Hz, got {self.rate}")
        if self.slices < 1:
            raise UsageError(f"slices: wanted 1 or more a window, got {self.slices}")

    def bound(self, q: int) -> int:
        """First nanosecond of slice `q`: ceil(q * 1e9 / (rate * slices))."""
        return -(-q * NS_PER_S * self.rate.denominator // (self.rate.numerator * self.slices))

    def index_of(self, stamp_ns: int) -> int:
        """The slice q with bound(q) <= stamp_ns < bound(q + 1)."""
        # An integer is at or past ceil(x) exactly when it is at or past x: the floor is the answer.
        scaled = int(stamp_ns) * self.rate.numerator * self.slices
        return scaled // (NS_PER_S * self.rate.denominator)

    def floor_bound(self, stamp_ns: int) -> int:
        """First nanosecond of the slice that holds `stamp_ns`."""
        return self.bound(self.index_of(stamp_ns))

    def first_window(self, t0max_ns: int) -> int:
        """Eq. (1): k0, the first window that begins after `t0max_ns`.

        k0 counts whole windows, so its first slice is k0 * slices. A `t0max_ns` that lies on the
        grid waits one more period, as printed in the paper.
        """
        scaled = int(t0max_ns) * self.rate.numerator
        return scaled // (NS_PER_S * self.rate.denominator) + 1
