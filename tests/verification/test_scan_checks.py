"""The grid of windows, against its definition."""

from __future__ import annotations

from fractions import Fraction
from math import ceil

from hypothesis import given
from hypothesis import strategies as st

from mlbatch.verification.scan_checks import Grid

RATES = st.fractions(Fraction(1, 4), 1000, max_denominator=1001)


@given(RATES, st.integers(1, 12), st.integers(0, 2**31 * 10**9 - 1))
def test_every_stamp_lies_in_one_slice(rate: Fraction, slices: int, stamp_ns: int) -> None:
    grid = Grid(rate, slices)
    q = grid.number(stamp_ns)
    assert grid.bound(q) <= stamp_ns < grid.bound(q + 1)
    assert grid.bound(q) == ceil(q * 10**9 / (rate * slices))


def test_bounds_by_hand() -> None:
    # 15 Hz: 66666666.67 ns, rounded up each time.
    grid = Grid(Fraction(15), 1)
    assert [grid.bound(q) for q in range(4)] == [0, 66_666_667, 133_333_334, 200_000_000]
    assert grid.number(66_666_666) == 0
    assert grid.number(66_666_667) == 1
