"""Batching worked by hand (docs/batching.md): the reference, and equal to it the fast batcher.

Times in ms where not stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given, settings

from mlbatch.errors import ClockError
from tests.builders.fast import run_fast
from tests.builders.feeds import Case, feeds
from tests.builders.hand import MS, TEN_HZ, TWO, at_index, by_host, every, masked, packet, spans
from tests.reference.batching import FeedPacket, Outcome, Settings, reference_scans

HOUR_MS = 3_600_000


def batched(feed: Sequence[FeedPacket], options: Settings) -> Outcome:
    """Outcome of a feed: of the reference, and of the fast batcher in batches of any size."""
    outcome = reference_scans(feed, options)
    groupings = [[1] * len(feed)]
    # Packets of one batch must have the same number of columns.
    if len({len(one.stamps) for one in feed}) == 1:
        groupings += [[len(feed)], [3] * (len(feed) // 3) + [len(feed) % 3]]
    for sizes in groupings:
        assert run_fast(feed, options, sizes) == outcome
    return outcome


# -- grid ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "bounds"),
    [
        # 1e9 / 15 = 66 666 666.67: bounds 1, 2, 3 are rounded up each from the exact product.
        ("15", [66_666_667, 133_333_334, 200_000_000]),
        # 1e9 / 29.97 = 33 366 700.03 and its multiples 66 733 400.07, 100 100 100.1.
        ("29.97", [33_366_701, 66_733_401, 100_100_101]),
        ("10/3", [300_000_000, 600_000_000, 900_000_000]),
    ],
)
def test_bounds_are_rounded_up_once_from_the_exact_product(rate: str, bounds: list[int]) -> None:
    stamps = [0, bounds[0], bounds[1] - 1, bounds[1], bounds[2] - 1, bounds[2]]
    feed = [FeedPacket(0, stamp, -1, (stamp,), (True,)) for stamp in stamps]
    outcome = batched(feed, replace(TEN_HZ, rate=Fraction(rate)))
    assert outcome.t_init_ns == bounds[0]
    assert spans(outcome) == [(0, bounds[0], bounds[1]), (1, bounds[1], bounds[2])]
    assert [len(window.columns) for window in outcome.windows] == [2, 2]


def test_the_first_window_begins_after_the_first_stamp() -> None:
    outcome = batched(every(0, 20, 350), TEN_HZ)
    assert outcome.t_init_ns == 100 * MS
    # 20 and 70 are in the head, 320 in the tail.
    assert spans(outcome) == [(0, 100 * MS, 200 * MS), (1, 200 * MS, 300 * MS)]
    assert outcome.dropped == [{"head": 2, "tail": 1}]
    assert (outcome.decoded, outcome.written) == ([7], [4])


def test_first_stamp_on_the_grid_waits_one_more_period() -> None:
    # "Larger than" in eq. (1): t0 = 100 is itself a bound, so scans begin at 200.
    outcome = batched(every(0, 100, 450), TEN_HZ)
    assert outcome.t_init_ns == 200 * MS
    assert outcome.dropped == [{"head": 2, "tail": 1}]


def test_first_stamp_just_before_the_grid_starts_there() -> None:
    feed = [FeedPacket(0, 0, -1, (100 * MS - 1,), (True,)), *every(0, 100, 350)]
    assert batched(feed, TEN_HZ).t_init_ns == 100 * MS


def test_start_follows_the_latest_first_stamp_of_all_sensors() -> None:
    outcome = batched(by_host(every(0, 10, 600) + every(1, 230, 600)), TWO)
    assert outcome.t_init_ns == 300 * MS
    # Sensor 0 has 10, 60, ... 160 before the head [200, 300), and 210, 260 in it.
    assert outcome.dropped[0] == {"before_start": 4, "head": 2, "tail": 2}
    # Tail [500, 600): 510, 560 and 530, 580.
    assert outcome.dropped[1] == {"head": 2, "tail": 2}


def test_windows_are_half_open() -> None:
    feed = [packet(0, 50), FeedPacket(0, 0, -1, (200 * MS - 1, 200 * MS), (True, True))]
    outcome = batched([*feed, packet(0, 310)], TEN_HZ)
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert at_index(outcome, 1).columns == [(0, 1, 1)]


def test_columns_are_sorted_by_stamp_sensor_delivery() -> None:
    feed = [
        packet(0, 50),
        packet(1, 50),
        packet(1, 120, 130),
        packet(0, 110, 130),
        packet(0, 130, 140),
        packet(1, 250),
        packet(0, 250),
        packet(0, 350),
        packet(1, 350),
    ]
    feed = [replace(one, stamps=one.stamps * (3 - len(one.stamps))) for one in feed]
    feed = [replace(one, valid=(True, one.stamps[0] != one.stamps[1])) for one in feed]
    outcome = batched(feed, TWO)
    # 130 of sensor 0 comes twice, in the order of its packets; that of sensor 1 comes after both.
    assert at_index(outcome, 0).columns == [
        (0, 1, 0),
        (1, 1, 0),
        (0, 1, 1),
        (0, 2, 0),
        (1, 1, 1),
        (0, 2, 1),
    ]


# -- late and slack -----------------------------------------------------------------------------


def test_step_back_within_the_slack_is_sorted_into_its_place() -> None:
    # 209.999999 is less than 10 ms past the end of [100, 200).
    feed = [packet(0, 50), packet(0, 150), packet(0, 209.999999), packet(0, 120)]
    outcome = batched([*feed, packet(0, 310)], TEN_HZ)
    assert at_index(outcome, 0).columns == [(0, 3, 0), (0, 1, 0)]


def test_column_is_late_once_its_sensor_passed_the_end_plus_slack() -> None:
    feed = [packet(0, 50), packet(0, 150), packet(0, 210), packet(0, 199), packet(0, 310)]
    outcome = batched(feed, TEN_HZ)
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert outcome.dropped == [{"head": 1, "late": 1, "tail": 1}]


def test_column_can_be_late_by_an_earlier_column_of_its_own_packet() -> None:
    outcome = batched([packet(0, 50), packet(0, 210, 199), packet(0, 310)], TEN_HZ)
    assert outcome.dropped == [{"head": 1, "late": 1, "tail": 1}]


def test_another_sensor_far_ahead_makes_nothing_late() -> None:
    feed = [packet(0, 50), packet(1, 50), packet(1, 950), packet(0, 150), packet(0, 960)]
    outcome = batched(feed, TWO)
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert "late" not in outcome.dropped[0]


def test_late_by_own_clock_before_scans_have_begun() -> None:
    # Sensor 1 is missing, so nothing is published; still 150 comes after 210.
    feed = [packet(0, 50), packet(0, 210), packet(0, 150), packet(1, 220), packet(0, 350)]
    assert batched(feed, TWO).dropped[0]["late"] == 1


def test_window_is_published_when_the_last_sensor_passes_end_plus_slack() -> None:
    feed = [
        packet(0, 50),
        packet(1, 50),
        packet(0, 150),
        packet(0, 230),
        packet(1, 209.999999, host_ms=231),
        packet(1, 210, host_ms=232),
    ]
    outcome = batched(feed, TWO)
    assert [(w.index, w.ready_host_ns) for w in outcome.windows] == [(0, 232 * MS)]


def test_at_the_end_of_input_the_rest_is_published_without_slack() -> None:
    outcome = batched([packet(0, 50), packet(0, 150), packet(0, 200)], TEN_HZ)
    assert spans(outcome) == [(0, 100 * MS, 200 * MS)]
    assert outcome.windows[0].ready_host_ns == 200 * MS
    assert outcome.windows[0].complete


# -- intake -------------------------------------------------------------------------------------


def test_lone_wild_packet_is_rejected_and_the_next_accepted() -> None:
    feed = [packet(0, 50), packet(0, 9_000), packet(0, 150), packet(0, 250)]
    outcome = batched(feed, TEN_HZ)
    assert outcome.rejected == [{"bad_stamp": 1}]
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert outcome.empty == 0


def test_step_of_exactly_one_second_is_not_held() -> None:
    outcome = batched([packet(0, 50), packet(0, 1050)], TEN_HZ)
    assert (outcome.rejected, outcome.decoded) == ([{}], [2])


def test_held_packet_at_the_end_of_input_is_rejected() -> None:
    outcome = batched([packet(0, 50), packet(0, 1051)], TEN_HZ)
    assert (outcome.rejected, outcome.decoded) == ([{"bad_stamp": 1}], [1])


def test_gap_is_confirmed_by_the_next_packet_and_both_arrive_then() -> None:
    feed = [packet(0, 50), packet(0, 150), packet(0, 5_020), packet(0, 5_040), packet(0, 5_150)]
    outcome = batched(feed, TEN_HZ)
    assert outcome.rejected == [{}]
    # 150 is in window [100, 200), closed by the packet that confirms the gap.
    assert at_index(outcome, 0).ready_host_ns == 5_040 * MS
    assert at_index(outcome, 49).columns == [(0, 2, 0), (0, 3, 0)]
    # [200, 300) to [4900, 5000) are empty.
    assert outcome.empty == 48


def test_confirmation_reaches_one_second_from_the_held_stamp() -> None:
    inside = batched([packet(0, 50), packet(0, 9_000), packet(0, 10_000)], TEN_HZ)
    assert inside.rejected == [{}]
    outside = batched([packet(0, 50), packet(0, 9_000), packet(0, 10_001)], TEN_HZ)
    # The first is rejected, the second then held to the end.
    assert outside.rejected == [{"bad_stamp": 2}]


def test_packet_without_valid_column_neither_confirms_nor_rejects() -> None:
    blind = masked(packet(0, 200), False)
    feed = [packet(0, 50), packet(0, 9_000), blind, packet(0, 9_050), packet(0, 9_250)]
    outcome = batched(feed, TEN_HZ)
    assert outcome.rejected == [{}]
    # It was accepted at once, before the packet that was held: number 1, the held one 2.
    assert at_index(outcome, 89).columns == [(0, 2, 0), (0, 3, 0)]
    assert outcome.dropped[0]["invalid"] == 1


def test_clock_that_goes_back_twice_is_a_reset_that_names_both_times() -> None:
    feed = [packet(0, 90_000), packet(0, 20), packet(0, 40)]
    with pytest.raises(ClockError, match="90000000000 ns and then 20000000 ns"):
        batched(feed, TEN_HZ)


@pytest.mark.parametrize("wild", [(-1,), (2**31 * 1000,), (100, 1100.000001)])
def test_impossible_stamps_and_spans_are_rejected_at_once(wild: tuple[float, ...]) -> None:
    outcome = batched([packet(0, *wild), packet(0, 50), packet(0, 60)], TEN_HZ)
    assert (outcome.rejected, outcome.decoded) == ([{"bad_stamp": 1}], [2])


def test_impossible_packet_does_not_affect_the_held_one() -> None:
    feed = [packet(0, 50), packet(0, 9_000), packet(0, -1), packet(0, 9_050)]
    assert batched(feed, TEN_HZ).decoded == [3]


def test_duplicates_reach_1024_packets_back() -> None:
    def feed(between: int) -> list[FeedPacket]:
        others = [packet(0, 50, key=n) for n in range(between)]
        return [packet(0, 50, key=5000), *others, packet(0, 50, key=5000)]

    assert batched(feed(1023), TEN_HZ).rejected == [{"duplicate": 1}]
    assert batched(feed(1024), TEN_HZ).rejected == [{}]


def test_duplicate_renews_the_reach_and_other_sensors_have_their_own() -> None:
    feed = [packet(s, 50, key=9) for s in (0, 1, 0)]
    feed += [packet(0, 50, key=100 + n) for n in range(1023)] + [packet(0, 50, key=9)]
    assert batched(feed, TWO).rejected == [{"duplicate": 2}, {}]


def test_invalid_columns_have_no_stamp() -> None:
    # The first column would move t0, the last close the window and be wild.
    noisy = masked(packet(0, 0, 150, 90_000, host_ms=150), False, True, False)
    outcome = batched([noisy, packet(0, 250), packet(0, 350)], TEN_HZ)
    assert outcome.t_init_ns == 200 * MS
    assert (outcome.decoded, outcome.dropped) == ([5], [{"invalid": 2, "head": 1, "tail": 1}])


def test_host_clock_replaces_stamps_by_arrival_minus_age() -> None:
    feed = [packet(0, 7_000, 7_010, host_ms=60), packet(0, 7_090, 7_100, host_ms=205)]
    on_host = replace(TEN_HZ, host_clock=True)
    outcome = batched([*feed, packet(0, 7_300, host_ms=310)], on_host)
    # 50, 60 | 195, 205 | 310.
    assert outcome.t_init_ns == 100 * MS
    assert [window.columns for window in outcome.windows] == [[(0, 1, 0)], [(0, 1, 1)]]


@pytest.mark.parametrize(("offset_ms", "comparable"), [(1_000, True), (1_000.000001, False)])
def test_clocks_more_than_a_second_apart_are_refused(offset_ms: float, comparable: bool) -> None:
    feed = [packet(0, 50), packet(1, 60 + offset_ms, host_ms=60)]
    if comparable:
        assert batched(feed, TWO).decoded == [1, 1]
        return
    with pytest.raises(ClockError, match="sensors 0 and 1"):
        batched(feed, TWO)
    assert batched(feed, replace(TWO, host_clock=True)).decoded == [1, 1]


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_all_pairs_of_clocks_are_compared_whichever_came_first(order: tuple[int, ...]) -> None:
    # Each is within 1 s of sensor 0, but 1 and 2 are 1.8 s apart.
    feed = [packet(0, 5_000), packet(1, 5_900, host_ms=5_000), packet(2, 4_100, host_ms=5_000)]
    with pytest.raises(ClockError, match="expected comparable clocks"):
        batched([feed[sensor] for sensor in order], replace(TEN_HZ, sensors=3))


# -- stalls, late starts, early ends --------------------------------------------------------------


def test_gap_of_an_hour_is_counted_and_not_visited() -> None:
    feed = [*every(0, 50, 400), *every(0, 1000 * HOUR_MS, 1000 * HOUR_MS + 400)]
    outcome = batched(feed, TEN_HZ)
    # Windows 1 to 3 and four from 36 000 000 on, numbered from time 0, have columns; the oracle
    # would take minutes to visit those between.
    assert outcome.empty == 36_000_000 - 4


def test_stalled_sensor_is_not_waited_for_and_its_old_columns_are_late() -> None:
    ahead = [packet(0, stamp) for stamp in range(50, 1601, 50)]
    feed = [packet(1, 50), *ahead, packet(1, 150, host_ms=1601), packet(1, 1_000, host_ms=1602)]
    outcome = batched(feed, TWO)
    # 1100 - 50 > 1000: at that packet sensor 1 is given up and all to 1000 comes out.
    assert at_index(outcome, 0).ready_host_ns == 1_100 * MS
    assert outcome.dropped[1] == {"head": 1, "late": 2}
    assert not any(window.complete for window in outcome.windows)


def test_returning_sensor_rejoins_but_the_gap_stays_incomplete() -> None:
    feed = by_host(every(0, 50, 3000) + every(1, 50, 300) + every(1, 1800, 3000))
    # A gap of 1550 > 1000: held, then confirmed; windows it overlaps are incomplete.
    outcome = batched(feed, TWO)
    complete = [window.index for window in outcome.windows if window.complete]
    assert outcome.rejected == [{}, {}]
    # [100, 200) is before the stall from 250; [1800, 1900) begins where it ends.
    assert complete == [0, *range(17, 28)]
    # 1800 is let in at 1850, when [1800, 1900) is open: none is late. 100 to 250, 1800 to 2850.
    assert outcome.written[1] == 4 + 22


def test_infinite_wait_knows_no_stall() -> None:
    feed = by_host(every(0, 50, 3000) + every(1, 50, 300) + every(1, 1800, 3000))
    outcome = batched(feed, replace(TWO, max_wait_ns=None))
    assert all(window.complete for window in outcome.windows)


def test_sensor_that_starts_late_never_moves_the_start() -> None:
    outcome = batched(by_host(every(0, 50, 3000) + every(1, 1730, 3000)), TWO)
    # Sensor 1 is given up when sensor 0 is at 1100 = 50 + 1000 + 50.
    assert outcome.t_init_ns == 100 * MS
    # [1800, 1900) is the first that begins after its first stamp; [2900, 3000) is the tail.
    assert [w.index for w in outcome.windows if w.complete] == list(range(17, 28))


def test_sensor_that_never_comes_leaves_all_incomplete() -> None:
    outcome = batched(every(0, 50, 500), TWO)
    assert outcome.t_init_ns == 100 * MS
    assert outcome.incomplete == len(outcome.windows) == 3


def test_sensor_that_ends_early_leaves_the_rest_incomplete() -> None:
    outcome = batched(by_host(every(0, 50, 800) + every(1, 50, 450)), TWO)
    # Its last stamp is 400: the end of [300, 400).
    assert [window.complete for window in outcome.windows] == [True] * 3 + [False] * 3


def test_only_packets_before_the_first_scan_end_the_feed_without_scans() -> None:
    outcome = batched([packet(0, 10), packet(0, 20)], TEN_HZ)
    assert (outcome.windows, outcome.dropped) == ([], [{"head": 2}])
    assert batched([], TEN_HZ).t_init_ns is None


# -- what is written ------------------------------------------------------------------------------


def test_keep_partial_writes_head_and_tail() -> None:
    outcome = batched(every(0, 50, 350), replace(TEN_HZ, keep_partial=True))
    assert [(w.index, w.complete) for w in outcome.windows] == [
        (-1, False),
        (0, True),
        (1, True),
        (2, False),
    ]
    assert outcome.dropped == [{}]


def test_slices_are_published_dropped_and_counted_one_by_one() -> None:
    feed = [packet(0, stamp) for stamp in (50, 110, 140, 160, 260, 290)]
    outcome = batched(feed, replace(TEN_HZ, slices=2))
    # Slices of 50 from 100: 110, 140 | 160 | none | 260, 290 is the tail.
    assert [(w.index, w.slice, len(w.columns)) for w in outcome.windows] == [(0, 0, 2), (0, 1, 1)]
    assert outcome.empty == 1
    assert [w.ready_host_ns for w in outcome.windows] == [160 * MS, 260 * MS]
    assert outcome.dropped == [{"head": 1, "tail": 2}]


def test_slices_are_published_one_by_one() -> None:
    feed = every(0, 70, 330, 10)
    outcome = batched(feed, replace(TEN_HZ, slices=4))
    first = [(w.slice, w.start_ns, w.end_ns) for w in outcome.windows if w.index == 0]
    assert first == [(j, (100 + 25 * j) * MS, (125 + 25 * j) * MS) for j in range(4)]
    # [100, 125) closes when its sensor is 10 ms past it.
    assert outcome.windows[0].ready_host_ns == 140 * MS


def test_start_and_end_choose_windows_by_their_start() -> None:
    limits = replace(TEN_HZ, start_ns=200 * MS, end_ns=400 * MS)
    outcome = batched(every(0, 50, 800), limits)
    assert outcome.t_init_ns == 100 * MS
    assert [window.index for window in outcome.windows] == [1, 2]
    assert outcome.dropped == [{"outside_time": 11}]


def test_empty_windows_are_counted_within_start_and_end() -> None:
    feed = [*every(0, 50, 200), *every(0, 900, 1200)]
    # [200, 900) is empty: 7 windows, of which 3 begin in [450, 750).
    limits = replace(TEN_HZ, start_ns=450 * MS, end_ns=750 * MS)
    assert batched(feed, TEN_HZ).empty == 7
    assert batched(feed, limits).empty == 3


# -- laws -----------------------------------------------------------------------------------------


@settings(max_examples=150)
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


@settings(max_examples=150)
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
