"""Clocks that jump: where the session is to be cut, whatever the batches; in ms."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest

from mlbatch.batching.batcher import Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import Arrival, Intake, JumpGuard
from mlbatch.batching.windows import Policy
from mlbatch.errors import ClockJump
from mlbatch.types import Heads
from tests.builders.hand import MS

# Sensor, receive time and only stamp of a packet.
Feed = Sequence[tuple[int, int, int]]
EPOCH = 100_000


def _arrival(rows: Sequence[tuple[int, int, int, int]]) -> Arrival | None:
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
        own = [_arrival([row for row in batch if row[1] == sensor]) for sensor in (0, 1)]
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
