"""Lost and reordered packets, counted by hand from the sensor's own numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.batching.loss import Loss

# Frame ids of 16 bits, 64 packets a frame.
WRAP = 65536 * 64


def _counted(*batches: list[int], modulus: int = WRAP) -> tuple[int, int]:
    loss = Loss(modulus)
    for batch in batches:
        loss.add(np.array(batch, np.int64))
    return loss.lost, loss.reordered


@pytest.mark.parametrize(
    ("numbers", "lost", "reordered"),
    [
        ([], 0, 0),
        ([7], 0, 0),
        ([0, 1, 2, 3], 0, 0),
        # 3 and 4 are missing.
        ([0, 1, 2, 5, 6], 2, 0),
        # A packet that comes after a later one was not lost.
        ([0, 1, 3, 2, 4], 0, 1),
        ([0, 1, 4, 2, 3, 5], 0, 2),
        # 1 never comes, 2 comes late.
        ([0, 3, 2, 4], 1, 1),
        # Before the first of all nothing was known to be missing.
        ([5, 4, 6], 0, 1),
        # Every second packet of ten.
        (list(range(0, 20, 2)), 9, 0),
    ],
)
def test_numbers_worked_by_hand(numbers: list[int], lost: int, reordered: int) -> None:
    assert _counted(numbers) == (lost, reordered)


def test_numbers_wrap_with_the_frame_id() -> None:
    last = WRAP - 1
    assert _counted([last - 1, last, 0, 1]) == (0, 0)
    # `last` and 0 are missing.
    assert _counted([last - 1, 1]) == (2, 0)
    # `last` comes after 0.
    assert _counted([last - 1, 0, last, 1]) == (0, 1)


@pytest.mark.parametrize("bit", [16, 17, 19, 21])
def test_one_flipped_frame_id_does_not_count_as_a_million_lost(bit: int) -> None:
    """The packet itself is missing at its place, and that is all."""
    numbers = list(range(100, 120))
    numbers[7] ^= 1 << bit
    assert _counted(numbers) == (1, 0)


def test_a_long_gap_is_counted_when_the_next_packet_goes_on_from_there() -> None:
    # 11 to 4999 never came: 4989 packets.
    assert _counted([9, 10, 5000, 5001, 5002]) == (4989, 0)


def test_a_restart_counts_anew() -> None:
    """Frame ids begin at 0 after a power cycle; nothing is known of what was lost meanwhile."""
    assert _counted([300_000, 300_001, 0, 1, 2]) == (0, 0)
    assert _counted([300_000, 300_001, 0, 1, 3]) == (1, 0)


def test_packets_outside_the_count_are_passed_over() -> None:
    assert _counted([0, -5, 1, -900_000, 2]) == (0, 0)
    assert _counted([-1, -2]) == (0, 0)


def test_a_sensor_without_numbers_loses_nothing_that_we_know_of() -> None:
    assert _counted([4, 900, 3], modulus=0) == (0, 0)


@given(
    st.lists(st.integers(-2, 3), min_size=1, max_size=40),
    st.lists(st.integers(0, 40), max_size=5),
    st.sampled_from([0, 1000, WRAP - 10]),
)
def test_grouping_does_not_matter(steps: list[int], cuts: list[int], first: int) -> None:
    numbers = (first + np.cumsum(steps)) % WRAP
    parts = np.split(numbers, sorted(cut for cut in cuts if cut <= len(numbers)))
    loss, whole = Loss(WRAP), Loss(WRAP)
    whole.add(numbers)
    for part in parts:
        loss.add(part)
    assert (loss.lost, loss.reordered) == (whole.lost, whole.reordered)


@given(st.sets(st.integers(1, 498), max_size=200))
def test_what_is_taken_out_is_what_is_lost(gone: set[int]) -> None:
    numbers = [number for number in range(500) if number not in gone]
    assert _counted(numbers) == (len(gone), 0)


def test_a_damaged_first_packet_is_no_gap() -> None:
    """One flipped bit in the first number of all must not count as 262144 lost packets."""
    loss = Loss(65536 * 64)
    loss.add(np.array([500_000 ^ (1 << 18), 500_001, 500_002, 500_004]))
    assert (loss.lost, loss.reordered) == (1, 0)
