"""The batcher beyond what the reference shows: clocks, ring indices, limits, jumps; in ms.

Windows worked by hand are in `test_reference.py`, laws in `tests/property/test_batching.py`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest

from mlbatch.batching.batcher import Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import Accepted, Intake
from mlbatch.batching.windows import Limit, Policy
from mlbatch.errors import ClockError, ClockJump
from mlbatch.types import Window
from tests.builders.arrivals import accepted_by, arrival_of
from tests.builders.hand import MS, packet
from tests.reference.intake import FeedPacket


class _Pushed:
    """A batcher of sensors with packets of one column each."""

    def __init__(self, *names: str, policy: Policy | None = None) -> None:
        self.intakes = [Intake(name, np.zeros(1, np.int64), finds_jumps=True) for name in names]
        self.batcher = Batcher(Grid(Fraction(10)), self.intakes, policy or Policy())

    def push(self, *packets: FeedPacket, places: Sequence[int] = ()) -> list[Window]:
        """Windows that a batch closes; places: ring indices of the packets."""
        accepted: list[Accepted | None] = []
        place = np.array(places or [0] * len(packets), np.int64)
        for number, intake in enumerate(self.intakes):
            own = [at for at, one in enumerate(packets) if one.sensor == number]
            arrival = arrival_of([packets[at] for at in own], 1, np.array(own, np.int64), 0)
            arrival = arrival._replace(ring_index=place[own])
            accepted.append(accepted_by(intake, arrival) if own else None)
        host_ns = np.array([one.host_ns for one in packets], np.int64)
        return list(self.batcher.push(accepted, host_ns))


@pytest.mark.parametrize(("apart_ms", "comparable"), [(1000, True), (1000.000001, False)])
def test_clocks_must_be_comparable(apart_ms: float, comparable: bool) -> None:
    pushed = _Pushed("left", "right")
    packets = [packet(0, 5000, host_ms=9000), packet(1, 5000 + apart_ms, host_ms=9000)]
    if comparable:
        assert pushed.push(*packets) == []
        return
    with pytest.raises(ClockError) as err:
        pushed.push(*packets)
    assert str(err.value) == (
        "clocks of the sensors cannot be compared: expected at most 1 s between them, found "
        "1.000 s: stamp minus receive time is -3.000 s for right and -4.000 s for left; use "
        "--align-clocks or --clock host, or give clock.offset_s or clock.epoch in the rig"
    )


def test_the_oldest_place_that_is_needed() -> None:
    pushed = _Pushed("left")
    oldest = pushed.batcher.oldest_ring_index
    assert oldest(0) is None
    for place, stamp_ms in ((7, 50), (8, 150), (9, 205)):
        pushed.push(packet(0, stamp_ms), places=[place])
    # At 205 the head [0, 100) has gone; 150 waits until 210.
    assert oldest(0) == 8
    pushed.push(packet(0, 260), places=[10])
    assert oldest(0) == 9
    # 9000 is held until the next packet confirms it or not.
    pushed.push(packet(0, 9000, host_ms=261), places=[11])
    pushed.push(packet(0, 320), places=[12])
    assert oldest(0) == 12


@pytest.mark.parametrize(("limit", "past_at_ms"), [(Limit(300 * MS), 310), (Limit(MS, True), 210)])
def test_an_end_is_passed_when_its_last_window_is_closed(limit: Limit, past_at_ms: int) -> None:
    """Limits count from time 0, or from t_init, which is 100."""
    pushed = _Pushed("left", policy=Policy(end=limit))
    past = {}
    for stamp_ms in (50, 150, 209, 210, 309, 310):
        pushed.push(packet(0, stamp_ms))
        past[stamp_ms] = pushed.batcher.past_end
    assert past == {stamp_ms: stamp_ms >= past_at_ms for stamp_ms in past}


def test_spans_and_first_stamps_are_kept_for_the_report() -> None:
    pushed = _Pushed("left", "right")
    pushed.push(packet(0, 50, host_ms=60))
    pushed.push(packet(0, 150, host_ms=155))
    assert pushed.batcher.firsts == [(50 * MS, 60 * MS), None]
    assert pushed.batcher.spans_ns == [(50 * MS, 150 * MS), None]


# -- clocks that jump: where the session is cut, for any batches ---------------------------------

# Sensor, receive time and only stamp of a packet.
Feed = Sequence[tuple[int, int, int]]
EPOCH = 100_000


def _cut_ms(feed: Feed, *ends: int) -> int:
    """Where a feed is to be cut, pushed in batches that end at these packets."""
    with pytest.raises(ClockJump) as err:
        _push_all(feed, (0, *ends, len(feed)))
    return err.value.host_ns // MS


def _push_all(feed: Feed, ends: Sequence[int]) -> None:
    pushed = _Pushed("left", "right")
    for begin, end in itertools.pairwise(ends):
        batch = [packet(one, stamp, host_ms=host) for one, host, stamp in feed[begin:end]]
        pushed.push(*batch)


@pytest.mark.parametrize("step", [37_000, -20_000])
@pytest.mark.parametrize("ends", [(), (5,), (6,), (7,), (2, 5), tuple(range(1, 9))])
def test_clocks_that_jump_together_are_cut_at_the_first_packet_of_any(
    step: int, ends: tuple[int, ...]
) -> None:
    """The slow right one shows the jump first, with a packet that nothing confirms as yet."""
    runs = [(0, EPOCH + at, at) for at in (1, 10, 20, 30)]
    slow = [(1, EPOCH + 5, 5)]
    jumped = [(1, EPOCH + 35, 35), *((0, EPOCH + at, at) for at in (40, 50, 60))]
    feed = [(s, host, EPOCH + at) for s, host, at in sorted(runs + slow, key=lambda row: row[1])]
    feed += [(s, host, EPOCH + at + step) for s, host, at in jumped]
    assert _cut_ms(feed, *ends) == EPOCH + 35


def test_a_packet_held_long_before_is_not_where_clocks_jumped() -> None:
    feed = [(0, EPOCH, EPOCH), (1, EPOCH + 1, EPOCH + 1), (1, EPOCH + 5, EPOCH + 5000)]
    feed += [(0, EPOCH + at, EPOCH + at) for at in (500, 1000, 1500)]
    feed += [(0, EPOCH + at, EPOCH + at + 37_000) for at in (1600, 1700)]
    assert _cut_ms(feed) == EPOCH + 1600
