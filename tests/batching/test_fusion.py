"""Sets of sweeps with their columns, by hand: rotors of 100 ms, a column every 10 ms."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.batching.fusion import POLICIES, SweepFusion
from mlbatch.batching.merge import ColumnMerge
from mlbatch.batching.sweeps import SweepCutter
from mlbatch.batching.windows import WINDOW
from mlbatch.options import BATCHINGS
from mlbatch.types import NO_COLUMNS, Window, WindowColumns
from mlbatch.units import NS_PER_MS

TICKS = 10


def test_every_word_but_that_of_windows_is_a_policy() -> None:
    assert (WINDOW, *POLICIES) == BATCHINGS


def rotor(zero_ms: int, until_ms: int, period_ms: int = 100) -> tuple[I64Array, I64Array]:
    """Stamps from time 0, and ticks, of a rotor that passes zero at a time and then each period."""
    step_ns = period_ms * NS_PER_MS // TICKS
    first = -(zero_ms * NS_PER_MS // step_ns)
    number = np.arange(first, (until_ms - zero_ms) * NS_PER_MS // step_ns)
    return zero_ms * NS_PER_MS + number * step_ns, number % TICKS


def windows(rotors: list[tuple[I64Array, I64Array]], length_ms: int) -> list[Window]:
    """The columns of rotors in windows of a length; the ring index of a column is its number."""
    stamps = np.concatenate([stamp for stamp, _ in rotors])
    ticks = np.concatenate([tick for _, tick in rotors])
    sensor = np.arange(len(rotors)).repeat([len(stamp) for stamp, _ in rotors])
    ring = np.concatenate([np.arange(len(stamp)) for stamp, _ in rotors])
    order = stamps.argsort(kind="stable")
    columns = WindowColumns(stamps, sensor, ring, ticks).take(order)
    found = []
    window_ns = length_ms * NS_PER_MS
    for number in range(int(stamps.max()) // window_ns + 1):
        inside = np.flatnonzero(columns.stamp_ns // window_ns == number)
        found.append(
            Window(
                *(number, 0, number * window_ns, (number + 1) * window_ns, True, number),
                columns.take(inside),
                [NO_COLUMNS] * len(rotors),
                (0,) * len(rotors),
                np.ones(len(rotors), np.float32),
                False,
            )
        )
    return found


def fused(
    policy: str, rotors: list[tuple[I64Array, I64Array]], length_ms: int = 70
) -> tuple[SweepFusion, list[Window]]:
    cutters = [SweepCutter(sensor, TICKS) for sensor in range(len(rotors))]
    fusion = SweepFusion(policy, cutters, ColumnMerge([TICKS] * len(rotors)))
    sets = [one for window in windows(rotors, length_ms) for one in fusion.push(window)]
    fusion.finish()
    return fusion, sets


def spans_ms(sets: list[Window], sensor: int) -> list[tuple[int, int]]:
    """First and last stamp of a sensor in each set."""
    found = []
    for one in sets:
        own = one.columns.stamp_ns[one.columns.sensor == sensor] // NS_PER_MS
        found.append((int(own.min()), int(own.max())))
    return found


# Two rotors that pass zero at 50 and at 90 ms, to 430 ms: whole sweeps from 50, 150, 250 ms of the
# first one, and from 90, 190, 290 ms of the second one; what begins at 350 and 390 ms has no end.
PAIR = [rotor(50, 430), rotor(90, 430)]


@pytest.mark.parametrize(
    ("policy", "first", "second"),
    [
        # At 150 ms the second one has no sweep yet; at 250 ms its newest one began at 90 ms.
        ("latest", [(150, 240), (250, 340)], [(90, 180), (190, 280)]),
        # Those that began nearest, 40 ms later.
        ("approximate", [(50, 140), (150, 240), (250, 340)], [(90, 180), (190, 280), (290, 380)]),
        ("collate", [(50, 140), (150, 240), (250, 340)], [(90, 180), (190, 280), (290, 380)]),
    ],
)
def test_sets_by_hand(
    policy: str, first: list[tuple[int, int]], second: list[tuple[int, int]]
) -> None:
    _, sets = fused(policy, PAIR)
    assert spans_ms(sets, 0) == first
    assert spans_ms(sets, 1) == second
    assert [one.index for one in sets] == list(range(len(sets)))
    for one, ours, theirs in zip(sets, first, second, strict=True):
        assert one.start_ns == min(ours[0], theirs[0]) * NS_PER_MS
        assert one.end_ns == max(ours[1], theirs[1]) * NS_PER_MS + 1
        assert one.complete
        assert (np.diff(one.columns.stamp_ns) >= 0).all()
        assert len(one.columns) == 20


@pytest.mark.parametrize("policy", POLICIES)
def test_every_column_is_in_a_set_or_counted(policy: str) -> None:
    """A rotor of 10 Hz with one of 20 Hz, one of 5 Hz, and one that is silent for 2 s."""
    stamp, tick = rotor(50, 6000)
    silent = (stamp < 2000 * NS_PER_MS) | (stamp >= 4000 * NS_PER_MS)
    others = [rotor(30, 6000, 50), rotor(30, 6000, 200), (stamp[silent], tick[silent])]
    for rotors in ([rotor(20, 6000), other] for other in others):
        fusion, sets = fused(policy, rotors)
        for sensor, (stamps, _) in enumerate(rotors):
            written = sum(int((one.columns.sensor == sensor).sum()) for one in sets)
            dropped = sum(fusion.dropped[sensor].values())
            assert len(stamps) + fusion.reused[sensor] == written + dropped
        assert sum(map(len, (one.columns for one in sets))) > 500


def test_a_slow_sweep_is_used_twice_and_a_fast_one_left_out() -> None:
    fusion, sets = fused("latest", [rotor(0, 3000), rotor(0, 3000, 200)])
    # From 200 ms to 2800 ms 13 whole sweeps of 200 ms, each in two sets.
    assert fusion.reused == [0, 10 * 13]
    assert len(sets) == 2 * 13
    fusion, sets = fused("latest", [rotor(0, 3000), rotor(0, 3000, 50)])
    # Of 58 whole sweeps of 50 ms every other one is replaced before a set begins.
    assert len(sets) == 28
    assert fusion.dropped[1]["no_set"] == 10 * (58 - 28)
    assert fusion.reused == [0, 0]


def test_a_sensor_that_is_silent_is_not_repeated_for_ever() -> None:
    """After 1 s its last sweep is in no set, and its packets are not needed."""
    stamp, tick = rotor(50, 3000)
    early = stamp < 500 * NS_PER_MS
    rotors = [rotor(20, 3000), (stamp[early], tick[early])]
    cutters = [SweepCutter(sensor, TICKS) for sensor in range(2)]
    fusion = SweepFusion("latest", cutters, ColumnMerge([TICKS] * 2))
    sets = []
    for window in windows(rotors, 70):
        sets += list(fusion.push(window))
    with_both = [one.start_ns for one in sets if one.complete]
    # Its last whole sweep began at 350 ms.
    assert spans_ms([one for one in sets if one.complete], 1)[-1] == (350, 440)
    assert max(spans_ms([one for one in sets if one.complete], 0))[0] == 1320
    assert len(sets) > len(with_both) > 5
    # Only the columns of the open sweep wait.
    assert fusion.oldest_ring_index(1) == int(np.flatnonzero(stamp == 450 * NS_PER_MS)[0])


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("length_ms", [10, 100, 1000])
def test_sets_do_not_depend_on_windows(policy: str, length_ms: int) -> None:
    _, expected = fused(policy, PAIR)
    _, sets = fused(policy, PAIR, length_ms)
    assert len(sets) == len(expected) > 1
    for one, other in zip(sets, expected, strict=True):
        np.testing.assert_array_equal(one.columns.stamp_ns, other.columns.stamp_ns)
        np.testing.assert_array_equal(one.columns.ring_index, other.columns.ring_index)
