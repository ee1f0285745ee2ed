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
from mlbatch.batching.intake import Arrival, Intake, JumpGuard
from mlbatch.batching.windows import Limit, Policy
from mlbatch.errors import ClockError, ClockJump
from mlbatch.types import Heads
from tests.builders.hand import MS


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


# -- clocks that jump: where the session is cut, for any batches ---------------------------------

# Sensor, receive time and only stamp of a packet.
Feed = Sequence[tuple[int, int, int]]
EPOCH = 100_000


def _rows(rows: Sequence[tuple[int, int, int, int]]) -> Arrival | None:
    if not rows:
        return None
    place, _, host, stamp = np.array(rows, np.int64).T
    stamps = (stamp * MS)[:, None]
    heads = Heads(stamps, np.zeros_like(stamps), np.ones(stamps.shape, bool))
    return Arrival(place, host * MS, np.full(len(place), -1), heads, place)


def _cut_ms(feed: Feed, *ends: int) -> int:
    """Where a feed is to be cut, pushed in batches that end at these packets."""
    names = ("left", "right")
    guards = [JumpGuard(name) for name in names]
    batcher = Batcher(Grid(Fraction(10)), [Intake(name) for name in names], Policy(), guards)
    with pytest.raises(ClockJump) as err:
        _push(batcher, feed, (0, *ends, len(feed)))
    return err.value.host_ns // MS


def _push(batcher: Batcher, feed: Feed, ends: Sequence[int]) -> None:
    for begin, end in itertools.pairwise(ends):
        batch = [(place, *packet) for place, packet in enumerate(feed[begin:end])]
        own = [_rows([row for row in batch if row[1] == sensor]) for sensor in (0, 1)]
        host_ns = np.array([packet[1] * MS for packet in feed[begin:end]], np.int64)
        list(batcher.push(own, host_ns))


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
