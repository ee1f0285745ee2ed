"""Laws of fault replay: equal to plain loops, for every grouping; every packet is counted."""

from __future__ import annotations

import random
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import I64Array
from mlbatch.faults import Fault, FaultReplay, parse_fault
from mlbatch.types import PacketBatch

MS = 10**6
S = 10**9
BEGIN_NS = 1_700_000_000 * S
NAMES = ["left", "right", "top"]
# Constants of SplitMix64.
WORD = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15


@dataclass(frozen=True)
class One:
    """A packet; sensor -1: none."""

    host_ns: int
    sensor: int
    payload: bytes


def packets(rng: random.Random, count: int) -> list[One]:
    """Packets of three sensors and of none; the clock of the capture host sometimes steps back."""
    at = BEGIN_NS
    found = []
    for number in range(count):
        at += rng.choice([0, 0, 1, 1, 2, 5, -3, 40]) * MS
        size = rng.choice([0, 1, 2, 8, 8, 8, 24])
        payload = number.to_bytes(4, "big") + bytes(size) if size else b""
        found.append(One(at, rng.choice([-1, 0, 0, 0, 1, 1, 2]), payload))
    return found


def batches(session: Sequence[One], sizes: Sequence[int]) -> Iterator[PacketBatch]:
    """The session in batches; all share one buffer, in reverse order."""
    data = np.zeros(sum(len(one.payload) for one in session) + 1, np.uint8)
    at = 0
    for count in sizes:
        part = session[at : at + count]
        at += count
        size = np.array([len(one.payload) for one in part], np.int64)
        start = np.cumsum(size[::-1])[::-1] - size
        data[:] = 255
        for begin, one in zip(start.tolist(), part, strict=True):
            data[begin : begin + len(one.payload)] = np.frombuffer(one.payload, np.uint8)
        host_ns = np.array([one.host_ns for one in part], np.int64)
        sensor = np.array([one.sensor for one in part], np.int64)
        yield PacketBatch(data, start, size, sensor, host_ns)


def owner(batch: PacketBatch) -> I64Array:
    """Streams have the indices of sensors here."""
    return batch.stream


def grouped(rng: random.Random, total: int) -> list[int]:
    """Sizes of batches, some of them empty."""
    largest = rng.choice([1, 3, 20, total])
    sizes = [0]
    while sum(sizes) < total:
        sizes.append(min(rng.randint(0, largest), total - sum(sizes)))
    return sizes


def replayed(replay: FaultReplay, session: Sequence[One], sizes: Sequence[int]) -> list[One]:
    """The session with faults."""
    given = []
    for batch in replay.batches(batches(session, sizes), owner):
        for start, size, stream, host_ns in zip(
            batch.start, batch.size, batch.stream, batch.host_ns, strict=True
        ):
            payload = batch.data[start : start + size].tobytes()
            given.append(One(int(host_ns), int(stream), payload))
    return given


def of(session: Sequence[One], sensor: int) -> list[One]:
    """Packets of a sensor."""
    return [one for one in session if one.sensor == sensor]


# -- the same in plain loops ----------------------------------------------------------------------


@dataclass
class Moving:
    """A packet of the reference; group: sensor and size; key: sort key."""

    one: One
    group: tuple[int, int]
    number: int
    key: list[int]


def mixed(state: int) -> int:
    """SplitMix64's output function."""
    state = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 & WORD
    state = (state ^ state >> 27) * 0x94D049BB133111EB & WORD
    return state ^ state >> 31


def drawn(seed: int, fault: int, packet: Moving) -> int:
    """The number that a fault draws for a packet."""
    state = 0
    for word in (seed, fault, zlib.crc32(NAMES[packet.one.sensor].encode())):
        state = mixed((state ^ word) + GOLDEN & WORD)
    return mixed(state + (packet.number + 1) * GOLDEN & WORD)


def reference(faults: Sequence[Fault], seed: int, session: Sequence[One]) -> list[One]:
    """The session with faults, packet by packet."""
    begin_ns = next((one.host_ns for one in session if one.sensor >= 0), 0)

    def hits(kind: str, packet: Moving) -> list[int]:
        """Faults of a kind that affect a packet."""
        return [
            number
            for number, fault in enumerate(faults)
            if fault.kind == kind
            and packet.one.sensor >= 0
            and fault.sensor in ("*", NAMES[packet.one.sensor])
            and fault.window_ns[0] <= packet.one.host_ns - begin_ns < fault.window_ns[1]
            and drawn(seed, number, packet) / 2**64 < fault.share
        ]

    numbers: Counter[tuple[int, int]] = Counter()
    left = []
    newest = 0
    for place, one in enumerate(session):
        newest = max(newest, one.host_ns)
        group = one.sensor, len(one.payload)
        packet = Moving(one, group, numbers[group], [newest, place])
        numbers[group] += 1
        if any(hits(kind, packet) for kind in ("drop", "stall", "late", "early")):
            continue
        for fault in hits("truncate", packet):
            if len(packet.one.payload) > 1:
                size = 1 + mixed(drawn(seed, fault, packet) + GOLDEN & WORD) % (
                    len(packet.one.payload) - 1
                )
                packet.one = replace(packet.one, payload=packet.one.payload[:size])
        for fault in hits("bitflip", packet):
            if packet.one.payload:
                bits = 8 * len(packet.one.payload)
                bit = mixed(drawn(seed, fault, packet) + GOLDEN & WORD) % bits
                payload = bytearray(packet.one.payload)
                payload[bit // 8] ^= 1 << bit % 8
                packet.one = replace(packet.one, payload=bytes(payload))
        left.append(packet)
    for group in {packet.group for packet in left}:
        own = [packet for packet in left if packet.group == group]
        moved = [bool(hits("reorder", packet)) for packet in own]
        at = 0
        while at < len(own):
            if not moved[at]:
                at += 1
                continue
            behind = own[at + 1] if at + 1 < len(own) else None
            own[at].key = [*behind.key, 1] if behind else [newest, len(session), *own[at].key]
            host_ns = behind.one.host_ns if behind else newest
            own[at].one = replace(own[at].one, host_ns=host_ns)
            at += 2
    out = []
    for packet in left:
        copies = 2 if hits("dup", packet) else 1
        for fault in hits("delay", packet):
            by_ns = faults[fault].by_ns
            packet.one = replace(packet.one, host_ns=packet.one.host_ns + by_ns)
            packet.key[0] += by_ns
        out += [packet] * copies
    return [packet.one for packet in sorted(out, key=lambda packet: packet.key)]


# -- laws -----------------------------------------------------------------------------------------

# hypothesis draws seed and length: many packets are too much to draw.
RANDOM = st.integers(0, 2**32 - 1).map(random.Random)
LENGTHS = st.integers(1, 120)
SHARED = ["drop", "truncate", "bitflip", "reorder", "dup"]


def drawn_faults(rng: random.Random, session: Sequence[One]) -> list[Fault]:
    """Some faults, most of them within the session."""
    length_ms = max(1, (max(one.host_ns for one in session) - BEGIN_NS) // MS)
    specs = []
    for _ in range(rng.choice([1, 2, 4, 8])):
        sensor = rng.choice([*NAMES, "*"])
        first, last = sorted(rng.sample(range(length_ms + 10), 2))
        share = rng.choice([1, 10, 30, 50, 90, 100])
        values = dict.fromkeys(SHARED, f"{share}%") | {
            "stall": f"{first}ms-{last}ms",
            "late": f"{last}ms",
            "early": f"{first}ms",
            "delay": f"{rng.choice([1, 5, 50, 1000])}ms",
        }
        kind = rng.choice([*values, *SHARED])
        specs.append(f"{kind}:{sensor}:{values[kind]}")
    return [parse_fault(spec) for spec in specs]


@settings(max_examples=150)
@given(RANDOM, LENGTHS)
def test_faults_equal_the_plain_loops(rng: random.Random, length: int) -> None:
    """For every grouping, with equal counts."""
    session = packets(rng, length)
    faults = drawn_faults(rng, session)
    seed = rng.choice([0, 1, 2**64 - 1])
    expected = reference(faults, seed, session)
    replay = FaultReplay(faults, seed, NAMES)
    counts = set()
    for _ in range(3):
        assert replayed(replay, session, grouped(rng, len(session))) == expected
        counts.add((replay.counts, replay.ledgers))
    assert len(counts) == 1


@settings(max_examples=60)
@given(RANDOM, LENGTHS)
def test_the_ledgers_balance(rng: random.Random, length: int) -> None:
    """Read = given + removed - repeated."""
    session = packets(rng, length)
    replay = FaultReplay(drawn_faults(rng, session), 7, NAMES)
    given_packets = replayed(replay, session, grouped(rng, len(session)))
    for sensor, ledger in enumerate(replay.ledgers):
        assert ledger.read == len(of(session, sensor))
        assert ledger.given == len(of(given_packets, sensor))
        assert ledger.read == ledger.given + ledger.removed - ledger.repeated
    removed = [c.packets for c, f in zip(replay.counts, replay.faults, strict=True) if _removes(f)]
    assert sum(removed) == sum(ledger.removed for ledger in replay.ledgers)
    # Packets of no sensor keep their order.
    assert of(given_packets, -1) == of(session, -1)


def _removes(fault: Fault) -> bool:
    return fault.kind in ("drop", "stall", "late", "early")


@settings(max_examples=40)
@given(RANDOM)
def test_without_faults_nothing_changes(rng: random.Random) -> None:
    session = packets(rng, 60)
    assert replayed(FaultReplay([], 3, NAMES), session, grouped(rng, 60)) == session


def steady(count: int, sensors: int = 1) -> list[One]:
    """Sensors with a packet per millisecond."""
    return [
        One(BEGIN_NS + number * MS, sensor, number.to_bytes(8, "big"))
        for number in range(count)
        for sensor in range(sensors)
    ]


@pytest.mark.parametrize("kind", SHARED)
@pytest.mark.parametrize("percent", [1, 5, 50])
def test_shares(kind: str, percent: int) -> None:
    """Within five standard deviations of the binomial distribution, over three sensors."""
    count = 20_000
    share = percent / 100
    replay = FaultReplay([parse_fault(f"{kind}:*:{percent}%")], 0, NAMES)
    total = sum(len(batch) for batch in replay.batches(batches_of(steady(count, 3)), owner))
    expected = share / (1 + share) if kind == "reorder" else share
    tolerance = 5 * (3 * count * share * (1 - share)) ** 0.5
    assert abs(replay.counts[0].packets - 3 * count * expected) < tolerance
    changed = {"drop": -1, "dup": 1}.get(kind, 0) * replay.counts[0].packets
    assert total == 3 * count + changed


def batches_of(session: Sequence[One]) -> Iterator[PacketBatch]:
    """All in one batch."""
    return batches(session, [len(session)])


def test_drops_of_sensors_and_seeds_are_independent() -> None:
    """Two draws of one half agree on half of the packets, within five standard deviations."""
    count = 4000
    session = steady(count, 2)
    lost = []
    for seed, names in ((0, NAMES[:2]), (1, NAMES[:2])):
        replay = FaultReplay([parse_fault("drop:*:50%")], seed, names)
        given_packets = replayed(replay, session, [len(session)])
        for sensor in (0, 1):
            left = {one.payload for one in of(given_packets, sensor)}
            lost.append({one.payload for one in of(session, sensor)} - left)
    for one, other in ((0, 1), (0, 2), (1, 3)):
        assert abs(count - len(lost[one] ^ lost[other]) - count / 2) < 5 * (count / 4) ** 0.5


def test_faults_of_a_sensor_do_not_depend_on_other_sensors() -> None:
    session = steady(300)
    faults = [parse_fault("drop:left:20%")]
    alone = replayed(FaultReplay(faults, 0, ["left"]), session, [300])
    second = [replace(one, sensor=1) for one in session]
    together = replayed(FaultReplay(faults, 0, ["top", "left"]), second, [300])
    assert [one.payload for one in alone] == [one.payload for one in together]


def test_packets_of_other_sizes_do_not_matter() -> None:
    """Some containers have IMU packets, or have them at other positions."""
    session = steady(300)
    others = [replace(one, payload=one.payload + b"IMU") for one in session[::7]]
    mixed_in = sorted([*session, *others], key=lambda one: (one.host_ns, -len(one.payload)))
    faults = [parse_fault(f"{kind}:left:20%") for kind in SHARED]
    alone = replayed(FaultReplay(faults, 0, NAMES), session, [300])
    for order in (mixed_in, [*session, *others]):
        together = replayed(FaultReplay(faults, 0, NAMES), order, [len(order)])
        assert Counter(alone) <= Counter(together)


def test_a_delay_keeps_the_packets_of_its_length_in_memory() -> None:
    """25 of 1000 packets wait, one per millisecond."""
    replay = FaultReplay([parse_fault("delay:left:25ms")], 0, NAMES)
    most = 0
    read = 0
    given_packets = 0
    source = batches(steady(1000), [10] * 100)
    for batch in replay.batches(source, owner):
        read = replay.ledgers[0].read
        given_packets = given_packets + len(batch)
        most = max(most, read - given_packets)
    assert most == 25
    assert given_packets == 1000


@settings(max_examples=40)
@given(st.integers(-(10**5), 10**5).filter(bool), st.integers(-(10**12), 10**12).filter(bool))
def test_drift_and_clock_steps_equal_exact_arithmetic(milli_ppm: int, step_ns: int) -> None:
    """Shifts are rounded to the nanosecond."""
    specs = [f"drift:left:{milli_ppm / 1000}ppm", f"jump:left:{step_ns}ns@100s"]
    replay = FaultReplay([parse_fault(spec) for spec in specs], 0, NAMES)
    replay.begin_ns = BEGIN_NS
    since_ns = [0, 1, 99 * S, 100 * S - 1, 100 * S, 86_400 * S]
    shift = replay.shift_ns(0, BEGIN_NS + np.array(since_ns))
    for since, found in zip(since_ns, shift.tolist(), strict=True):
        expected = since * milli_ppm / 10**9 + (step_ns if since >= 100 * S else 0)
        assert abs(found - expected) <= 1
