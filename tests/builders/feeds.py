"""Feeds of packets as rigs produce them, and worse: for the laws of batching.

One vendor draws everything from a `random.Random`: seeded it is fast (`random_feed`), and driven by
hypothesis it shrinks (`feeds`). Column rates are low, so that a few packets cross many windows.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TypeAlias

from hypothesis import strategies as st

from tests.reference.batching import FeedPacket, Settings
from tests.reference.intake import Intake, StepError

NS_PER_S = 10**9
NS_PER_MS = 10**6
SLACK_NS = 10 * NS_PER_MS

Case: TypeAlias = tuple[list[FeedPacket], Settings]
# A packet that arrives, and the valid stamps of each packet that is delivered then.
_Step: TypeAlias = tuple[FeedPacket, list[list[int]]]

RATES = [Fraction(text) for text in ("10", "15", "29.97", "10/3", "20", "7", "1", "1/4")]
RATE_WEIGHTS = [8, 4, 4, 4, 3, 2, 1, 1]
# Start of the session: a day of our time, after boot, the first and the last seconds there are.
EPOCHS_NS = [1_700_000_000 * NS_PER_S, 12_345 * NS_PER_S, 0, (2**31 - 20) * NS_PER_S]
WAITS_NS = [NS_PER_S, 200 * NS_PER_MS, 50 * NS_PER_MS, 3 * NS_PER_S, 0, None]
WAIT_WEIGHTS = [8, 4, 2, 2, 1, 4]


@dataclass(frozen=True, slots=True)
class Scene:
    """What the sensors of a feed share; quiet: no faults, all sensors run from start to end.

    jump: (when, how long) all clocks leap, ns; fault, invalid: probability a packet, a column.
    """

    settings: Settings
    epoch_ns: int
    length_ns: int
    jump: tuple[int, int]
    fault: float
    invalid: float
    quiet: bool


def random_feed(seed: int) -> Case:
    """A feed and settings, the same for the same seed."""
    return make_feed(random.Random(seed))


def feeds(*, quiet: bool = False) -> st.SearchStrategy[Case]:
    """Feeds and settings that shrink."""
    return st.randoms(use_true_random=False).map(lambda rng: make_feed(rng, quiet=quiet))


def groups(rng: random.Random, total: int) -> list[int]:
    """Sizes of the batches that `total` packets are handed over in: all, one by one, or mixed."""
    largest = rng.choice([1, 3, 10, 40, max(1, total)])
    sizes: list[int] = []
    while sum(sizes) < total:
        sizes.append(min(rng.randint(1, largest), total - sum(sizes)))
    return sizes


def make_feed(rng: random.Random, *, quiet: bool = False) -> Case:
    """Draw a scene, the packets of each sensor, and their order of receive time."""
    scene = _scene(rng, quiet)
    arrivals: list[tuple[int, int, FeedPacket]] = []
    for sensor in range(scene.settings.sensors):
        packets = spoiled(rng, _sensor_packets(rng, scene, sensor), scene.fault)
        arrivals += _arrivals(rng, packets, scene)
    arrivals.sort(key=lambda arrival: arrival[:2])
    return [replace(packet, host_ns=at) for at, _, packet in arrivals], scene.settings


def _scene(rng: random.Random, quiet: bool) -> Scene:
    sensors = rng.choice([1, 2, 2, 3, 3, 4, 5])
    epoch_ns = rng.choice(EPOCHS_NS)
    length_ns = rng.randint(200, 3000) * NS_PER_MS
    jump = (length_ns, 0)
    if rng.random() < 0.15 and epoch_ns < EPOCHS_NS[-1]:
        leap_ns = rng.choice([300 * NS_PER_MS, 1200 * NS_PER_MS, 5 * NS_PER_S, 7200 * NS_PER_S])
        jump = (rng.randint(0, length_ns), leap_ns)
    settings = Settings(
        rate=rng.choices(RATES, RATE_WEIGHTS)[0],
        sensors=sensors,
        slices=rng.choice([1, 1, 1, 2, 3, 4]),
        max_wait_ns=rng.choices(WAITS_NS, WAIT_WEIGHTS)[0],
        keep_partial=rng.random() < 0.5,
        start_ns=_limit(rng, epoch_ns, length_ns),
        end_ns=_limit(rng, epoch_ns, length_ns),
        # Stamps near time 0 would be negative on the host clock of a burst.
        host_clock=rng.random() < 0.1 and epoch_ns > 0,
    )
    fault = 0.0 if quiet else rng.choice([0, 0.02, 0.1, 0.3])
    invalid = rng.choice([0, 0, 0.1, 0.6])
    return Scene(settings, epoch_ns, length_ns, jump, fault, invalid, quiet)


def _limit(rng: random.Random, epoch_ns: int, length_ns: int) -> int | None:
    return epoch_ns + rng.randint(0, length_ns) if rng.random() < 0.12 else None


def _sensor_packets(rng: random.Random, scene: Scene, sensor: int) -> list[FeedPacket]:
    """A sensor without faults: columns at its rate, some of them on the bounds of windows."""
    settings = scene.settings
    # No packet lasts longer than 0.4 s: delay and duration alone keep clocks comparable.
    width, step_ms = rng.choice([(1, 50), (1, 5), (2, 20), (4, 10), (8, 50), (8, 10), (16, 5)])
    step_ns = step_ms * NS_PER_MS + rng.choice([0, 1, 333_333])
    jitter_ns = rng.choice([0, 0, 1000, step_ns // 2])
    begin = scene.epoch_ns + rng.choice([0, 1, rng.randint(0, 150 * NS_PER_MS)])
    end = scene.epoch_ns + scene.length_ns
    if not scene.quiet:
        begin += rng.choice([0] * 7 + [rng.randint(0, scene.length_ns)])
        end -= rng.choice([0] * 7 + [rng.randint(0, scene.length_ns)])
    columns = min(160, max(0, end - begin) // step_ns)
    stamps = [begin + i * step_ns + rng.randint(0, jitter_ns) for i in range(columns)]
    if rng.random() < 0.4:
        stamps = [_snapped(rng, stamp, settings) for stamp in stamps]
    leap_at = scene.epoch_ns + scene.jump[0]
    leap_ns = scene.jump[1]
    stamps = [stamp + leap_ns if stamp >= leap_at else stamp for stamp in stamps]
    first_key = rng.choice([0, 65_530, -1])
    packets = []
    for at in range(0, len(stamps) - width + 1, width):
        key = -1 if first_key < 0 else (first_key + at // width) % 65_536
        packets.append(_packet(rng, scene, sensor, key, stamps[at : at + width]))
    return packets


def _snapped(rng: random.Random, stamp: int, settings: Settings) -> int:
    """The stamp, often moved to a bound of a window, or to where that window closes."""
    if rng.random() < 0.5:
        return stamp
    per_ns = settings.rate * settings.slices / NS_PER_S
    bound = math.ceil(round(stamp * per_ns) / per_ns)
    moved = max(0, bound + rng.choice([-1, 0, 0, 1, SLACK_NS - 1, SLACK_NS, SLACK_NS + 1]))
    return moved if abs(moved - stamp) < 60 * NS_PER_MS else stamp


def _packet(
    rng: random.Random, scene: Scene, sensor: int, key: int, stamps: Sequence[int]
) -> FeedPacket:
    valid = tuple(rng.random() >= scene.invalid for _ in stamps)
    # What an invalid column calls its stamp means nothing.
    said = tuple(
        stamp if ok else rng.choice([stamp, 0, stamp + 7 * NS_PER_S])
        for stamp, ok in zip(stamps, valid, strict=True)
    )
    # Until packets are sorted, the host time is the time at which the packet was measured.
    return FeedPacket(sensor, max(stamps), key, said, valid)


def _arrivals(
    rng: random.Random, packets: Sequence[FeedPacket], scene: Scene
) -> list[tuple[int, int, FeedPacket]]:
    """Receive time and position of each packet: after its measurement, some in bursts, in order."""
    latency_ns = rng.randint(0, 200) * NS_PER_MS
    # More than 1 s apart clocks cannot be compared.
    offset_ns = rng.choice([0] * 120 + [-600, 600] * 3 + [-3000, 3000]) * NS_PER_MS
    burst = 0.0 if scene.quiet else rng.choice([0, 0, 0.1])
    arrivals = []
    at = 0
    begun = False
    for number, packet in enumerate(packets):
        at = max(at, packet.host_ns + latency_ns + offset_ns)
        if begun and rng.random() < burst:
            at += rng.randint(50, 1500) * NS_PER_MS
        begun = begun or any(packet.valid)
        arrivals.append((at, number, packet))
    return arrivals


@dataclass(slots=True)
class _Lag:
    """How far sensors are, by rule 4 of `reference.py`; newest, first: ns or None a sensor."""

    max_wait_ns: int | None
    newest: list[int | None]
    first: list[int | None]

    def follow(self, step: _Step) -> bool:
        """Apply the next packet; whether all sensors are still live."""
        return not any([self._stalls(step[0].sensor, stamps) for stamps in step[1]])

    def copied(self) -> _Lag:
        """The same state, to try a step on."""
        return _Lag(self.max_wait_ns, self.newest.copy(), self.first.copy())

    def _stalls(self, sensor: int, stamps: Sequence[int]) -> bool:
        if stamps:
            before = self.newest[sensor]
            self.newest[sensor] = max(stamps) if before is None else max(before, *stamps)
            self.first[sensor] = stamps[0] if before is None else self.first[sensor]
        known = [newest for newest in self.newest if newest is not None]
        if self.max_wait_ns is None or not known:
            return False
        oldest = min(first for first in self.first if first is not None)
        behind = min(oldest if newest is None else newest for newest in self.newest)
        return max(known) - behind > self.max_wait_ns


def interleavings(case: Case, rng: random.Random, count: int) -> list[list[FeedPacket]]:
    """Other orders of receive times in which no sensor is ever stalled; none if one is in the feed.

    Packets of a sensor keep their order, and all packets their host time. An order that runs into
    a dead end is given up, so there may be fewer than `count`.
    """
    feed, settings = case
    queues: list[list[_Step]] = [[] for _ in range(settings.sensors)]
    intakes = [Intake(settings.host_clock) for _ in range(settings.sensors)]
    lag = _Lag(settings.max_wait_ns, [None] * settings.sensors, [None] * settings.sensors)
    for packet in feed:
        try:
            accepted = intakes[packet.sensor].take(packet)
        except StepError:
            return []
        step = (packet, [one.valid_stamps() for one in accepted])
        queues[packet.sensor].append(step)
        if not lag.follow(step):
            return []
    merged = (_merged(rng, queues, settings) for _ in range(count))
    return [order for order in merged if order]


def _merged(
    rng: random.Random, queues: Sequence[Sequence[_Step]], settings: Settings
) -> list[FeedPacket]:
    """One order in which no sensor is ever stalled; empty if it ran into a dead end."""
    lag = _Lag(settings.max_wait_ns, [None] * settings.sensors, [None] * settings.sensors)
    taken = [0] * settings.sensors
    merged: list[FeedPacket] = []
    stay = rng.choice([0.0, 0.5, 0.95])
    current = 0
    while True:
        left = [s for s, queue in enumerate(queues) if taken[s] < len(queue)]
        if not left:
            return merged
        tries = rng.sample(left, len(left))
        if current in left and rng.random() < stay:
            tries.insert(0, current)
        for current in tries:
            step = queues[current][taken[current]]
            trial = lag.copied()
            if trial.follow(step):
                break
        else:
            return []
        lag = trial
        taken[current] += 1
        merged.append(step[0])


# -- faults ---------------------------------------------------------------------------------------

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
