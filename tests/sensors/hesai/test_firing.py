"""Firing tables against docs/sources/hesai.md sections 5 and 12 (JT128: the file of the SDK)."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.sensors.hesai import firing
from mlbatch.sensors.hesai.firing import E128, E128_NEAR, HIGH, NEVER, OT128, SAVING, STANDARD

# Channel (from 1) and its ns, picked by eye in the sheet.
SPOTS = {
    # Of a Pandar20 in the source of the SDK: 3.62 + 1.304 a + 1.968 b us before the block's end.
    "P20A": (20, {1: -16044, 2: -3620, 9: -50732, 17: -4924, 20: -3620}),
    "P20B": (20, {1: -45492, 6: -8196, 9: -14740, 15: -21924, 20: -16044}),
    "P40": (40, {1: -42220, 8: -54670, 16: -8190, 21: -23890, 28: -6230, 40: -3620}),
    "P64": (64, {1: -23180, 16: -34988, 18: -52700, 35: -42860, 39: -6228, 64: -12748}),
    "QT64": (64, {1: 2310, 16: 33560, 17: 36610, 48: 102150, 56: 119600, 64: 136450}),
    "AT128": (128, {1: 0, 3: 8240, 5: 4114, 32: 848, 60: 13280, 80: 10768, 105: 12424, 128: 8264}),
    "JT128": (128, {1: 95180, 22: 5000, 26: 105820, 64: 94420, 88: 1200, 121: 65880, 128: 29740}),
    "XT16": (16, {1: 368, 2: 3392, 16: 45728}),
    "XT32": (32, {1: 368, 2: 1880, 32: 47240}),
    "XT32M2X": (32, {1: 368, 16: 43688, 17: 368, 18: 3256, 32: 43688}),
}
# Sums of the first row of 16 (P40: of 10), added by hand.
FIRST_ROWS = {"P40": (10, -324040), "P64": (16, -479408), "QT64": (16, 287010)}


@pytest.mark.parametrize("name", SPOTS)
def test_single_values(name: str) -> None:
    channels, spots = SPOTS[name]
    table: I64Array = getattr(firing, name)
    assert table.shape == (channels,)
    assert table.dtype == np.int64
    assert {channel: int(table[channel - 1]) for channel in spots} == spots


@pytest.mark.parametrize("name", FIRST_ROWS)
def test_sum_of_the_first_row(name: str) -> None:
    count, total = FIRST_ROWS[name]
    table: I64Array = getattr(firing, name)
    assert int(table[:count].sum()) == total


def test_tables_are_on_the_side_of_the_block_time_that_the_manual_states() -> None:
    assert firing.P40.max() == firing.P64.max() == -3620
    assert min(firing.QT64.min(), firing.XT16.min(), firing.XT32.min()) > 0


def test_beams_of_pandar20_fire_as_those_of_pandar40p_that_look_alike() -> None:
    """Channels of a Pandar40P at elevations of 8, 5, 3, 2, 1.67, 1 deg; and from 3 deg on."""
    same = [2, 3, 4, 5, 6, 8]
    assert np.abs(firing.P20A[:6] - firing.P40[same]).max() < 10
    assert np.abs(firing.P20B[:4] - firing.P40[same[2:]]).max() < 10


def test_repeated_groups_of_pandar40p() -> None:
    # Channels 37..40 fire together with 1..4.
    np.testing.assert_array_equal(firing.P40[36:], firing.P40[:4])


def test_loops_of_qt128_leave_a_quarter_silent_and_swap_halves() -> None:
    first, second = firing.QT128
    np.testing.assert_array_equal(np.flatnonzero(first == NEVER), np.arange(32))
    np.testing.assert_array_equal(np.flatnonzero(second == NEVER), np.arange(32, 64))
    assert (first[32], first[64], first[127]) == (27656, 1456, 48120)
    assert (second[0], second[64], second[127]) == (2312, 600, 48976)
    # Of four channels the first two of one loop are the last two of the other.
    np.testing.assert_array_equal(first[32:34], second[2:4])


def test_states_of_ot128() -> None:
    assert set(OT128) == {(HIGH, 0), (HIGH, 1), (HIGH, 2), (HIGH, 3), (STANDARD, 0), (STANDARD, 1)}
    np.testing.assert_array_equal(OT128[HIGH, 3], OT128[HIGH, 1])
    for state in range(4):
        silent = np.flatnonzero(OT128[HIGH, state] == NEVER)
        # Half of the outer channels: 1..24 and 89..128.
        assert len(silent) == 32
        assert not ((silent >= 24) & (silent < 88)).any()
    assert OT128[HIGH, 0][[2, 3, 6, 7, 24]].tolist() == [18867, 6289, 12578, 0, 20520]
    assert OT128[HIGH, 2][[2, 24, 127]].tolist() == [21011, 22664, 0]
    assert OT128[STANDARD, 0][[0, 1, 24, 127]].tolist() == [46645, 34067, 20520, 0]
    assert OT128[STANDARD, 1][[0, 2, 24]].tolist() == [46645, 21011, 22664]


def test_what_fires_in_both_states_of_ot128_fires_at_once_in_standard_mode() -> None:
    high, standard = OT128[HIGH, 0], OT128[STANDARD, 0]
    fires = high != NEVER
    np.testing.assert_array_equal(high[fires], standard[fires])


def test_far_field_of_pandar128() -> None:
    assert set(E128) == set(E128_NEAR)
    assert len(E128) == 4 + 2 + 2
    assert E128[HIGH, 0][[0, 1, 2, 24, 126]].tolist() == [4436, NEVER, 776, 4436, 6441]
    # Channel 7 in state 2: the vendor's 6091, not the other driver's -185.
    assert E128[HIGH, 2][6] == 6091
    assert E128[STANDARD, 0][[0, 1, 25, 127]].tolist() == [4436, 28554, 38509, 28554]
    assert E128[STANDARD, 1][[6, 25, 54]].tolist() == [6091, 37809, 51519]
    silent = {key: int((table == NEVER).sum()) for key, table in E128.items()}
    assert silent == {key: 32 if key[0] == HIGH else 0 for key in E128}
    np.testing.assert_array_equal(E128[SAVING, 1], E128[STANDARD, 1])


def test_near_field_of_pandar128_differs_in_few_channels() -> None:
    changed = {key: np.flatnonzero(E128_NEAR[key] != E128[key]) + 1 for key in E128}
    assert changed[HIGH, 0].tolist() == [1, 3, 18, 21, 40, 75, 90, 105]
    assert changed[HIGH, 3].tolist() == [24, 61, 68, 82, 108, 117, 123, 128]
    assert [len(changed[STANDARD, state]) for state in (0, 1)] == [16, 16]
    assert E128_NEAR[HIGH, 0][[0, 104]].tolist() == [5201, 5681]
    assert E128_NEAR[SAVING, 1][[11, 127]].tolist() == [7336, 29319]


def test_tables_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        firing.QT128[0, 0] = 1
