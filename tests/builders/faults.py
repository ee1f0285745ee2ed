"""Faults that packets of one sensor have: lost, repeated, crossed, with wild or reset stamps."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace

from tests.reference.batching import FeedPacket

NS_PER_S = 10**9
NS_PER_MS = 10**6

FAULTS = ["gap", "back", "repeat", "wild", "pair", "blind", "crossed", "edge", "reset"]
FAULT_WEIGHTS = [6, 6, 6, 4, 3, 3, 3, 3, 0.2]


def spoiled(rng: random.Random, packets: Sequence[FeedPacket], chance: float) -> list[FeedPacket]:
    """Packets of one sensor, each with a fault by `chance`.

    Gaps put off all that follows, host times too; resets change only its stamps.
    """
    out: list[FeedPacket] = []
    shift = 0
    lag = 0
    begun = False
    for packet in packets:
        packet = _shifted(packet, shift)
        fault = rng.choices(FAULTS, FAULT_WEIGHTS)[0] if rng.random() < chance else ""
        # First stamps are right or absurd: else few clocks would be comparable.
        if not begun and fault not in ("repeat", "blind", "wild"):
            fault = ""
        begun = begun or any(packet.valid)
        if fault == "gap":
            step = _gap(rng)
            shift += step
            lag += step
            packet = _shifted(packet, step)
        elif fault == "reset":
            step = -rng.randint(2, 100) * NS_PER_S
            shift += step
            packet = _shifted(packet, step)
        late = replace(packet, host_ns=packet.host_ns + lag)
        out += _with_fault(rng, fault, late, out)
    return out


def _gap(rng: random.Random) -> int:
    """A time without packets that all later stamps show."""
    small = [20, 150, 400, 990, 999, 1000, 1001, 1500]
    return rng.choice([*(ms * NS_PER_MS for ms in small), rng.choice([4, 7200]) * NS_PER_S])


def _with_fault(
    rng: random.Random, fault: str, packet: FeedPacket, before: Sequence[FeedPacket]
) -> list[FeedPacket]:
    if fault == "back":
        return [_shifted(packet, -rng.choice([5, 9, 10, 11, 50, 110, 300, 999]) * NS_PER_MS)]
    if fault == "repeat":
        return [packet, rng.choice([packet, *before[-3:]])]
    if fault == "wild":
        begun = any(any(one.valid) for one in before)
        leap = _leap(rng) if begun else rng.choice([-1, 1]) * rng.choice([5, 3000]) * NS_PER_S
        return [_renamed(_shifted(packet, leap)), packet]
    if fault == "pair":
        # Two wild packets in a row, mostly too far apart to confirm each other.
        leap = _leap(rng)
        other = leap + rng.choice([500, *[1001, 1500, 40_000] * 4]) * NS_PER_MS
        return [_renamed(_shifted(packet, leap)), _renamed(_shifted(packet, other)), packet]
    if fault == "blind":
        return [replace(packet, valid=(False,) * len(packet.valid))]
    if fault == "crossed":
        order = rng.sample(range(len(packet.stamps)), len(packet.stamps))
        stamps = [packet.stamps[i] for i in order]
        stamps[0] += rng.choice([0, 0, -1, 1]) * rng.choice([30 * NS_PER_MS, 3 * NS_PER_S])
        return [replace(packet, stamps=tuple(stamps), valid=tuple(packet.valid[i] for i in order))]
    if fault == "edge":
        return _on_the_edge(rng, packet, before[-1])
    return [packet]


def _on_the_edge(rng: random.Random, packet: FeedPacket, previous: FeedPacket) -> list[FeedPacket]:
    """Steps and spans of 1 s to the nanosecond, where packets begin to be held or rejected."""
    past = rng.choice([-1, 0, 0, 1])
    edge_ns = NS_PER_S + rng.choice([-1, 0, 0, 1])
    newest = max(previous.valid_stamps(), default=max(previous.stamps))
    forth = _shifted(packet, newest + edge_ns - max(packet.stamps))
    back = _shifted(packet, newest - edge_ns - min(packet.stamps))
    longest = packet.stamps[0] + edge_ns
    long = replace(packet, stamps=(*packet.stamps[:-1], longest))
    held = _renamed(_shifted(packet, 40 * NS_PER_S))
    after = held.stamps[0] + NS_PER_S + past - max(packet.stamps)
    ahead = held.stamps[0] - NS_PER_S - past - min(packet.stamps)
    confirming = _shifted(packet, rng.choice([after, ahead]))
    return rng.choice([[forth], [back], [long], [_renamed(forth), forth], [held, confirming]])


def _leap(rng: random.Random) -> int:
    near = rng.choice([-1, 1]) * rng.randint(900, 1200) * NS_PER_MS
    far = rng.choice([-1, 1]) * rng.choice([5, 3000, 10**6, 2**31]) * NS_PER_S
    return rng.choice([near, far])


def _shifted(packet: FeedPacket, by_ns: int) -> FeedPacket:
    return replace(packet, stamps=tuple(stamp + by_ns for stamp in packet.stamps))


def _renamed(packet: FeedPacket) -> FeedPacket:
    return replace(packet, key=-1)
