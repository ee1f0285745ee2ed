"""The batcher worked by hand: every case as one batch, packet by packet, and in threes; in ms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from mlbatch.batching.batcher import Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import Arrival, Intake
from mlbatch.batching.reference import FeedPacket, Outcome, Settings
from mlbatch.batching.windows import Limit, Policy
from mlbatch.errors import ClockError
from mlbatch.types import Heads
from tests.builders.fast import run_fast
from tests.builders.hand import (
    MS,
    TEN_HZ,
    TWO,
    at_index,
    by_host,
    every,
    masked,
    packet,
    spans,
)


def _outcome(feed: Sequence[FeedPacket], settings: Settings) -> Outcome:
    """What comes of a feed, which must not depend on how its packets are grouped."""
    whole = run_fast(feed, settings, [len(feed)])
    threes = [3] * (len(feed) // 3) + [len(feed) % 3]
    assert run_fast(feed, settings, threes) == whole
    assert run_fast(feed, settings, [1] * len(feed)) == whole
    return whole


def _stamps(feed: Sequence[FeedPacket], outcome: Outcome, index: int) -> list[tuple[int, float]]:
    """(sensor, stamp in ms) of the columns of a window."""
    packets = [[one for one in feed if one.sensor == sensor] for sensor in range(5)]
    return [
        (sensor, packets[sensor][number].stamps[column] / MS)
        for sensor, number, column in at_index(outcome, index).columns
    ]


# -- bounds of windows ----------------------------------------------------------------------------


def test_the_first_window_begins_after_the_first_stamp() -> None:
    outcome = _outcome(every(0, 20, 350), TEN_HZ)
    assert outcome.t_init_ns == 100 * MS
    # 20 and 70 are in the head, 320 in the tail.
    assert spans(outcome) == [(0, 100 * MS, 200 * MS), (1, 200 * MS, 300 * MS)]
    assert outcome.dropped == [{"head": 2, "tail": 1}]
    assert (outcome.decoded, outcome.written) == ([7], [4])


def test_a_first_stamp_on_the_grid_waits_one_more_period() -> None:
    outcome = _outcome(every(0, 100, 450), TEN_HZ)
    assert outcome.t_init_ns == 200 * MS
    assert outcome.dropped == [{"head": 2, "tail": 1}]


def test_the_sensor_that_starts_last_sets_the_first_window() -> None:
    outcome = _outcome(by_host(every(0, 20, 750) + every(1, 330, 750)), TWO)
    assert outcome.t_init_ns == 400 * MS
    # 20 to 270 are before the head, 320 and 370 in it.
    assert outcome.dropped[0] == {"before_start": 6, "head": 2, "tail": 1}
    assert [window.complete for window in outcome.windows] == [True] * 3


def test_head_and_tail_are_written_with_keep_partial() -> None:
    outcome = _outcome(every(0, 20, 350), replace(TEN_HZ, keep_partial=True))
    assert [(w.index, w.complete, len(w.columns)) for w in outcome.windows] == [
        *[(-1, False, 2), (0, True, 2), (1, True, 2)],
        (2, False, 1),
    ]
    assert (outcome.dropped, outcome.incomplete) == ([{}], 2)


def test_windows_are_half_open() -> None:
    """A stamp on a bound belongs to the window that begins there."""
    feed = [packet(0, 50), packet(0, 100), packet(0, 199.999999), packet(0, 200), packet(0, 350)]
    outcome = _outcome(feed, TEN_HZ)
    assert _stamps(feed, outcome, 0) == [(0, 100), (0, 199.999999)]
    assert _stamps(feed, outcome, 1) == [(0, 200)]


def test_bounds_at_fifteen_hertz_are_rounded_up() -> None:
    outcome = _outcome(every(0, 10, 250, 10), replace(TEN_HZ, rate=Fraction(15)))
    # k / 15 s: 66.67, 133.33 and 200 ms.
    assert spans(outcome) == [(0, 66_666_667, 133_333_334), (1, 133_333_334, 200_000_000)]


def test_slices_are_published_one_by_one() -> None:
    feed = every(0, 70, 330, 10)
    outcome = _outcome(feed, replace(TEN_HZ, slices=4))
    first = [(w.slice, w.start_ns, w.end_ns) for w in outcome.windows if w.index == 0]
    assert first == [(j, (100 + 25 * j) * MS, (125 + 25 * j) * MS) for j in range(4)]
    # [100, 125) closes when its sensor is 10 ms past it.
    assert outcome.windows[0].ready_host_ns == 140 * MS


# -- order ----------------------------------------------------------------------------------------


def test_columns_are_sorted_by_stamp_sensor_delivery() -> None:
    feed = [
        *[packet(0, 50), packet(1, 50), packet(1, 120, 130), packet(0, 110, 130)],
        *[packet(0, 130, 140), packet(1, 250), packet(0, 250), packet(0, 350), packet(1, 350)],
    ]
    feed = [replace(one, stamps=one.stamps * (3 - len(one.stamps))) for one in feed]
    feed = [replace(one, valid=(True, one.stamps[0] != one.stamps[1])) for one in feed]
    outcome = _outcome(feed, TWO)
    # 130 of sensor 0 comes twice, in the order of its packets; that of sensor 1 comes after both.
    assert at_index(outcome, 0).columns == [
        *[(0, 1, 0), (1, 1, 0), (0, 1, 1), (0, 2, 0), (1, 1, 1), (0, 2, 1)],
    ]


def test_a_window_is_ready_when_the_slowest_sensor_has_passed_it() -> None:
    feed = [
        *[packet(0, 50, host_ms=51), packet(1, 50, host_ms=52), packet(0, 150, host_ms=151)],
        *[packet(1, 150, host_ms=152), packet(0, 260, host_ms=261), packet(1, 205, host_ms=262)],
        # Only 210 is past 200 and the slack of 10.
        *[packet(1, 209.999999, host_ms=263), packet(1, 210, host_ms=264)],
        *[packet(0, 350, host_ms=351), packet(1, 350, host_ms=352)],
    ]
    outcome = _outcome(feed, TWO)
    assert at_index(outcome, 0).ready_host_ns == 264 * MS
    # The end of input closes the others.
    assert at_index(outcome, 1).ready_host_ns == 352 * MS


# -- late columns ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("ahead", "late"), [(209.999999, 0), (210, 1)])
def test_a_column_is_late_once_its_own_sensor_passed_its_window(ahead: float, late: int) -> None:
    feed = [packet(0, 50), packet(0, 120), packet(0, ahead), packet(0, 190), packet(0, 350)]
    outcome = _outcome(feed, TEN_HZ)
    assert outcome.dropped[0].get("late", 0) == late
    assert _stamps(feed, outcome, 0) == [(0, 120), (0, 190)][: 2 - late]


def test_other_sensors_make_no_column_late() -> None:
    feed = [packet(0, 50), packet(1, 50), packet(0, 400), packet(1, 150), packet(1, 400)]
    outcome = _outcome(feed, TWO)
    assert "late" not in outcome.dropped[1]
    assert _stamps(feed, outcome, 0) == [(1, 150)]


def test_a_column_out_of_order_is_sorted_into_its_place() -> None:
    feed = [packet(0, 50), packet(0, 160), packet(0, 130), packet(0, 145), packet(0, 320)]
    outcome = _outcome(feed, TEN_HZ)
    assert _stamps(feed, outcome, 0) == [(0, 130), (0, 145), (0, 160)]


# -- stalls ---------------------------------------------------------------------------------------


def test_a_silent_sensor_is_stalled_after_the_timeout() -> None:
    feed = by_host(every(0, 50, 800) + every(1, 60, 260))
    outcome = _outcome(feed, replace(TWO, max_wait_ns=200 * MS))
    # Sensor 1 ends at 210; at 450 it is 240 behind, and all to 400 comes out.
    assert at_index(outcome, 1).ready_host_ns == 450 * MS
    assert [w.complete for w in outcome.windows] == [True, *[False] * 5]


def test_columns_of_published_windows_are_late_for_a_sensor_that_returns() -> None:
    ahead = every(0, 50, 1000)
    back = [packet(1, 310, host_ms=1001), packet(1, 980, host_ms=1002)]
    feed = [packet(1, 40), *ahead, *back]
    outcome = _outcome(feed, replace(TWO, max_wait_ns=200 * MS))
    # Sensor 0 came to 950, so that all to 900 was published.
    assert outcome.dropped[1] == {"head": 1, "late": 1, "tail": 1}


def test_without_a_limit_all_wait() -> None:
    feed = [packet(1, 40), *every(0, 50, 1000), packet(1, 310, host_ms=1001)]
    outcome = _outcome(feed, replace(TWO, max_wait_ns=None))
    assert outcome.dropped[1] == {"head": 1}
    assert _stamps(feed, outcome, 2) == [(0, 300), (1, 310), (0, 350)]


# -- dropped columns, empty windows ---------------------------------------------------------------


def test_empty_windows_are_counted_and_never_written() -> None:
    feed = [*every(0, 50, 300), *every(0, 2250, 2500)]
    outcome = _outcome(feed, TEN_HZ)
    # Windows 0 and 1 (to 300), then 21 (from 2200) and 22; 23 is the tail, without 2500.
    assert [window.index for window in outcome.windows] == [0, 1, 21, 22]
    assert outcome.empty == 19
    assert outcome.dropped == [{"head": 1, "tail": 2}]


def test_limits_choose_windows_by_their_start() -> None:
    settings = replace(TEN_HZ, start_ns=300 * MS, end_ns=501 * MS)
    outcome = _outcome(every(0, 50, 900), settings)
    assert spans(outcome) == [(i, (100 + 100 * i) * MS, (200 + 100 * i) * MS) for i in (2, 3, 4)]
    assert outcome.t_init_ns == 100 * MS
    assert outcome.dropped[0]["outside_time"] == 17 - 6


def test_invalid_columns_are_dropped_and_set_nothing() -> None:
    feed = [
        masked(packet(0, 10, 130), False, True),
        *[packet(0, 210, 220), packet(0, 310, 320), masked(packet(0, 430, 999), True, False)],
    ]
    outcome = _outcome(feed, TEN_HZ)
    # 130 is the first stamp: 10 does not count.
    assert outcome.t_init_ns == 200 * MS
    assert outcome.dropped == [{"invalid": 2, "head": 1, "tail": 1}]
    assert outcome.written == [4]


def test_nothing_at_all() -> None:
    outcome = _outcome([], TWO)
    assert (outcome.t_init_ns, outcome.windows, outcome.empty) == (None, [], 0)


# -- beyond the interface of the reference --------------------------------------------------------


def _arrival(position: int, stamp_ms: float, host_ms: float, place: int) -> Arrival:
    stamps = np.array([[round(stamp_ms * MS)]], np.int64)
    return Arrival(
        np.array([position]),
        np.array([round(host_ms * MS)], np.int64),
        np.array([-1], np.int64),
        Heads(stamps, np.zeros_like(stamps), np.ones((1, 1), bool)),
        np.array([place]),
    )


def _batcher(*names: str, policy: Policy | None = None) -> Batcher:
    grid = Grid(Fraction(10))
    return Batcher(grid, [Intake(name) for name in names], policy or Policy())


@pytest.mark.parametrize(("apart_ms", "comparable"), [(1000, True), (1000.000001, False)])
def test_clocks_must_be_comparable(apart_ms: float, comparable: bool) -> None:
    batcher = _batcher("left", "right")
    arrivals = [_arrival(0, 5000, 9000, 0), _arrival(1, 5000 + apart_ms, 9000, 0)]
    host_ns = np.array([9000 * MS, 9000 * MS])
    if comparable:
        assert list(batcher.push(arrivals, host_ns)) == []
        return
    with pytest.raises(ClockError) as err:
        list(batcher.push(arrivals, host_ns))
    assert str(err.value) == (
        "clocks of the sensors cannot be compared: expected at most 1 s between them, found "
        "1.000 s: stamp minus receive time is -3.000 s for right and -4.000 s for left; use "
        "--align-clocks or --clock host, or give clock.offset_s or clock.epoch in the rig"
    )


def test_the_oldest_place_that_is_needed() -> None:
    batcher = _batcher("left")
    assert batcher.oldest_place(0) is None
    for place, stamp_ms in ((7, 50), (8, 150), (9, 205)):
        host_ns = np.array([round(stamp_ms * MS)])
        list(batcher.push([_arrival(0, stamp_ms, stamp_ms, place)], host_ns))
    # At 205 the head [0, 100) has gone; 150 waits until 210.
    assert batcher.oldest_place(0) == 8
    list(batcher.push([_arrival(0, 260, 260, 10)], np.array([260 * MS])))
    assert batcher.oldest_place(0) == 9
    # 9000 is held until the next packet confirms it or not.
    list(batcher.push([_arrival(0, 9000, 261, 11)], np.array([261 * MS])))
    list(batcher.push([_arrival(0, 320, 320, 12)], np.array([320 * MS])))
    assert batcher.oldest_place(0) == 12


@pytest.mark.parametrize(("limit", "past_at_ms"), [(Limit(300 * MS), 310), (Limit(MS, True), 210)])
def test_an_end_is_passed_when_its_last_window_is_closed(limit: Limit, past_at_ms: int) -> None:
    """Limits count from time 0, or from t_init, which is 100."""
    batcher = _batcher("left", policy=Policy(end=limit))
    past = {}
    for stamp_ms in (50, 150, 209, 210, 309, 310):
        list(batcher.push([_arrival(0, stamp_ms, stamp_ms, 0)], np.array([stamp_ms * MS])))
        past[stamp_ms] = batcher.past_end
    assert past == {stamp_ms: stamp_ms >= past_at_ms for stamp_ms in past}


def test_spans_and_first_stamps_are_kept_for_the_report() -> None:
    batcher = _batcher("left", "right")
    list(batcher.push([_arrival(0, 50, 60, 0), None], np.array([60 * MS])))
    list(batcher.push([_arrival(0, 150, 155, 0), None], np.array([155 * MS])))
    assert batcher.firsts == [(50 * MS, 60 * MS), None]
    assert batcher.spans_ns == [(50 * MS, 150 * MS), None]
