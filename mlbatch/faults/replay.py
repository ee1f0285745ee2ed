"""Fault replay: what a session would have been with packets lost, late, damaged or misdated.

What befalls a packet depends on the seed, the fault, its sensor's name and its number among that
sensor's packets of its size (so that it does not matter how IMU packets lie among the others), or
on its arrival: it is the same for every container and buffer size.
Faults act in one order, whatever the order they are given in: packets are removed, damaged,
overtaken, repeated, delayed (docs/faults.md).
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.errors import UsageError
from mlbatch.faults import specs as chance
from mlbatch.faults.specs import EVERY_SENSOR, FIRST_NS, KINDS, LAST_NS, Fault, parse_fault
from mlbatch.faults.traffic import PLACES, Overtaking, Queue, Traffic, joined, nothing
from mlbatch.types import PacketBatch

__all__ = ["KINDS", "Fault", "FaultCount", "FaultLedger", "FaultReplay", "parse_fault"]

_REMOVING = ("drop", "stall", "late", "early")
_OF_CLOCKS = ("jump", "drift")
_PER_MILLION = 1e-6
# More than the length of any payload needs.
_SIZE_BITS = 32


@dataclass(frozen=True, slots=True)
class FaultCount:
    """How many packets a fault touched; fault: as it was given."""

    fault: str
    packets: int


@dataclass(frozen=True, slots=True)
class FaultLedger:
    """Packets of one sensor: read = given + removed - repeated once all were read."""

    read: int
    removed: int
    repeated: int
    given: int


Owner = Callable[[PacketBatch], I64Array]


class FaultReplay:
    """Applies faults to the packets of a session, and to the clocks of its sensors.

    begin_ns: arrival from which the faults' times count, that of the first packet of any sensor;
    None until it was read, or was set.
    """

    def __init__(self, faults: Sequence[Fault], seed: int, names: Sequence[str]) -> None:
        """names: of the session's sensors; UsageError where a fault names another."""
        self.faults = tuple(faults)
        self.begin_ns: int | None = None
        self._sensors = len(names)
        # One entry more, at -1: packets of no sensor, which nothing befalls.
        self._targets = np.zeros((len(self.faults), len(names) + 1), bool)
        self._sources = np.zeros((len(self.faults), len(names) + 1), np.uint64)
        self._delay_ns = np.zeros(len(names) + 1, np.int64)
        for number, fault in enumerate(self.faults):
            self._targets[number, :-1] = _targets(fault, names)
            sources = [chance.source(seed, number, name) for name in names]
            self._sources[number, :-1] = np.array(sources, np.uint64)
            if fault.kind == "delay":
                self._delay_ns += np.where(self._targets[number], fault.by_ns, 0)
        self._restart()

    def _restart(self) -> None:
        self._touched = [0] * len(self.faults)
        self._read, self._removed, self._repeated, self._given = (
            np.zeros(self._sensors, np.int64) for _ in range(4)
        )
        self._packets = 0
        self._lanes: dict[int, int] = {}
        self._in_lane: list[int] = []
        self._newest_ns = FIRST_NS
        self._overtaking = Overtaking()
        self._queue = Queue()

    # -- the face -----------------------------------------------------------------------------

    def batches(self, source: Iterator[PacketBatch], owner: Owner) -> Iterator[PacketBatch]:
        """The batches of `source` as the faults leave them, each valid until the next.

        owner: sensor of each packet of a batch, -1 none. Messages stay with the batch they came
        with. May be called again: all counts restart.
        """
        self._restart()
        for batch in source:
            replayed = self._replayed(batch, owner) if len(batch) else batch
            if len(replayed) or replayed.messages:
                yield replayed
        rest = self._rest()
        if len(rest):
            yield rest

    def shift_ns(self, sensor: int, host_ns: I64Array) -> I64Array:
        """What jumps and drifts add to the stamps of packets (P,) that `batches` gave."""
        shift = np.zeros(len(host_ns), np.int64)
        since_ns = host_ns - self._delay_ns[sensor] - (self.begin_ns or 0)
        for fault, targets in zip(self.faults, self._targets, strict=True):
            if targets[sensor] and fault.kind in _OF_CLOCKS:
                drifted = np.rint(since_ns * (fault.drift_ppm * _PER_MILLION)).astype(np.int64)
                shift += np.where(_within(since_ns, fault.window_ns), fault.by_ns + drifted, 0)
        return shift

    @property
    def counts(self) -> tuple[FaultCount, ...]:
        """Packets that each fault touched so far; of clocks: those whose stamps it shifts."""
        pairs = zip(self.faults, self._touched, strict=True)
        return tuple(FaultCount(fault.text, touched) for fault, touched in pairs)

    @property
    def ledgers(self) -> tuple[FaultLedger, ...]:
        """For each sensor, what became of its packets so far."""
        columns = (self._read, self._removed, self._repeated, self._given)
        return tuple(FaultLedger(*row) for row in np.stack(columns, axis=1).tolist())

    # -- the way of a batch -------------------------------------------------------------------

    def _replayed(self, batch: PacketBatch, owner: Owner) -> PacketBatch:
        traffic = self._damaged(self._remaining(self._arriving(batch, owner(batch))))
        lots = [traffic]
        if self._of_kinds("reorder"):
            lots, overtaken = self._overtaking.turn(traffic, self._chosen("reorder", traffic))
            self._touch(overtaken)
        return replace(self._given_by(lots, self._newest_ns), messages=batch.messages)

    def _rest(self) -> PacketBatch:
        """What still waits at the end of input."""
        lots = [nothing(), *self._overtaking.finish(self._newest_ns, PLACES * self._packets)]
        return self._given_by(lots, None)

    def _given_by(self, lots: Sequence[Traffic], until_ns: int | None) -> PacketBatch:
        """What leaves by a time (None: all), repeated and delayed."""
        given = self._queue.turn([self._delayed(self._doubled(lot)) for lot in lots], until_ns)
        self._given += self._per_sensor(given.sensor)
        return given.batch

    def _arriving(self, batch: PacketBatch, sensor: I64Array) -> Traffic:
        """Number the packets of a batch."""
        owned = (sensor >= 0).nonzero()[0]
        if self.begin_ns is None and len(owned):
            self.begin_ns = int(batch.host_ns[owned[0]])
        self._read += self._per_sensor(sensor)
        # Where the recorder's clock steps back, packets still arrive in their order.
        key_ns = np.maximum(np.maximum.accumulate(batch.host_ns), self._newest_ns)
        self._newest_ns = int(key_ns[-1])
        place = PLACES * (self._packets + np.arange(len(batch)))
        self._packets += len(batch)
        lane, number = self._numbered(sensor, batch.size)
        return Traffic(replace(batch, messages=()), sensor, lane, number, key_ns, place)

    def _numbered(self, sensor: I64Array, size: I64Array) -> tuple[I64Array, I64Array]:
        """The lane of each packet (sensor and size), and its number there."""
        both = np.where(sensor >= 0, sensor << _SIZE_BITS | size, -1)
        lane, number = np.full(len(both), -1, np.int64), np.zeros(len(both), np.int64)
        for one in np.unique(both[sensor >= 0]).tolist():
            if one not in self._lanes:
                self._lanes[one] = len(self._in_lane)
                self._in_lane.append(0)
            mine = self._lanes[one]
            rows = (both == one).nonzero()[0]
            lane[rows] = mine
            number[rows] = self._in_lane[mine] + np.arange(len(rows))
            self._in_lane[mine] += len(rows)
        return lane, number

    def _remaining(self, traffic: Traffic) -> Traffic:
        stays = np.ones(len(traffic), bool)
        for number in self._of_kinds(*_REMOVING):
            hits = self._hits(number, traffic) & stays
            self._touched[number] += int(np.count_nonzero(hits))
            stays &= ~hits
        self._removed += self._per_sensor(traffic.sensor[~stays])
        traffic = traffic.where(stays)
        for number in self._of_kinds(*_OF_CLOCKS):
            self._touched[number] += int(np.count_nonzero(self._hits(number, traffic)))
        return traffic

    def _damaged(self, traffic: Traffic) -> Traffic:
        """Payloads cut short, then bits flipped in what is left of them."""
        for kind, number in product(("truncate", "bitflip"), range(len(self.faults))):
            if self.faults[number].kind == kind:
                least = 2 if kind == "truncate" else 1
                hits = self._hits(number, traffic) & (traffic.batch.size >= least)
                rows = hits.nonzero()[0]
                if len(rows):
                    drawn = chance.again(self._drawn(number, traffic)[rows])
                    batch = _DAMAGES[kind](traffic.batch, rows, drawn)
                    traffic = replace(traffic, batch=batch)
                self._touched[number] += len(rows)
        return traffic

    def _doubled(self, traffic: Traffic) -> Traffic:
        """Packets that repeat, each before its own copy."""
        chosen = self._chosen("dup", traffic)
        again = chosen >= 0
        if not again.any():
            return traffic
        self._touch(chosen)
        self._repeated += self._per_sensor(traffic.sensor[again])
        return traffic.take(np.repeat(np.arange(len(again)), 1 + again))

    def _delayed(self, traffic: Traffic) -> Traffic:
        delay_ns = self._delay_ns[traffic.sensor]
        if not delay_ns.any():
            return traffic
        for number in self._of_kinds("delay"):
            self._touched[number] += int(np.count_nonzero(self._hits(number, traffic)))
        batch = replace(traffic.batch, host_ns=traffic.batch.host_ns + delay_ns)
        return replace(traffic, batch=batch, key_ns=traffic.key_ns + delay_ns)

    # -- which packets ------------------------------------------------------------------------

    def _of_kinds(self, *kinds: str) -> list[int]:
        return [number for number, fault in enumerate(self.faults) if fault.kind in kinds]

    def _hits(self, number: int, traffic: Traffic) -> BoolArray:
        """Which packets (n,) a fault touches."""
        fault = self.faults[number]
        hits: BoolArray = self._targets[number][traffic.sensor]
        if fault.window_ns != (FIRST_NS, LAST_NS):
            since_ns = traffic.batch.host_ns - (self.begin_ns or 0)
            hits = hits & _within(since_ns, fault.window_ns)
        if fault.share < 1:
            hits = hits & chance.falls_below(self._drawn(number, traffic), fault.share)
        return hits

    def _drawn(self, number: int, traffic: Traffic) -> chance.U64Array:
        return chance.draw(self._sources[number][traffic.sensor], traffic.number)

    def _chosen(self, kind: str, traffic: Traffic) -> I64Array:
        """For each packet the first fault of a kind that touches it, or -1."""
        chosen = np.full(len(traffic), -1, np.int64)
        for number in reversed(self._of_kinds(kind)):
            chosen[self._hits(number, traffic)] = number
        return chosen

    def _touch(self, chosen: I64Array) -> None:
        for number, count in enumerate(np.bincount(chosen + 1)[1:].tolist()):
            self._touched[number] += count

    def _per_sensor(self, sensor: I64Array) -> I64Array:
        return np.bincount(sensor + 1, minlength=self._sensors + 1)[1:]


def _targets(fault: Fault, names: Sequence[str]) -> list[bool]:
    """Which sensors a fault is for."""
    if fault.sensor == EVERY_SENSOR:
        return [True] * len(names)
    if fault.sensor not in names:
        near = difflib.get_close_matches(fault.sensor, names, 1)
        advice = f"did you mean {near[0]}?" if near else "choose one, or write * for all of them"
        raise UsageError(
            f"--fault {fault.text}: wanted the name of a sensor, one of {', '.join(names)}, "
            f"got {fault.sensor!r}; {advice}"
        )
    return [name == fault.sensor for name in names]


def _within(since_ns: I64Array, window_ns: tuple[int, int]) -> BoolArray:
    inside: BoolArray = (since_ns >= window_ns[0]) & (since_ns < window_ns[1])
    return inside


def _cut(batch: PacketBatch, rows: I64Array, drawn: chance.U64Array) -> PacketBatch:
    """Payloads at `rows` cut to a length from 1 byte up to one less than all."""
    size = batch.size.copy()
    size[rows] = 1 + (drawn % (size[rows] - 1).astype(np.uint64)).astype(np.int64)
    return replace(batch, size=size)


def _flip(batch: PacketBatch, rows: I64Array, drawn: chance.U64Array) -> PacketBatch:
    """One bit of each payload at `rows` flipped, in a copy: the bytes are the reader's."""
    flipped = joined([batch.take(rows)], np.empty(int(batch.size[rows].sum()), np.uint8))
    bit = (drawn % (8 * flipped.size).astype(np.uint64)).astype(np.int64)
    flipped.data[flipped.start + bit // 8] ^= np.left_shift(1, bit % 8).astype(np.uint8)
    first, last = int(batch.start.min()), int((batch.start + batch.size).max())
    data: U8Array = np.concatenate([batch.data[first:last], flipped.data])
    start = batch.start - first
    start[rows] = last - first + flipped.start
    return replace(batch, data=data, start=start)


_DAMAGES = {"truncate": _cut, "bitflip": _flip}
