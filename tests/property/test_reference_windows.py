"""The oracle's stalls, slices, limits and ledgers, by hand and by law; times in ms if not said."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

from hypothesis import given, settings

from mlbatch.batching.reference import FeedPacket, reference_scans
from mlbatch.errors import ClockError
from tests.builders.feeds import Case, feeds
from tests.builders.hand import MS, TEN_HZ, TWO, at_index, by_host, every, packet, spans

HOUR_MS = 3_600_000


# -- stalls, late starts, early ends --------------------------------------------------------------


def test_gap_of_an_hour_is_counted_and_not_visited() -> None:
    feed = [*every(0, 50, 400), *every(0, 1000 * HOUR_MS, 1000 * HOUR_MS + 400)]
    outcome = reference_scans(feed, TEN_HZ)
    # Windows 1 to 3 and four from 36 000 000 on, numbered from time 0, have columns; the oracle
    # would take minutes to visit those between.
    assert outcome.empty == 36_000_000 - 4


def test_stalled_sensor_is_not_waited_for_and_its_old_columns_are_late() -> None:
    ahead = [packet(0, stamp) for stamp in range(50, 1601, 50)]
    feed = [packet(1, 50), *ahead, packet(1, 150, host_ms=1601), packet(1, 1_000, host_ms=1602)]
    outcome = reference_scans(feed, TWO)
    # 1100 - 50 > 1000: at that packet sensor 1 is given up and all to 1000 comes out.
    assert at_index(outcome, 0).ready_host_ns == 1_100 * MS
    assert outcome.dropped[1] == {"head": 1, "late": 2}
    assert not any(window.complete for window in outcome.windows)


def test_returning_sensor_rejoins_but_the_gap_stays_incomplete() -> None:
    feed = by_host(every(0, 50, 3000) + every(1, 50, 300) + every(1, 1800, 3000))
    # A gap of 1550 > 1000: held, then confirmed; windows it overlaps are incomplete.
    outcome = reference_scans(feed, TWO)
    complete = [window.index for window in outcome.windows if window.complete]
    assert outcome.rejected == [{}, {}]
    # [100, 200) is before the stall from 250; [1800, 1900) begins where it ends.
    assert complete == [0, *range(17, 28)]
    # 1800 is let in at 1850, when [1800, 1900) is open: none is late. 100 to 250, 1800 to 2850.
    assert outcome.written[1] == 4 + 22


def test_infinite_wait_knows_no_stall() -> None:
    feed = by_host(every(0, 50, 3000) + every(1, 50, 300) + every(1, 1800, 3000))
    outcome = reference_scans(feed, replace(TWO, max_wait_ns=None))
    assert all(window.complete for window in outcome.windows)


def test_sensor_that_starts_late_never_moves_the_start() -> None:
    outcome = reference_scans(by_host(every(0, 50, 3000) + every(1, 1730, 3000)), TWO)
    # Sensor 1 is given up when sensor 0 is at 1100 = 50 + 1000 + 50.
    assert outcome.t_init_ns == 100 * MS
    # [1800, 1900) is the first that begins after its first stamp; [2900, 3000) is the tail.
    assert [w.index for w in outcome.windows if w.complete] == list(range(17, 28))


def test_sensor_that_never_comes_leaves_all_incomplete() -> None:
    outcome = reference_scans(every(0, 50, 500), TWO)
    assert outcome.t_init_ns == 100 * MS
    assert outcome.incomplete == len(outcome.windows) == 3


def test_sensor_that_ends_early_leaves_the_rest_incomplete() -> None:
    outcome = reference_scans(by_host(every(0, 50, 800) + every(1, 50, 450)), TWO)
    # Its last stamp is 400: the end of [300, 400).
    assert [window.complete for window in outcome.windows] == [True] * 3 + [False] * 3


def test_only_packets_before_the_first_scan_end_the_feed_without_scans() -> None:
    outcome = reference_scans([packet(0, 10), packet(0, 20)], TEN_HZ)
    assert (outcome.windows, outcome.dropped) == ([], [{"head": 2}])
    assert reference_scans([], TEN_HZ).t_init_ns is None


# -- what is written ------------------------------------------------------------------------------


def test_keep_partial_writes_head_and_tail() -> None:
    outcome = reference_scans(every(0, 50, 350), replace(TEN_HZ, keep_partial=True))
    assert [(w.index, w.complete) for w in outcome.windows] == [
        (-1, False),
        (0, True),
        (1, True),
        (2, False),
    ]
    assert outcome.dropped == [{}]


def test_slices_are_published_dropped_and_counted_one_by_one() -> None:
    feed = [packet(0, stamp) for stamp in (50, 110, 140, 160, 260, 290)]
    outcome = reference_scans(feed, replace(TEN_HZ, slices=2))
    # Slices of 50 from 100: 110, 140 | 160 | none | 260, 290 is the tail.
    assert [(w.index, w.slice, len(w.columns)) for w in outcome.windows] == [(0, 0, 2), (0, 1, 1)]
    assert outcome.empty == 1
    assert [w.ready_host_ns for w in outcome.windows] == [160 * MS, 260 * MS]
    assert outcome.dropped == [{"head": 1, "tail": 2}]


def test_slices_of_15_hz_are_rounded_up_from_the_exact_product() -> None:
    # k = 1, 4 slices: 1e9 * (1 + j / 4) / 15 = 66 666 666.7, 83 333 333.3, 100 000 000.
    feed = [FeedPacket(0, n, -1, (n,), (True,)) for n in (0, 66_666_667, 83_333_334, 100_000_000)]
    outcome = reference_scans(feed, replace(TEN_HZ, rate=Fraction(15), slices=4))
    assert spans(outcome) == [(0, 66_666_667, 83_333_334), (0, 83_333_334, 100_000_000)]


def test_start_and_end_choose_windows_by_their_start() -> None:
    limits = replace(TEN_HZ, start_ns=200 * MS, end_ns=400 * MS)
    outcome = reference_scans(every(0, 50, 800), limits)
    assert outcome.t_init_ns == 100 * MS
    assert [window.index for window in outcome.windows] == [1, 2]
    assert outcome.dropped == [{"outside_time": 11}]


def test_empty_windows_are_counted_within_start_and_end() -> None:
    feed = [*every(0, 50, 200), *every(0, 900, 1200)]
    # [200, 900) is empty: 7 windows, of which 3 begin in [450, 750).
    limits = replace(TEN_HZ, start_ns=450 * MS, end_ns=750 * MS)
    assert reference_scans(feed, TEN_HZ).empty == 7
    assert reference_scans(feed, limits).empty == 3


# -- laws -----------------------------------------------------------------------------------------


@settings(max_examples=150, deadline=None)
@given(feeds())
def test_every_column_is_written_or_dropped_under_one_reason(case: Case) -> None:
    feed, options = case
    try:
        outcome = reference_scans(feed, options)
    except ClockError:
        return
    for decoded, written, dropped in zip(
        outcome.decoded, outcome.written, outcome.dropped, strict=True
    ):
        assert decoded == written + sum(dropped.values())
    read = [sum(one.sensor == sensor for one in feed) for sensor in range(options.sensors)]
    assert all(sum(counts.values()) <= n for counts, n in zip(outcome.rejected, read, strict=True))
    columns = [column for window in outcome.windows for column in window.columns]
    assert len(columns) == len(set(columns)) == sum(outcome.written)


@settings(max_examples=150, deadline=None)
@given(feeds())
def test_windows_follow_each_other_and_the_grid(case: Case) -> None:
    feed, options = case
    try:
        outcome = reference_scans(feed, options)
    except ClockError:
        return
    windows = outcome.windows
    assert all(a.end_ns <= b.start_ns for a, b in pairwise(windows))
    assert all(a.ready_host_ns <= b.ready_host_ns for a, b in pairwise(windows))
    for window in windows:
        # A slice is as long as its share of a period, give or take the rounding of its bounds.
        length = Fraction(10**9) / options.rate / options.slices
        assert abs(window.end_ns - window.start_ns - length) < 1
        assert (window.index == -1) <= options.keep_partial
