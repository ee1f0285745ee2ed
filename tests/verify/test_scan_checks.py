"""Parts of the proof on their own: grid, order of the verdict, numbers of judged things."""

from __future__ import annotations

from fractions import Fraction
from math import ceil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import MlbatchError
from mlbatch.verify import CHECKS, VerifyError
from mlbatch.verify.scan_checks import Grid
from mlbatch.verify.verdict import MAX_KEPT, CheckLog

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


def test_a_judge_names_the_first_and_counts_all() -> None:
    log = CheckLog()
    bad = np.array([False, True, True])
    assert not log.none("finite", "a.npz point", bad, "numbers", lambda at: f"value {at}")
    (violation,) = log.violations
    assert str(violation) == "finite: a.npz point 1: expected numbers, found value 1 (2 of 3)"
    outcome = {check.name: check for check in log.outcomes({"order": "no columns"})}
    assert (outcome["finite"].outcome, outcome["finite"].checked) == ("violated", 3)
    assert (outcome["order"].outcome, outcome["order"].limit) == ("not checkable", "no columns")
    assert list(outcome) == list(CHECKS)


def test_violations_are_kept_up_to_a_limit() -> None:
    log = CheckLog()
    for _ in range(MAX_KEPT + 7):
        log.fail("grid", "here", 1, 2)
    assert len(log.violations) == MAX_KEPT
    assert log.failed["grid"] == MAX_KEPT + 7


def test_long_values_are_cut() -> None:
    log = CheckLog()
    log.fail("grid", "here", "x" * 1000, "a\nb")
    assert len(log.violations[0].expected) == 160
    assert log.violations[0].found == "a b"


def test_the_error_is_one_of_ours() -> None:
    with pytest.raises(MlbatchError):
        raise VerifyError("nothing to log")
