"""The log of checks: order, first violation, counts."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.outputs.damage import MAX_KEPT, CheckLog
from mlbatch.verification import CHECKS
from mlbatch.verification.outputs import outcomes


def test_a_violation_names_the_first_and_counts_all() -> None:
    log = CheckLog()
    bad = np.array([False, True, True])
    assert not log.none("finite", "a.npz point", bad, "numbers", lambda at: f"value {at}")
    (violation,) = log.violations
    assert str(violation) == "finite: a.npz point 1: expected numbers, found value 1 (2 of 3)"
    outcome = {check.name: check for check in outcomes(log, {"order": "no columns"})}
    assert (outcome["finite"].outcome, outcome["finite"].checked) == ("violated", 3)
    assert (outcome["order"].outcome, outcome["order"].limit) == ("not checkable", "no columns")
    assert list(outcome) == list(CHECKS)


def test_a_check_that_no_verdict_would_show_is_refused() -> None:
    with pytest.raises(KeyError, match="gird"):
        CheckLog().fail("gird", "here", 1, 2)
    with pytest.raises(KeyError, match="gird"):
        CheckLog().ok("gird")


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
