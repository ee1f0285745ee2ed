"""Windows partition time, exactly and without drift."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mlbatch.batching.grid import Grid
from mlbatch.errors import UsageError

STAMPS = st.integers(min_value=0, max_value=2**31 * 10**9)
RATES = st.fractions(min_value=Fraction(1, 4), max_value=10**6, max_denominator=10**12)
SLICES = st.integers(min_value=1, max_value=64)


@given(STAMPS, RATES, SLICES)
@example(2**31 * 10**9 - 1, Fraction(15), 1)
@example(1_700_000_000_000_000_000, Fraction(30000, 1001), 7)
def test_every_stamp_lies_in_exactly_one_slice(stamp_ns: int, rate: Fraction, slices: int) -> None:
    grid = Grid(rate, slices)
    q = grid.index_of(stamp_ns)
    assert grid.bound(q) <= stamp_ns < grid.bound(q + 1)
    # Bounds never step back, so no other slice contains the stamp.
    assert grid.bound(q - 1) <= grid.bound(q) <= grid.bound(q + 1) <= grid.bound(q + 2)
    assert grid.floor_bound(stamp_ns) == grid.bound(q)


@given(st.integers(min_value=0, max_value=2**50), RATES, SLICES)
def test_bound_is_the_first_nanosecond_of_the_exact_bound(
    q: int, rate: Fraction, slices: int
) -> None:
    exact = Fraction(q) / (rate * slices) * 10**9
    bound = Grid(rate, slices).bound(q)
    assert bound - 1 < exact <= bound


@given(st.integers(min_value=0, max_value=2**40), RATES, SLICES)
def test_slices_begin_and_end_with_their_window(k: int, rate: Fraction, slices: int) -> None:
    assert Grid(rate, slices).bound(k * slices) == Grid(rate).bound(k)


@given(STAMPS, RATES, SLICES)
def test_first_window_is_the_next_one_to_begin(t0max: int, rate: Fraction, slices: int) -> None:
    grid = Grid(rate)
    k0 = grid.first_window(t0max)
    assert grid.bound(k0 - 1) <= t0max < grid.bound(k0)
    # Slices do not move eq. (1).
    assert Grid(rate, slices).first_window(t0max) == k0


def test_a_grid_without_windows_is_refused() -> None:
    with pytest.raises(UsageError, match=r"^rate: expected a positive number of Hz, found 0$"):
        Grid(Fraction(0))
    with pytest.raises(UsageError, match=r"^slices: expected 1 or more per window, found 0$"):
        Grid(Fraction(10), slices=0)
