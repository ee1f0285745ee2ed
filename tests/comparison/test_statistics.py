"""Statistics of sets, by hand."""

from __future__ import annotations

import pytest

from mlbatch.batching.sweeps import Sweep
from mlbatch.comparison.compare import SetStatistics
from mlbatch.units import NS_PER_MS


def _sweep(sensor: int, first_ms: int) -> Sweep:
    """A sweep of 100 ms and 100 columns."""
    end_ns = (first_ms + 100) * NS_PER_MS
    return Sweep(sensor, first_ms * NS_PER_MS, end_ns - 1, end_ns, 100)


def test_figures() -> None:
    statistics = SetStatistics("some", 2, 100 * NS_PER_MS)
    first = _sweep(0, 0)
    second = _sweep(0, 100)
    third = _sweep(0, 400)
    late = _sweep(1, 40)
    for joined in ((first, late), (second, late), (third, late), (third, None)):
        statistics.add(joined)
    report = statistics.report(900, [third, _sweep(1, 500)])
    assert (report.sets, report.without_a_sensor) == (4, 1)
    # 400 to 500 ms with 40 to 140 ms: 360 ms older, more than two periods.
    assert report.stale == 1
    # To the last column, 1 ns before the end.
    short_ms = 1e-6
    spans = (100 - short_ms, 140 - short_ms, 460 - short_ms, 460 - short_ms)
    assert (report.span.min, report.span.p50) == pytest.approx(spans[:2], abs=1e-9)
    assert (report.span.p99, report.span.max) == pytest.approx(spans[2:], abs=1e-9)
    assert (report.apart.min, report.apart.p50, report.apart.max) == (40, 60, 360)
    # 100 of 900 columns wait; `third` and `late` were used more than once.
    assert (report.columns, report.used_twice, report.never_used) == (800, 200, 400)


def test_without_sets_there_are_no_figures() -> None:
    report = SetStatistics("some", 2, NS_PER_MS).report(0)
    assert report.row() == ["some", "0", "0", "0", *["-"] * 6, "0", "-", "-"]


def test_latency_is_the_age_of_the_first_column() -> None:
    statistics = SetStatistics("some", 2, 100 * NS_PER_MS)
    # Ready with the later sweep, at 140 ms; then 25 ms later, by another sweep.
    statistics.add((_sweep(0, 0), _sweep(1, 40)))
    statistics.add((_sweep(0, 100), _sweep(1, 140)), ready_ns=265 * NS_PER_MS)
    report = statistics.report(400)
    assert (report.latency.min, report.latency.max) == (140, 165)
    assert report.start_s.tolist() == [0, 0.1]
    assert report.latency_ms.tolist() == [140, 165]
    assert report.apart_ms.tolist() == [40] * 2
