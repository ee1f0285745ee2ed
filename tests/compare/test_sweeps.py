"""Turns, the ways in which they are joined, and the figures of sets, by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array, I64Array
from mlbatch.compare.statistics import Tally
from mlbatch.compare.sweeps import (
    Collected,
    Nearest,
    Newest,
    Turn,
    TurnCutter,
    TurnSet,
    Way,
    in_order,
)
from mlbatch.lidar.geometry import rotor_words
from mlbatch.units import NS_PER_MS

Spans = list[tuple[int, int, int]]  # (first, last, ready) of turns, ms


def _ms(turns: Sequence[Turn]) -> Spans:
    return [
        (t.first_ns // NS_PER_MS, t.last_ns // NS_PER_MS, t.ready_ns // NS_PER_MS) for t in turns
    ]


def _words(turns: F64Array) -> I64Array:
    return rotor_words(turns, np.zeros(len(turns)))


def _stamps(first_ms: int, step_ms: int, count: int) -> I64Array:
    return (first_ms + step_ms * np.arange(count)) * NS_PER_MS


# -- cutting --------------------------------------------------------------------------------------

# A column every 25 ms, four a turn; the first cut is at the fourth column.
STAMPS = _stamps(1000, 25, 12)
WHOLE = [(1075, 1150, 1175), (1175, 1250, 1275)]


def test_measurement_ids_that_fall_back_begin_a_turn() -> None:
    cutter = TurnCutter(3, 1024)
    turns = cutter.take(STAMPS, np.array([256, 512, 768, 0] * 3))
    assert _ms(turns) == WHOLE
    assert [(turn.sensor, turn.columns) for turn in turns] == [(3, 4), (3, 4)]
    # The last column is the first of the next turn.
    (turn,) = cutter.take(_stamps(1300, 25, 4), np.array([256, 512, 768, 0]))
    assert (_ms([turn]), turn.columns) == ([(1275, 1350, 1375)], 4)


@pytest.mark.parametrize("sense", [1, -1])
def test_rotors_that_pass_zero_begin_a_turn_whichever_way_they_go(sense: int) -> None:
    place = np.array([0.35, 0.6, 0.85, 0.1] * 3)
    assert _ms(TurnCutter(0, None).take(STAMPS, _words(sense * place))) == WHOLE


def test_a_narrow_sector_has_turns_too() -> None:
    """A window of 46 of 1024 columns, 16 degrees."""
    ids = np.array([510, 525, 540, 494] * 3)
    assert _ms(TurnCutter(0, 1024).take(STAMPS, ids)) == WHOLE


def test_angles_that_jitter_begin_no_turn() -> None:
    angles = np.array([0.1, 0.2, 0.195, 0.3, 0.295, 0.4, 0.6, 0.599, 0.8])
    assert TurnCutter(0, None).take(_stamps(0, 10, 9), _words(angles)) == []


def test_a_silence_ends_a_turn_though_the_rotor_seems_to_go_on() -> None:
    """The driver publishes what it has when the sensor returns."""
    stamps = np.concatenate([_stamps(0, 25, 6), _stamps(3150, 25, 6)])
    ids = np.array([0, 256, 512, 768] * 3)
    turns = TurnCutter(0, 1024).take(stamps, ids)
    assert _ms(turns) == [(100, 125, 3150), (3150, 3175, 3200)]


def test_sensors_without_a_rotor_are_cut_every_100_ms() -> None:
    turns = TurnCutter(0, None).take(_stamps(1030, 20, 16), np.zeros(16, np.int64))
    assert _ms(turns) == [(1130, 1210, 1230), (1230, 1310, 1330)]


@given(cuts=st.lists(st.integers(0, 40), max_size=5), start=st.integers(0, 15))
def test_turns_do_not_depend_on_how_columns_are_grouped(cuts: list[int], start: int) -> None:
    stamps, ids = _stamps(500, 7, 40), (start + np.arange(40)) % 16
    whole = TurnCutter(0, 16).take(stamps, ids)
    cutter = TurnCutter(0, 16)
    parts = zip(np.split(stamps, sorted(cuts)), np.split(ids, sorted(cuts)), strict=True)
    assert [turn for part in parts for turn in cutter.take(*part)] == whole
    assert len(whole) >= 1


# -- joining --------------------------------------------------------------------------------------


def _turn(sensor: int, first_ms: int, length_ms: int = 100) -> Turn:
    end_ns = (first_ms + length_ms) * NS_PER_MS
    return Turn(sensor, first_ms * NS_PER_MS, end_ns - 1, end_ns, length_ms)


def _joined(way: Way, *turns: Turn) -> list[tuple[int | None, ...]]:
    """Begins of the turns of each set, ms."""
    sets: list[TurnSet] = [one for turn in in_order(turns) for one in way.publish(turn)]
    return [tuple(None if t is None else t.first_ns // NS_PER_MS for t in one) for one in sets]


def _waiting(way: Way) -> list[tuple[int, int]]:
    return sorted((turn.sensor, turn.first_ns // NS_PER_MS) for turn in way.waiting)


def test_newest_turns() -> None:
    way = Newest(2)
    turns = [_turn(0, at) for at in (0, 100, 200)] + [_turn(1, at) for at in (40, 140)]
    # At 100 ms there is nothing of sensor 1 yet; at 200 and 300 ms its turn that ended last.
    assert _joined(way, *turns) == [(100, 40), (200, 140)]
    assert _waiting(way) == [(0, 200), (1, 140)]


def test_turns_that_end_together_meet() -> None:
    turns = [_turn(0, 0), _turn(1, 0), _turn(0, 100), _turn(1, 100)]
    for way in (Newest(2), Nearest(2, NS_PER_MS), Collected(2, NS_PER_MS)):
        assert _joined(way, *turns) == [(0, 0), (100, 100)]


def test_nearest_turns() -> None:
    way = Nearest(2, 50 * NS_PER_MS)
    left = [_turn(0, at) for at in (100, 200, 300, 400)]
    # 37 ms before and 63 ms after the turn of 100 ms; none near that of 200 ms.
    right = [_turn(1, at) for at in (63, 163, 310, 410)]
    assert _joined(way, *left, *right) == [(100, 63), (200, 163), (300, 310), (400, 410)]
    far = [_turn(1, at) for at in (163, 260, 365, 460)]
    # 260 lies 40 ms from 300, and is used once; 365 lies 35 ms from 400.
    assert _joined(Nearest(2, 50 * NS_PER_MS), *left, *far) == [(200, 163), (300, 260), (400, 365)]


def test_nearest_turns_of_a_silent_sensor_are_not_awaited_for_ever() -> None:
    way = Nearest(2, 50 * NS_PER_MS)
    left = [_turn(0, at) for at in range(0, 1000, 100)]
    assert _joined(way, *left, _turn(1, 0)) == [(0, 0)]
    # 700 + 50 + 250 ms are not over at 1000 ms.
    assert _waiting(way) == [(0, 700), (0, 800), (0, 900)]


def test_collected_turns() -> None:
    way = Collected(3, 100 * NS_PER_MS)
    turns = [_turn(0, 0), _turn(1, 30), _turn(2, 90), _turn(0, 100), _turn(0, 200)]
    # Complete at 190 ms. The set that opens at 200 ms is over at 300 ms, but that is not yet past.
    assert _joined(way, *turns) == [(0, 30, 90)]
    assert _waiting(way) == [(0, 100), (0, 200)]
    # What came for a second time at 300 ms opened the next set.
    assert _joined(way, _turn(1, 230)) == [(100, None, None)]
    assert _joined(way, _turn(2, 290)) == [(200, 230, 290)]


def test_of_turns_that_wait_for_the_next_set_the_newest_counts() -> None:
    way = Collected(2, 200 * NS_PER_MS)
    turns = [_turn(0, at, 50) for at in (0, 50, 100)]
    assert _joined(way, *turns, _turn(1, 60)) == [(0, 60)]
    assert _waiting(way) == [(0, 100)]


# -- counting -------------------------------------------------------------------------------------


def test_figures_of_sets() -> None:
    tally = Tally("some", 2, 100 * NS_PER_MS)
    first, second, third = _turn(0, 0), _turn(0, 100), _turn(0, 400)
    late = _turn(1, 40)
    for joined in ((first, late), (second, late), (third, late), (third, None)):
        tally.add(joined)
    report = tally.report(900, [third, _turn(1, 500)])
    assert (report.sets, report.without_a_sensor) == (4, 1)
    # 400 to 500 ms with 40 to 140 ms: 360 ms older, more than two periods.
    assert report.stale == 1
    # To the last column, 1 ns before the end.
    short_ms = 1e-6
    spans = (100 - short_ms, 140 - short_ms, 460 - short_ms, 460 - short_ms)
    assert (report.span_ms.min, report.span_ms.p50) == pytest.approx(spans[:2], abs=1e-9)
    assert (report.span_ms.p99, report.span_ms.max) == pytest.approx(spans[2:], abs=1e-9)
    assert (report.apart_ms.min, report.apart_ms.p50, report.apart_ms.max) == (40, 60, 360)
    # Of 900 columns 100 wait still; `third` and `late` were used more than once.
    assert (report.columns, report.used_twice, report.never_used) == (800, 200, 400)


def test_no_set_has_no_figures() -> None:
    report = Tally("some", 2, NS_PER_MS).report(0)
    assert report.row() == ["some", "0", "0", "0", *["-"] * 6, "0", "-", "-"]
