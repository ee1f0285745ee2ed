"""The intake of one sensor: equal to the literal one, on any packets and batches.

The rules by hand, of the literal intake as well: `test_reference.py`.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import I64Array
from mlbatch.batching.intake import NEVER, Accepted, Arrival, Intake
from mlbatch.lidar.headers import Headers
from tests.builders.arrivals import WIDEST, accepted_by, arrival_of
from tests.builders.hand import MS, packet
from tests.reference.intake import FeedPacket, Numbers, StepError
from tests.reference.intake import Intake as LiteralIntake

S = 10**9


def _alone(*stamps_ms: float, keys: Sequence[int] = range(99)) -> Arrival:
    """Packets of a column each, received at their stamps."""
    feed = [packet(0, stamp, key=key) for stamp, key in zip(stamps_ms, keys, strict=False)]
    return arrival_of(feed, 1, np.arange(len(feed)), 0)


def _left(**options: int) -> Intake:
    return Intake("left", np.arange(1), **options)  # type: ignore[arg-type]


def _stamps_ms(accepted: Accepted) -> list[float]:
    stamps: list[float] = (accepted.columns.stamp_ns[:, 0] / MS).tolist()
    return stamps


def test_packets_of_other_sensors_and_damaged_ones_are_left_out() -> None:
    """Of five the second is another sensor's by its number, the fourth has been taken."""
    arrival = _alone(10, 20, 30, 40, 50)
    assert isinstance(arrival.content, Headers)
    arrival.content.is_mine[1] = False
    arrival.content.faults[2] = 2
    owned = np.array([False, False, False, True, False])
    intake = _left()
    accepted = intake.accept(arrival, owned)
    assert _stamps_ms(accepted) == [10, 50]
    assert owned.tolist() == [True, False, True, True, True]
    assert (accepted.read, intake.rejected) == (3, {"bad_header": 1})


def test_a_packet_is_held_until_the_next_batch() -> None:
    intake = _left()
    assert _stamps_ms(accepted_by(intake, _alone(10, 5000))) == [10]
    # The second packet's pixels must stay where they are.
    assert (intake.held_ring_index, intake.held_host_ns) == (WIDEST, 5000 * MS)
    second = accepted_by(intake, _alone(5010, keys=[2]))
    assert (_stamps_ms(second), second.position.tolist()) == ([5000, 5010], [0, 0])
    assert intake.held_ring_index is None


def test_a_pass_that_measures_clocks_takes_all_and_an_offset_is_added() -> None:
    every = _alone(10, 10, 9e6, -5, keys=[1, 1, 2, 3])
    assert len(accepted_by(_left(takes_all=True), every).host_ns) == 4
    assert _stamps_ms(accepted_by(_left(offset_ns=-37 * S), _alone(37_010, 37_020))) == [10, 20]


# Numbers wrap there in feeds.
MODULUS = 5000


@dataclass
class _Seen:
    """What an intake gives of a feed; step: stamps around the step of a clock, receive time."""

    # Position in the feed of the packet with which each is delivered, stamps of the valid columns.
    packets: list[tuple[int, int, list[int]]] = field(default_factory=list)
    newest: list[int] = field(default_factory=list)
    rejected: dict[str, int] = field(default_factory=dict)
    renumbered: int = 0
    held: list[int | None] = field(default_factory=list)  # receive time after each batch
    loss: tuple[int, int] = (0, 0)
    step: tuple[str, int] | None = None
    watched: list[tuple[int, int]] = field(default_factory=list)

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """As `Watch`."""
        self.watched += zip(stamp_ns.tolist(), host_ns.tolist(), strict=True)


def _literal(feed: Sequence[FeedPacket], sizes: Sequence[int], *, by_host: bool) -> _Seen:
    seen = _Seen()
    intake = LiteralIntake(by_host, finds_jumps=not by_host)
    numbers = Numbers(MODULUS)
    ends = set(np.cumsum(sizes).tolist())
    for at, sent in enumerate(feed):
        try:
            accepted = intake.take(sent)
        except StepError as step:
            seconds = f"from {step.before_ns / S:.6f} s to {step.after_ns / S:.6f} s"
            seen.step = seconds, step.host_ns
            return seen
        for one in accepted:
            stamps = one.valid_stamps()
            seen.packets.append((at, one.host_ns, stamps))
            seen.newest.append(max(stamps, default=NEVER))
            numbers.add(one.key)
            if stamps:
                seen.watched.append((max(stamps), one.host_ns))
        if at + 1 in ends:
            seen.held.append(None if intake.held is None else intake.held.host_ns)
    intake.finish()
    seen.rejected = intake.rejected
    seen.renumbered = intake.renumbered
    seen.loss = numbers.lost, numbers.reordered
    return seen


def _compiled(feed: Sequence[FeedPacket], sizes: Sequence[int], *, by_host: bool) -> _Seen:
    seen = _Seen()
    width = len(feed[0].stamps)
    intake = Intake(
        "left",
        np.arange(width),
        host_clock=by_host,
        modulus=MODULUS,
        finds_jumps=not by_host,
        watch=seen,
    )
    begin = 0
    for size in sizes:
        position = begin + np.arange(size)
        accepted = accepted_by(intake, arrival_of(feed[begin : begin + size], width, position, 0))
        begin += size
        if accepted.jump is not None:
            text = str(accepted.jump)
            seconds = text[text.index("from") :].replace(";", " within").split(" within")[0]
            seen.step = seconds, accepted.jump.host_ns
        columns = accepted.columns
        for row, at in enumerate(accepted.position.tolist()):
            stamps = columns.stamp_ns[row][columns.valid[row]].tolist()
            seen.packets.append((at, int(accepted.host_ns[row]), stamps))
        seen.newest += accepted.newest_ns.tolist()
        assert accepted.invalid == np.count_nonzero(~columns.valid)
        _check_order(seen.packets[len(seen.packets) - len(accepted.position) :], seen, accepted)
        if seen.step:
            return seen
        seen.held.append(intake.held_host_ns)
    intake.finish()
    seen.rejected = intake.rejected
    seen.renumbered = intake.renumbered
    seen.loss = intake.loss.lost, intake.loss.reordered
    return seen


def _check_order(
    new: Sequence[tuple[int, int, list[int]]], seen: _Seen, accepted: Accepted
) -> None:
    """How far columns are behind and ahead of the newest before them, as the batcher has it."""
    before = [
        stamp for *_, stamps in seen.packets[: len(seen.packets) - len(new)] for stamp in stamps
    ]
    newest = max(before, default=NEVER)
    behind = ahead = 0
    for *_, stamps in new:
        for stamp in stamps:
            behind = max(behind, newest - stamp)
            ahead = max(ahead, stamp - newest) if newest > NEVER else 0
            newest = max(newest, stamp)
    assert (accepted.behind_ns, accepted.ahead_ns) == (behind, ahead)


def _drawn(rng: random.Random) -> tuple[list[FeedPacket], list[int], bool]:
    """Packets of a sensor as nothing sends them, sizes of batches; whether by the host clock."""
    width = rng.choice([1, 2, 3])
    wild = rng.choice([0.0, 0.05, 0.3])
    stamp_ns, host_ns, key = rng.choice([0, 5 * S, 2**31 * S - 3 * S]), 10 * S, rng.randrange(9)
    feed: list[FeedPacket] = []
    for _ in range(rng.randint(1, 60)):
        stamp_ns += rng.choice([MS, 20 * MS, -3 * MS])
        host_ns += rng.choice([MS, 20 * MS, 0])
        key += 1
        if rng.random() < wild:
            leap_ns = rng.choice([-7 * S, -S, -S - 1, S, S + 1, 3 * S, 60 * S])
            stamp_ns += leap_ns
            host_ns += rng.choice([0, 0, abs(leap_ns)])
            key += rng.choice([0, 2, 900, 1100, 3000])
        stamps = [stamp_ns + column * MS // 2 for column in range(width)]
        if rng.random() < wild:
            stamps[rng.randrange(width)] += rng.choice([-2 * S, -S, S, 9 * S, 2**62])
        valid = tuple(rng.random() >= wild for _ in stamps)
        number = rng.choice([-1, key % 5, key]) if rng.random() < wild else key
        key_sent = number % MODULUS if number >= 0 else -1
        new = FeedPacket(0, host_ns, key_sent, tuple(stamps), valid)
        feed.append(rng.choice(feed) if feed and rng.random() < wild / 2 else new)
    sizes: list[int] = []
    most = rng.choice([1, 2, 7, len(feed)])
    while sum(sizes) < len(feed):
        sizes.append(min(rng.randint(1, most), len(feed) - sum(sizes)))
    return feed, sizes, rng.random() < 0.3


@settings(max_examples=400)
@given(st.integers(0, 2**32))
def test_the_rules_are_those_of_the_literal_intake(seed: int) -> None:
    feed, sizes, by_host = _drawn(random.Random(seed))
    seen = _compiled(feed, sizes, by_host=by_host)
    expected = _literal(feed, sizes, by_host=by_host)
    if expected.step:
        # The batch of a step is not watched.
        expected.watched = expected.watched[: len(seen.watched)]
    assert seen == expected
