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


def test_bounds_at_15_hz_by_hand() -> None:
    # 1e9 / 15 = 66 666 666.67 ns; each bound is rounded up, every third is a whole number.
    grid = Grid(Fraction(15))
    assert [grid.bound(q) for q in range(5)] == [0, 66666667, 133333334, 200000000, 266666667]
    # 100 years of 365 days are 3 153 600 000 s: 47 304 000 000 windows later, to the nanosecond.
    assert grid.bound(47_304_000_000) == 3_153_600_000_000_000_000


def test_bounds_at_29_97_hz_by_hand() -> None:
    # 2997 windows last exactly 100 s.
    grid = Grid(Fraction("29.97"))
    assert grid.bound(2997) == 100 * 10**9
    # 1e11 / 2997 = 33 366 700.033...
    assert grid.bound(1) == 33_366_701


def test_slices_of_a_window_by_hand() -> None:
    # 0.1 s in three: 33 333 333.33 and 66 666 666.67 ns after the start, rounded up.
    grid = Grid(Fraction(10), slices=3)
    assert [grid.bound(q) for q in range(3, 7)] == [100000000, 133333334, 166666667, 200000000]


@pytest.mark.parametrize(
    ("stamp_ns", "index"),
    [
        (0, 0),
        (66666666, 0),
        (66666667, 1),
        (133333333, 1),
        (133333334, 2),
        (200000000, 3),
        (-1, -1),
    ],
)
def test_index_at_15_hz_by_hand(stamp_ns: int, index: int) -> None:
    assert Grid(Fraction(15)).index_of(stamp_ns) == index


@pytest.mark.parametrize(
    ("t0max_ns", "k0"),
    [
        (0, 1),
        (1, 1),
        (99_999_999, 1),
        # On the grid: one more period, as printed in the paper.
        (100_000_000, 2),
        (1_700_000_000_012_345_678, 17_000_000_001),
    ],
)
def test_first_window_at_10_hz_by_hand(t0max_ns: int, k0: int) -> None:
    assert Grid(Fraction(10)).first_window(t0max_ns) == k0


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
    with pytest.raises(UsageError, match=r"^slices: expected 1 or more a window, found 0$"):
        Grid(Fraction(10), slices=0)
