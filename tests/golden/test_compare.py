"""Frame-level fusion against windows on recordings of known phases; figures worked out by hand.

Sweeps of `left` begin 20 ms after a bound of the grid. The span of a set is from its first column
to its last, without the duration of the last: 100 ms / 512.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.comparison.compare import WINDOWS, Comparison, compare
from mlbatch.page.policies import PolicyFigures
from mlbatch.pipeline.job import Job
from tests.builders.phases import CASES, write_case

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "compare.md"
POLICIES = ("latest sweeps", "approximate time", "timeout collate", WINDOWS)
IN_PHASE, BY_37, BY_63, DOUBLE, DRIFTING, SILENT = CASES
# 511 / 512 of 100 ms, rounded down to ns as the encoder does.
SWEEP_MS = 99.804687


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Comparison]:
    folder = tmp_path_factory.mktemp("phases")
    return {name: compare(Job((write_case(folder, name),))) for name in CASES}


def _policy(found: dict[str, Comparison], case: str, policy: str) -> PolicyFigures:
    return next(one for one in found[case].reports if one.name == policy)


def _spans_ms(report: PolicyFigures) -> tuple[float, float]:
    low = report.span.min
    high = report.span.max
    assert low is not None
    assert high is not None
    return low, high


@pytest.mark.parametrize("case", CASES)
def test_windows_span_one_period_and_use_each_column_once(
    found: dict[str, Comparison], case: str
) -> None:
    ours = _policy(found, case, WINDOWS)
    assert _spans_ms(ours)[1] < 100
    assert (ours.stale, ours.used_twice, ours.never_used) == (0, 0, 0)
    # From t_init at 100 ms; the last window holds the last stamp, and is left out.
    assert ours.sets == CASES[case][1] * 10 - 2


@pytest.mark.parametrize(
    ("case", "spans_ms"),
    [
        # Sweeps that begin together end together.
        (IN_PHASE, (0, 0, 0)),
        # Right's sweep that ended by then began 63 ms before left's; the nearest, 37 ms after it.
        (BY_37, (63, 37, 37)),
        # Sweeps are collected from left's first on: right's follows 63 ms later, though one that
        # began 37 ms before left's would have been nearer.
        (BY_63, (37, 37, 63)),
    ],
)
def test_phases_add_to_the_span(
    found: dict[str, Comparison], case: str, spans_ms: tuple[float, ...]
) -> None:
    for policy, more_ms in zip(POLICIES, spans_ms, strict=False):
        report = _policy(found, case, policy)
        assert _spans_ms(report) == pytest.approx((SWEEP_MS + more_ms,) * 2, abs=1e-9)
        assert (report.apart.min, report.apart.max) == (more_ms, more_ms)
        assert (report.without_a_sensor, report.stale, report.used_twice) == (0, 0, 0)
        # 99 sweeps: the first has no known begin, the last no end; and some have no partner.
        assert 96 <= report.sets <= 97
    for sensor in found[case].sensors:
        assert (sensor.revolutions, sensor.revolution_ms) == (97, 100.0)


def test_half_of_the_faster_turns_is_lost(found: dict[str, Comparison]) -> None:
    # The right sweep of the same end has its last column nearer to it; the one of the same begin
    # ends before; that which came first began 50 ms before left's sweep.
    spans_ms = (100 - 50 / 512, SWEEP_MS, 50 + SWEEP_MS)
    for policy, span_ms in zip(POLICIES, spans_ms, strict=False):
        report = _policy(found, DOUBLE, policy)
        assert _spans_ms(report) == pytest.approx((span_ms, span_ms), abs=2e-6)
        # Two of three columns are right's; half of them are in no set.
        assert report.never_used / report.columns == pytest.approx(1 / 3, abs=0.01)
    assert _policy(found, DOUBLE, WINDOWS).columns == 98 * 3 * 512


def test_drifting_rotors_pass_through_all_phases(found: dict[str, Comparison]) -> None:
    """In 60 s the rotors of 10.00 and 9.95 Hz drift by three sweeps."""
    newest, nearest, collected = (_policy(found, DRIFTING, policy) for policy in POLICIES[:3])
    # Right's newest sweep ended up to 100.5 ms ago, and took 100.5 ms.
    low, high = _spans_ms(newest)
    assert 100 < low < 102
    assert 198 < high < 201.01
    # Begins at most 50 ms apart; where sweeps stand in opposition some find no partner.
    low, high = _spans_ms(nearest)
    assert low < 101
    assert 148 < high <= 150.51
    assert 590 <= nearest.sets < 597
    assert nearest.never_used > 0
    # Right's sweep is awaited for 100 ms; when it comes later still, the set goes without.
    low, high = _spans_ms(collected)
    assert low < 101
    assert 198 < high <= 200.51
    assert 1 <= collected.without_a_sensor <= 3


def test_a_silent_lidar_pollutes_joined_turns(found: dict[str, Comparison]) -> None:
    newest, nearest, collected, ours = (_policy(found, SILENT, policy) for policy in POLICIES)
    # Right's last whole sweep began at 4.82 s; left's sweep that ends at 7.92 s still meets it.
    assert _spans_ms(newest) == pytest.approx((SWEEP_MS, 3000 + SWEEP_MS), abs=2e-6)
    # Those that end from 5.22 s to 7.92 s: more than 200 ms after it.
    assert newest.stale == 28
    # Left's sweeps that begin from 4.92 s to 7.92 s find none.
    assert nearest.sets == newest.sets - 31
    assert _spans_ms(nearest) == pytest.approx((SWEEP_MS, SWEEP_MS), abs=2e-6)
    # Right's broken sweep from 4.92 s is published at 8 s, and meets left's that ended at 7.92 s.
    assert _spans_ms(collected) == pytest.approx((SWEEP_MS, 2900 + SWEEP_MS), abs=2e-6)
    assert (collected.without_a_sensor, collected.stale) == (29, 1)
    # The windows from 5.1 s to 8.0 s.
    assert ours.without_a_sensor == 29


def test_the_table_of_the_page_comes_from_these_runs(found: dict[str, Comparison]) -> None:
    rows = [["time span of a set, ms", *POLICIES], ["---"] * (1 + len(POLICIES))]
    rows += [[case, *map(_span, one.reports)] for case, one in found.items()]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    assert table in PAGE.read_text(encoding="utf-8"), f"put this into {PAGE.name}:\n{table}"


def _span(report: PolicyFigures) -> str:
    low, high = (f"{value:.0f}" for value in _spans_ms(report))
    return low if low == high else f"{low} to {high}"
