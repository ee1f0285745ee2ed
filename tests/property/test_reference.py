"""The oracle against cases worked by hand (docs/batching.md), times in ms where not stated."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest

from mlbatch.batching.reference import FeedPacket, reference_scans
from mlbatch.errors import ClockError
from tests.builders.hand import MS, TEN_HZ, TWO, at_index, by_host, every, masked, packet, spans

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
    outcome = reference_scans(feed, replace(TEN_HZ, rate=Fraction(rate)))
    assert outcome.t_init_ns == bounds[0]
    assert spans(outcome) == [(0, bounds[0], bounds[1]), (1, bounds[1], bounds[2])]
    assert [len(window.columns) for window in outcome.windows] == [2, 2]


def test_first_stamp_on_the_grid_waits_one_more_period() -> None:
    # "Larger than" in eq. (1): t0 = 100 is itself a bound, so scans begin at 200.
    assert reference_scans(every(0, 100, 450), TEN_HZ).t_init_ns == 200 * MS


def test_first_stamp_just_before_the_grid_starts_there() -> None:
    feed = [FeedPacket(0, 0, -1, (100 * MS - 1,), (True,)), *every(0, 100, 350)]
    assert reference_scans(feed, TEN_HZ).t_init_ns == 100 * MS


def test_start_follows_the_latest_first_stamp_of_all_sensors() -> None:
    outcome = reference_scans(by_host(every(0, 10, 600) + every(1, 230, 600)), TWO)
    assert outcome.t_init_ns == 300 * MS
    # Sensor 0 has 10, 60, ... 160 before the head [200, 300), and 210, 260 in it.
    assert outcome.dropped[0] == {"before_start": 4, "head": 2, "tail": 2}
    # Tail [500, 600): 510, 560 and 530, 580.
    assert outcome.dropped[1] == {"head": 2, "tail": 2}


def test_windows_are_half_open() -> None:
    feed = [packet(0, 50), FeedPacket(0, 0, -1, (200 * MS - 1, 200 * MS), (True, True))]
    outcome = reference_scans([*feed, packet(0, 310)], TEN_HZ)
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert at_index(outcome, 1).columns == [(0, 1, 1)]


def test_equal_stamps_are_sorted_by_sensor_then_delivery() -> None:
    feed = [packet(0, 50), packet(1, 50), packet(1, 120, 120), packet(0, 120), packet(0, 120)]
    outcome = reference_scans([*feed, packet(1, 250), packet(0, 250)], TWO)
    assert at_index(outcome, 0).columns == [(0, 1, 0), (0, 2, 0), (1, 1, 0), (1, 1, 1)]


# -- late and slack -----------------------------------------------------------------------------


def test_step_back_within_the_slack_is_sorted_into_its_place() -> None:
    # 209.999999 is less than 10 ms past the end of [100, 200).
    feed = [packet(0, 50), packet(0, 150), packet(0, 209.999999), packet(0, 120)]
    outcome = reference_scans([*feed, packet(0, 310)], TEN_HZ)
    assert at_index(outcome, 0).columns == [(0, 3, 0), (0, 1, 0)]


def test_column_is_late_once_its_sensor_passed_the_end_plus_slack() -> None:
    feed = [packet(0, 50), packet(0, 150), packet(0, 210), packet(0, 199), packet(0, 310)]
    outcome = reference_scans(feed, TEN_HZ)
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert outcome.dropped == [{"head": 1, "late": 1, "tail": 1}]


def test_column_can_be_late_by_an_earlier_column_of_its_own_packet() -> None:
    outcome = reference_scans([packet(0, 50), packet(0, 210, 199), packet(0, 310)], TEN_HZ)
    assert outcome.dropped == [{"head": 1, "late": 1, "tail": 1}]


def test_another_sensor_far_ahead_makes_nothing_late() -> None:
    feed = [packet(0, 50), packet(1, 50), packet(1, 950), packet(0, 150), packet(0, 960)]
    outcome = reference_scans(feed, TWO)
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert "late" not in outcome.dropped[0]


def test_late_by_own_clock_before_scans_have_begun() -> None:
    # Sensor 1 is missing, so nothing is published; still 150 comes after 210.
    feed = [packet(0, 50), packet(0, 210), packet(0, 150), packet(1, 220), packet(0, 350)]
    assert reference_scans(feed, TWO).dropped[0]["late"] == 1


def test_window_is_published_when_the_last_sensor_passes_end_plus_slack() -> None:
    feed = [
        packet(0, 50),
        packet(1, 50),
        packet(0, 150),
        packet(0, 230),
        packet(1, 209.999999, host_ms=231),
        packet(1, 210, host_ms=232),
    ]
    outcome = reference_scans(feed, TWO)
    assert [(w.index, w.ready_host_ns) for w in outcome.windows] == [(0, 232 * MS)]


def test_at_the_end_of_input_the_rest_is_published_without_slack() -> None:
    outcome = reference_scans([packet(0, 50), packet(0, 150), packet(0, 200)], TEN_HZ)
    assert spans(outcome) == [(0, 100 * MS, 200 * MS)]
    assert outcome.windows[0].ready_host_ns == 200 * MS
    assert outcome.windows[0].complete


# -- intake -------------------------------------------------------------------------------------


def test_lone_wild_packet_is_rejected_and_the_next_accepted() -> None:
    feed = [packet(0, 50), packet(0, 9_000), packet(0, 150), packet(0, 250)]
    outcome = reference_scans(feed, TEN_HZ)
    assert outcome.rejected == [{"bad_stamp": 1}]
    assert at_index(outcome, 0).columns == [(0, 1, 0)]
    assert outcome.empty == 0


def test_step_of_exactly_one_second_is_not_held() -> None:
    outcome = reference_scans([packet(0, 50), packet(0, 1050)], TEN_HZ)
    assert (outcome.rejected, outcome.decoded) == ([{}], [2])


def test_held_packet_at_the_end_of_input_is_rejected() -> None:
    outcome = reference_scans([packet(0, 50), packet(0, 1051)], TEN_HZ)
    assert (outcome.rejected, outcome.decoded) == ([{"bad_stamp": 1}], [1])


def test_gap_is_confirmed_by_the_next_packet_and_both_arrive_then() -> None:
    feed = [packet(0, 50), packet(0, 150), packet(0, 5_020), packet(0, 5_040), packet(0, 5_150)]
    outcome = reference_scans(feed, TEN_HZ)
    assert outcome.rejected == [{}]
    # 150 is in window [100, 200), closed by the packet that confirms the gap.
    assert at_index(outcome, 0).ready_host_ns == 5_040 * MS
    assert at_index(outcome, 49).columns == [(0, 2, 0), (0, 3, 0)]
    # [200, 300) to [4900, 5000) are empty.
    assert outcome.empty == 48


def test_confirmation_reaches_one_second_from_the_held_stamp() -> None:
    inside = reference_scans([packet(0, 50), packet(0, 9_000), packet(0, 10_000)], TEN_HZ)
    assert inside.rejected == [{}]
    outside = reference_scans([packet(0, 50), packet(0, 9_000), packet(0, 10_001)], TEN_HZ)
    # The first is disproved, the second then held to the end.
    assert outside.rejected == [{"bad_stamp": 2}]


def test_packet_without_valid_column_neither_confirms_nor_rejects() -> None:
    blind = masked(packet(0, 200), False)
    feed = [packet(0, 50), packet(0, 9_000), blind, packet(0, 9_050), packet(0, 9_250)]
    outcome = reference_scans(feed, TEN_HZ)
    assert outcome.rejected == [{}]
    # It was accepted at once, before the packet that was held: number 1, the held one 2.
    assert at_index(outcome, 89).columns == [(0, 2, 0), (0, 3, 0)]
    assert outcome.dropped[0]["invalid"] == 1


def test_clock_that_goes_back_twice_is_a_reset_that_names_both_times() -> None:
    feed = [packet(0, 90_000), packet(0, 20), packet(0, 40)]
    with pytest.raises(ClockError, match="90000000000 ns back to 20000000 ns"):
        reference_scans(feed, TEN_HZ)


@pytest.mark.parametrize("wild", [(-1,), (2**31 * 1000,), (100, 1100.000001)])
def test_impossible_stamps_and_spans_are_rejected_at_once(wild: tuple[float, ...]) -> None:
    outcome = reference_scans([packet(0, *wild), packet(0, 50), packet(0, 60)], TEN_HZ)
    assert (outcome.rejected, outcome.decoded) == ([{"bad_stamp": 1}], [2])


def test_impossible_packet_does_not_affect_the_held_one() -> None:
    feed = [packet(0, 50), packet(0, 9_000), packet(0, -1), packet(0, 9_050)]
    assert reference_scans(feed, TEN_HZ).decoded == [3]


def test_duplicates_reach_1024_packets_back() -> None:
    def feed(between: int) -> list[FeedPacket]:
        others = [packet(0, 50, key=n) for n in range(between)]
        return [packet(0, 50, key=5000), *others, packet(0, 50, key=5000)]

    assert reference_scans(feed(1023), TEN_HZ).rejected == [{"duplicate": 1}]
    assert reference_scans(feed(1024), TEN_HZ).rejected == [{}]


def test_duplicate_renews_the_reach_and_other_sensors_have_their_own() -> None:
    feed = [packet(s, 50, key=9) for s in (0, 1, 0)]
    feed += [packet(0, 50, key=100 + n) for n in range(1023)] + [packet(0, 50, key=9)]
    assert reference_scans(feed, TWO).rejected == [{"duplicate": 2}, {}]


def test_invalid_columns_have_no_stamp() -> None:
    # The first column would move t0, the last close the window and be wild.
    noisy = masked(packet(0, 0, 150, 90_000, host_ms=150), False, True, False)
    outcome = reference_scans([noisy, packet(0, 250), packet(0, 350)], TEN_HZ)
    assert outcome.t_init_ns == 200 * MS
    assert (outcome.decoded, outcome.dropped) == ([5], [{"invalid": 2, "head": 1, "tail": 1}])


def test_host_clock_replaces_stamps_by_arrival_minus_age() -> None:
    feed = [packet(0, 7_000, 7_010, host_ms=60), packet(0, 7_090, 7_100, host_ms=205)]
    on_host = replace(TEN_HZ, host_clock=True)
    outcome = reference_scans([*feed, packet(0, 7_300, host_ms=310)], on_host)
    # 50, 60 | 195, 205 | 310.
    assert outcome.t_init_ns == 100 * MS
    assert [window.columns for window in outcome.windows] == [[(0, 1, 0)], [(0, 1, 1)]]


@pytest.mark.parametrize(("offset_ms", "comparable"), [(1_000, True), (1_000.000001, False)])
def test_clocks_more_than_a_second_apart_are_refused(offset_ms: float, comparable: bool) -> None:
    feed = [packet(0, 50), packet(1, 60 + offset_ms, host_ms=60)]
    if comparable:
        assert reference_scans(feed, TWO).decoded == [1, 1]
        return
    with pytest.raises(ClockError, match="sensors 0 and 1"):
        reference_scans(feed, TWO)
    assert reference_scans(feed, replace(TWO, host_clock=True)).decoded == [1, 1]


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_all_pairs_of_clocks_are_compared_whichever_came_first(order: tuple[int, ...]) -> None:
    # Each is within 1 s of sensor 0, but 1 and 2 are 1.8 s apart.
    feed = [packet(0, 5_000), packet(1, 5_900, host_ms=5_000), packet(2, 4_100, host_ms=5_000)]
    with pytest.raises(ClockError, match="expected comparable clocks"):
        reference_scans([feed[sensor] for sensor in order], replace(TEN_HZ, sensors=3))
