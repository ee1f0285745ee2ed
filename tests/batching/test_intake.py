"""The intake of one sensor, worked by hand; times in ms, steps above 1 s need confirmation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from mlbatch.batching.intake import DUPLICATE_REACH, NEVER, Accepted, Arrival, Intake
from mlbatch.errors import ClockError
from mlbatch.types import ColumnHeaders

MS = 10**6
S = 10**9
Stamps = Sequence[float]


def _arrival(*packets: Stamps, keys: Sequence[int] = (), valid: Sequence[Stamps] = ()) -> Arrival:
    """Packets of equal width, stamps in ms; received 1 ms after their largest stamp."""
    stamps = np.array([[round(stamp * MS) for stamp in packet] for packet in packets], np.int64)
    count = len(packets)
    return Arrival(
        position=np.arange(count),
        host_ns=stamps.max(axis=1) + MS,
        key=np.array(keys or range(count), np.int64),
        headers=ColumnHeaders(
            stamps,
            np.zeros_like(stamps),
            np.array(valid, bool) if len(valid) else np.ones(stamps.shape, bool),
        ),
        ring_index=np.arange(count) * stamps.shape[1],
    )


def _stamps_ms(accepted: Accepted) -> list[list[float]]:
    rows: list[list[float]] = (accepted.packets.headers.stamp_ns / MS).tolist()
    return rows


def _alone(*stamps_ms: float, first_key: int = 0) -> Arrival:
    keys = range(first_key, first_key + len(stamps_ms))
    return _arrival(*([stamp] for stamp in stamps_ms), keys=keys)


def test_good_packets_pass_untouched() -> None:
    intake = Intake("left")
    accepted = intake.accept(_arrival([10, 20], [30, 40]))
    assert _stamps_ms(accepted) == [[10, 20], [30, 40]]
    assert accepted.newest_ns.tolist() == [20 * MS, 40 * MS]
    assert intake.rejected == {}


# -- duplicates -----------------------------------------------------------------------------------


def test_the_second_of_two_equal_packets_is_a_duplicate() -> None:
    intake = Intake("left")
    arrival = _arrival([10], [20], [10], [30], [30], keys=[5, 6, 5, 7, 7])
    assert _stamps_ms(intake.accept(arrival)) == [[10], [20], [30]]
    assert intake.rejected == {"duplicate": 2}
    assert intake.renumbered == 0


def test_other_packets_of_the_same_number_are_counted_apart() -> None:
    intake = Intake("left")
    intake.accept(_arrival([10], [20], [10], [25], keys=[5, 6, 5, 6]))
    assert (intake.rejected, intake.renumbered) == ({"duplicate": 2}, 1)
    # Across batches, and once each.
    intake.accept(_arrival([25], [30], keys=[6, 7]))
    intake.accept(_arrival([31], keys=[7]))
    assert (intake.rejected, intake.renumbered) == ({"duplicate": 4}, 2)


def test_a_duplicate_is_known_across_batches() -> None:
    intake = Intake("left")
    intake.accept(_alone(10, 20, 30))
    assert _stamps_ms(intake.accept(_alone(30, 40, first_key=2))) == [[40]]
    assert intake.rejected == {"duplicate": 1}


def test_equal_stamps_make_no_duplicate() -> None:
    intake = Intake("left")
    assert len(intake.accept(_arrival([10], [10], keys=[1, 2])).packets.key) == 2


def test_packets_without_identity_are_never_duplicates() -> None:
    intake = Intake("left")
    assert len(intake.accept(_arrival([10], [20], [30], keys=[-1, -1, -1])).packets.key) == 3


@pytest.mark.parametrize(("between", "rejected"), [(DUPLICATE_REACH - 1, 1), (DUPLICATE_REACH, 0)])
def test_numbers_repeat_after_a_while(between: int, rejected: int) -> None:
    """Frame ids wrap: what is far back is another packet."""
    intake = Intake("left")
    intake.accept(_alone(0.0))
    intake.accept(_alone(*np.arange(1, between + 1) / 10, first_key=1))
    intake.accept(_alone(between / 10 + 1))
    assert intake.rejected.get("duplicate", 0) == rejected


# -- stamps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamps", "good"),
    [
        ([-0.000001], False),
        ([0], True),
        ([2**31 * 1000 - 0.001], True),
        ([2**31 * 1000], False),
        # Columns of a packet span at most 1 s.
        ([5000, 6000], True),
        ([5000, 6000.000001], False),
    ],
)
def test_impossible_stamps(stamps: Stamps, good: bool) -> None:
    intake = Intake("left")
    accepted = intake.accept(_arrival(stamps))
    assert len(accepted.packets.key) == good
    assert intake.rejected == ({} if good else {"bad_stamp": 1})


def test_a_wild_stamp_that_the_next_packet_does_not_confirm_is_rejected() -> None:
    intake = Intake("left")
    assert _stamps_ms(intake.accept(_alone(10, 20, 7020, 30, 40))) == [[10], [20], [30], [40]]
    assert intake.rejected == {"bad_stamp": 1}
    intake.finish()
    assert intake.rejected == {"bad_stamp": 1}


@pytest.mark.parametrize(("step_ms", "held"), [(1000, False), (1000.000001, True)])
def test_a_step_of_one_second_needs_no_confirmation(step_ms: float, held: bool) -> None:
    intake = Intake("left")
    accepted = intake.accept(_alone(10, 10 + step_ms))
    assert len(accepted.packets.key) == (1 if held else 2)
    assert (intake.held_ring_index is not None) == held


def test_a_gap_is_confirmed_by_the_next_packet() -> None:
    """Both are delivered with the packet that confirms."""
    intake = Intake("left")
    accepted = intake.accept(_alone(10, 20, 5000, 5010, 5020))
    assert _stamps_ms(accepted) == [[10], [20], [5000], [5010], [5020]]
    assert accepted.packets.position.tolist() == [0, 1, 3, 3, 4]
    assert intake.rejected == {}


def test_a_packet_is_held_until_the_next_batch() -> None:
    intake = Intake("left")
    first = intake.accept(_alone(10, 5000))
    assert _stamps_ms(first) == [[10]]
    # The second packet's pixels must stay where they are.
    assert intake.held_ring_index == 1
    second = intake.accept(_alone(5010, first_key=2))
    assert _stamps_ms(second) == [[5000], [5010]]
    assert second.packets.position.tolist() == [0, 0]
    assert intake.held_ring_index is None


def test_a_packet_that_is_held_at_the_end_was_never_confirmed() -> None:
    intake = Intake("left")
    intake.accept(_alone(10, 20, 90_000))
    intake.finish()
    assert intake.rejected == {"bad_stamp": 1}
    assert intake.held_ring_index is None


def test_two_wild_packets_do_not_confirm_each_other() -> None:
    intake = Intake("left")
    assert _stamps_ms(intake.accept(_alone(10, 5000, 9000, 20))) == [[10], [20]]
    assert intake.rejected == {"bad_stamp": 2}


def test_a_reset_clock_is_an_error_that_names_both_times() -> None:
    intake = Intake("left")
    with pytest.raises(ClockError) as err:
        intake.accept(_alone(100_000, 100_010, 3, 13))
    assert str(err.value) == (
        "sensor left: clock reset within the recording: expected stamps of one continuous clock, "
        "found a step back from 100.010000 s to 0.003000 s; use --on-jump split, or --clock host"
    )


def test_a_single_step_back_is_rejected() -> None:
    intake = Intake("left")
    assert _stamps_ms(intake.accept(_alone(100_000, 3, 100_010))) == [[100_000], [100_010]]
    assert intake.rejected == {"bad_stamp": 1}


def test_invalid_columns_are_no_stamps() -> None:
    """The stamp of a masked column neither delays a packet nor counts as newest."""
    intake = Intake("left")
    arrival = _arrival([10, 10], [20, 9e6], [-5, 30], valid=[[1, 1], [1, 0], [0, 1]])
    accepted = intake.accept(arrival)
    assert accepted.newest_ns.tolist() == [10 * MS, 20 * MS, 30 * MS]
    assert intake.rejected == {}


def test_a_packet_without_a_valid_column_is_accepted() -> None:
    intake = Intake("left")
    accepted = intake.accept(_arrival([10], [9e6], [20], valid=[[1], [0], [1]]))
    assert accepted.newest_ns.tolist() == [10 * MS, NEVER, 20 * MS]


# -- clocks ---------------------------------------------------------------------------------------


def test_an_offset_is_added_to_the_stamps() -> None:
    intake = Intake("left", offset_ns=-37 * S)
    assert _stamps_ms(intake.accept(_alone(37_010, 37_020))) == [[10], [20]]


def test_the_host_clock_keeps_the_age_of_columns_within_their_packet() -> None:
    """The newest column gets the receive time of its packet."""
    intake = Intake("left", host_clock=True)
    arrival = _arrival([10, 12], [20, 22])
    arrival.host_ns = np.array([1_000_000 * MS, 1_000_011 * MS])
    accepted = intake.accept(arrival)
    assert _stamps_ms(accepted) == [[999_998, 1_000_000], [1_000_009, 1_000_011]]
    assert accepted.newest_ns.tolist() == [1_000_000 * MS, 1_000_011 * MS]


def test_loss_is_counted_of_accepted_packets_only() -> None:
    intake = Intake("left", modulus=64)
    # 2 and 3 are missing; 1 comes twice; the wild one is number 6.
    intake.accept(_arrival([10], [20], [20], [30], [50_000], [40], keys=[0, 1, 1, 4, 6, 5]))
    assert (intake.loss.lost, intake.loss.reordered) == (2, 0)
    assert intake.rejected == {"duplicate": 1, "bad_stamp": 1}
