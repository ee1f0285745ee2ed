"""Sweeps and join policies, by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array, I64Array
from mlbatch.batching.sweeps import (
    CollectedSweeps,
    JoinPolicy,
    NearestSweeps,
    NewestSweeps,
    Sweep,
    SweepCutter,
    SweepSet,
    publication_order,
)
from mlbatch.units import NS_PER_MS
from tests.builders.decoded import rotor_words

Spans = list[tuple[int, int, int]]  # (first, last, ready) of sweeps, ms


def _ms(sweeps: Sequence[Sweep]) -> Spans:
    return [
        (t.first_ns // NS_PER_MS, t.last_ns // NS_PER_MS, t.ready_ns // NS_PER_MS) for t in sweeps
    ]


def _words(revolutions: F64Array) -> I64Array:
    return rotor_words(revolutions, np.zeros(len(revolutions)))


def _stamps(first_ms: int, step_ms: int, count: int) -> I64Array:
    return (first_ms + step_ms * np.arange(count)) * NS_PER_MS


# -- cutting --------------------------------------------------------------------------------------

# A column every 25 ms, four per sweep; the first cut is at the fourth column.
STAMPS = _stamps(1000, 25, 12)
WHOLE = [(1075, 1150, 1175), (1175, 1250, 1275)]


def test_measurement_ids_that_fall_back_begin_a_sweep() -> None:
    cutter = SweepCutter(3, 1024)
    sweeps = cutter.push(STAMPS, np.array([256, 512, 768, 0] * 3))
    assert _ms(sweeps) == WHOLE
    assert [(sweep.sensor, sweep.columns) for sweep in sweeps] == [(3, 4), (3, 4)]
    # The last column is the first of the next sweep.
    (sweep,) = cutter.push(_stamps(1300, 25, 4), np.array([256, 512, 768, 0]))
    assert (_ms([sweep]), sweep.columns) == ([(1275, 1350, 1375)], 4)


@pytest.mark.parametrize("sense", [1, -1])
def test_rotors_that_pass_zero_begin_a_sweep_in_both_senses(sense: int) -> None:
    place = np.array([0.35, 0.6, 0.85, 0.1] * 3)
    assert _ms(SweepCutter(0, None).push(STAMPS, _words(sense * place))) == WHOLE


def test_a_narrow_azimuth_window_has_sweeps() -> None:
    """A window of 46 of 1024 columns, 16 degrees."""
    ids = np.array([510, 525, 540, 494] * 3)
    assert _ms(SweepCutter(0, 1024).push(STAMPS, ids)) == WHOLE


def test_angles_that_jitter_begin_no_sweep() -> None:
    angles = np.array([0.1, 0.2, 0.195, 0.3, 0.295, 0.4, 0.6, 0.599, 0.8])
    assert SweepCutter(0, None).push(_stamps(0, 10, 9), _words(angles)) == []


def test_a_dropout_ends_a_sweep() -> None:
    """The driver publishes the sweep when the sensor returns."""
    stamps = np.concatenate([_stamps(0, 25, 6), _stamps(3150, 25, 6)])
    ids = np.array([0, 256, 512, 768] * 3)
    sweeps = SweepCutter(0, 1024).push(stamps, ids)
    assert _ms(sweeps) == [(100, 125, 3150), (3150, 3175, 3200)]


def test_sensors_without_a_rotor_are_cut_every_100_ms() -> None:
    sweeps = SweepCutter(0, None).push(_stamps(1030, 20, 16), np.zeros(16, np.int64))
    assert _ms(sweeps) == [(1130, 1210, 1230), (1230, 1310, 1330)]


@given(cuts=st.lists(st.integers(0, 40), max_size=5), start=st.integers(0, 15))
def test_sweeps_do_not_depend_on_how_columns_are_grouped(cuts: list[int], start: int) -> None:
    stamps = _stamps(500, 7, 40)
    ids = (start + np.arange(40)) % 16
    whole = SweepCutter(0, 16).push(stamps, ids)
    cutter = SweepCutter(0, 16)
    parts = zip(np.split(stamps, sorted(cuts)), np.split(ids, sorted(cuts)), strict=True)
    assert [sweep for part in parts for sweep in cutter.push(*part)] == whole
    assert len(whole) >= 1


# -- joining --------------------------------------------------------------------------------------


def _sweep(sensor: int, first_ms: int, length_ms: int = 100) -> Sweep:
    end_ns = (first_ms + length_ms) * NS_PER_MS
    return Sweep(sensor, first_ms * NS_PER_MS, end_ns - 1, end_ns, length_ms)


def _joined(policy: JoinPolicy, *sweeps: Sweep) -> list[tuple[int | None, ...]]:
    """Begins of the sweeps of each set, ms."""
    sets: list[SweepSet] = [
        one for sweep in publication_order(sweeps) for one in policy.publish(sweep)
    ]
    return [tuple(None if t is None else t.first_ns // NS_PER_MS for t in one) for one in sets]


def _waiting(policy: JoinPolicy) -> list[tuple[int, int]]:
    return sorted((sweep.sensor, sweep.first_ns // NS_PER_MS) for sweep in policy.waiting)


def test_latest() -> None:
    policy = NewestSweeps(2)
    sweeps = [_sweep(0, at) for at in (0, 100, 200)] + [_sweep(1, at) for at in (40, 140)]
    # At 100 ms sensor 1 has no sweep; at 200 and 300 ms its last one.
    assert _joined(policy, *sweeps) == [(100, 40), (200, 140)]
    assert _waiting(policy) == [(0, 200), (1, 140)]


def test_sweeps_that_end_together_meet() -> None:
    sweeps = [_sweep(0, 0), _sweep(1, 0), _sweep(0, 100), _sweep(1, 100)]
    for policy in (NewestSweeps(2), NearestSweeps(2, NS_PER_MS), CollectedSweeps(2, NS_PER_MS)):
        assert _joined(policy, *sweeps) == [(0, 0), (100, 100)]


def test_approximate_time() -> None:
    policy = NearestSweeps(2, 50 * NS_PER_MS)
    left = [_sweep(0, at) for at in (100, 200, 300, 400)]
    # 37 ms before and 63 ms after the sweep of 100 ms; none near that of 200 ms.
    right = [_sweep(1, at) for at in (63, 163, 310, 410)]
    assert _joined(policy, *left, *right) == [(100, 63), (200, 163), (300, 310), (400, 410)]
    far = [_sweep(1, at) for at in (163, 260, 365, 460)]
    # 260 is 40 ms from 300, and is used once; 365 is 35 ms from 400.
    assert _joined(NearestSweeps(2, 50 * NS_PER_MS), *left, *far) == [
        (200, 163),
        (300, 260),
        (400, 365),
    ]


def test_approximate_time_does_not_wait_for_a_silent_sensor() -> None:
    policy = NearestSweeps(2, 50 * NS_PER_MS)
    left = [_sweep(0, at) for at in range(0, 1000, 100)]
    assert _joined(policy, *left, _sweep(1, 0)) == [(0, 0)]
    # 700 + 50 + 250 ms have not passed at 1000 ms.
    assert _waiting(policy) == [(0, 700), (0, 800), (0, 900)]


def test_timeout_collate() -> None:
    policy = CollectedSweeps(3, 100 * NS_PER_MS)
    sweeps = [_sweep(0, 0), _sweep(1, 30), _sweep(2, 90), _sweep(0, 100), _sweep(0, 200)]
    # Complete at 190 ms. The set that opens at 200 ms times out after 300 ms.
    assert _joined(policy, *sweeps) == [(0, 30, 90)]
    assert _waiting(policy) == [(0, 100), (0, 200)]
    # The second sweep at 300 ms opened the next set.
    assert _joined(policy, _sweep(1, 230)) == [(100, None, None)]
    assert _joined(policy, _sweep(2, 290)) == [(200, 230, 290)]


def test_only_the_newest_sweep_waits_for_the_next_set() -> None:
    policy = CollectedSweeps(2, 200 * NS_PER_MS)
    sweeps = [_sweep(0, at, 50) for at in (0, 50, 100)]
    assert _joined(policy, *sweeps, _sweep(1, 60)) == [(0, 60)]
    assert _waiting(policy) == [(0, 100)]
