"""Fault replay: the packets of a session as if some were lost, late, damaged or misdated.

What a fault does to a packet depends on the seed, the fault, the name of the sensor, and the number
of the packet among those of its sensor and size (so that the position of IMU packets does not
matter), or on its receive time: it is the same for every container and buffer size. Faults are
applied in one order, whatever the order they are given in: packets are removed, damaged,
reordered, repeated, delayed (docs/faults.md).
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.errors import UsageError
from mlbatch.faults.draws import U64Array, draw, is_below, second_draw, stream_state
from mlbatch.faults.specs import EVERY_SENSOR, FIRST_NS, LAST_NS, Fault
from mlbatch.faults.traffic import (
    ORDER_STEP,
    PacketQueue,
    Reorder,
    Traffic,
    concatenated,
    no_traffic,
)
from mlbatch.types import PacketBatch

_REMOVING = ("drop", "stall", "late", "early")
_CLOCKS = ("jump", "drift")
_PER_MILLION = 1e-6
# Bits of the payload size in the key of a group.
_SIZE_BITS = 32


@dataclass(frozen=True, slots=True)
class FaultCount:
    """Number of packets that a fault affected; fault: as the user wrote it."""

    fault: str
    packets: int


@dataclass(frozen=True, slots=True)
class FaultLedger:
    """Packets of one sensor; at the end, read = given + removed - repeated."""

    # Packets of the recording.
    read: int
    # Packets that a fault dropped.
    removed: int
    # Copies that a fault added.
    repeated: int
    # Packets after the faults.
    given: int


# Sensor of each packet (n,) of a batch; -1: none.
Owner = Callable[[PacketBatch], I64Array]


class FaultReplay:
    """Applies faults to the packets of a session, and to the clocks of its sensors.

    begin_ns: receive time of the first packet of any sensor, from which the times of faults count;
    None until that packet was read, unless set.
    """

    def __init__(self, faults: Sequence[Fault], seed: int, names: Sequence[str]) -> None:
        """names: of the sensors; raises UsageError for a fault of another sensor."""
        self.faults = tuple(faults)
        self.begin_ns: int | None = None
        self._sensors = len(names)
        # The last column, index -1, is for packets of no sensor: no fault affects them.
        shape = (len(self.faults), len(names) + 1)
        self._targets = np.zeros(shape, bool)
        self._states = np.zeros(shape, np.uint64)
        self._delay_ns = np.zeros(len(names) + 1, np.int64)
        for index, fault in enumerate(self.faults):
            self._targets[index, :-1] = _targets(fault, names)
            states = [stream_state(seed, index, name) for name in names]
            self._states[index, :-1] = np.array(states, np.uint64)
            if fault.kind == "delay":
                self._delay_ns += np.where(self._targets[index], fault.by_ns, 0)
        self._restart()

    def _restart(self) -> None:
        # Packets affected by each fault.
        self._affected = [0] * len(self.faults)
        # Packets of each sensor, as in FaultLedger.
        self._read = np.zeros(self._sensors, np.int64)
        self._removed = np.zeros(self._sensors, np.int64)
        self._repeated = np.zeros(self._sensors, np.int64)
        self._given = np.zeros(self._sensors, np.int64)
        self._packets = 0
        # Index of each group by sensor and size, and its number of packets.
        self._groups: dict[int, int] = {}
        self._group_packets: list[int] = []
        self._newest_ns = FIRST_NS
        self._reorder = Reorder()
        self._queue = PacketQueue()

    # -- interface ----------------------------------------------------------------------------

    def batches(self, source: Iterator[PacketBatch], owner: Owner) -> Iterator[PacketBatch]:
        """The batches of `source` with faults, each valid until the next.

        Messages stay with their batch. May be called again: all counts restart.
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
        """Clock steps and drifts to add to the timestamps of packets (P,) given by `batches`."""
        shift_ns = np.zeros(len(host_ns), np.int64)
        since_ns = host_ns - self._delay_ns[sensor] - (self.begin_ns or 0)
        for fault, targets in zip(self.faults, self._targets, strict=True):
            if targets[sensor] and fault.kind in _CLOCKS:
                drift_ns = np.rint(since_ns * (fault.drift_ppm * _PER_MILLION)).astype(np.int64)
                shift_ns += np.where(_within(since_ns, fault.window_ns), fault.by_ns + drift_ns, 0)
        return shift_ns

    @property
    def counts(self) -> tuple[FaultCount, ...]:
        """Packets affected by each fault so far; clock faults: packets with changed timestamps."""
        pairs = zip(self.faults, self._affected, strict=True)
        return tuple(FaultCount(fault.text, affected) for fault, affected in pairs)

    @property
    def ledgers(self) -> tuple[FaultLedger, ...]:
        """Packets of each sensor so far."""
        columns = (self._read, self._removed, self._repeated, self._given)
        return tuple(FaultLedger(*row) for row in np.stack(columns, axis=1).tolist())

    # -- stages -------------------------------------------------------------------------------

    def _replayed(self, batch: PacketBatch, owner: Owner) -> PacketBatch:
        traffic = self._numbered(batch, owner(batch))
        traffic = self._remove(traffic)
        self._count_clock_faults(traffic)
        traffic = self._damage(traffic)
        parts = [traffic]
        if self._of_kinds("reorder"):
            parts, moved_by = self._reorder.apply(traffic, self._first_fault("reorder", traffic))
            self._count(moved_by)
        return replace(self._give(parts, self._newest_ns), messages=batch.messages)

    def _rest(self) -> PacketBatch:
        """Packets that wait at the end of input."""
        order = ORDER_STEP * self._packets
        return self._give([no_traffic(), *self._reorder.finish(self._newest_ns, order)], None)

    def _give(self, parts: Sequence[Traffic], until_ns: int | None) -> PacketBatch:
        """Repeat and delay packets; return those due by `until_ns` (None: all)."""
        parts = [self._delay(self._repeat(part)) for part in parts]
        given = self._queue.push(parts, until_ns)
        self._given += self._per_sensor(given.sensor)
        return given.batch

    def _numbered(self, batch: PacketBatch, sensor: I64Array) -> Traffic:
        """Number the packets of a batch."""
        owned = (sensor >= 0).nonzero()[0]
        if self.begin_ns is None and len(owned):
            self.begin_ns = int(batch.host_ns[owned[0]])
        self._read += self._per_sensor(sensor)
        # Where the clock of the capture host steps back, packets keep the order of the recording.
        key_ns = np.maximum(np.maximum.accumulate(batch.host_ns), self._newest_ns)
        self._newest_ns = int(key_ns[-1])
        order = ORDER_STEP * (self._packets + np.arange(len(batch)))
        self._packets += len(batch)
        group, number = self._grouped(sensor, batch.size)
        return Traffic(replace(batch, messages=()), sensor, group, number, key_ns, order)

    def _grouped(self, sensor: I64Array, size: I64Array) -> tuple[I64Array, I64Array]:
        """Group (sensor and size) of each packet, and its number there."""
        key = np.where(sensor >= 0, sensor << _SIZE_BITS | size, -1)
        group = np.full(len(key), -1, np.int64)
        number = np.zeros(len(key), np.int64)
        for one in np.unique(key[sensor >= 0]).tolist():
            if one not in self._groups:
                self._groups[one] = len(self._group_packets)
                self._group_packets.append(0)
            index = self._groups[one]
            rows = (key == one).nonzero()[0]
            group[rows] = index
            number[rows] = self._group_packets[index] + np.arange(len(rows))
            self._group_packets[index] += len(rows)
        return group, number

    def _remove(self, traffic: Traffic) -> Traffic:
        """Drop packets; the first fault that removes a packet counts it."""
        stays = np.ones(len(traffic), bool)
        for index in self._of_kinds(*_REMOVING):
            hits = self._hits(index, traffic) & stays
            self._affected[index] += int(np.count_nonzero(hits))
            stays &= ~hits
        self._removed += self._per_sensor(traffic.sensor[~stays])
        return traffic.where(stays)

    def _count_clock_faults(self, traffic: Traffic) -> None:
        for index in self._of_kinds(*_CLOCKS):
            self._affected[index] += int(np.count_nonzero(self._hits(index, traffic)))

    def _damage(self, traffic: Traffic) -> Traffic:
        """Truncate payloads, then flip bits in what is left."""
        for kind, (damage, min_size) in _DAMAGES.items():
            for index in self._of_kinds(kind):
                hits = self._hits(index, traffic) & (traffic.batch.size >= min_size)
                rows = hits.nonzero()[0]
                if len(rows):
                    drawn = second_draw(self._draw(index, traffic)[rows])
                    traffic = replace(traffic, batch=damage(traffic.batch, rows, drawn))
                self._affected[index] += len(rows)
        return traffic

    def _repeat(self, traffic: Traffic) -> Traffic:
        """Repeat packets, each right behind the original."""
        fault = self._first_fault("dup", traffic)
        repeated = fault >= 0
        if not repeated.any():
            return traffic
        self._count(fault)
        self._repeated += self._per_sensor(traffic.sensor[repeated])
        return traffic.take(np.repeat(np.arange(len(repeated)), 1 + repeated))

    def _delay(self, traffic: Traffic) -> Traffic:
        delay_ns = self._delay_ns[traffic.sensor]
        if not delay_ns.any():
            return traffic
        for index in self._of_kinds("delay"):
            self._affected[index] += int(np.count_nonzero(self._hits(index, traffic)))
        batch = replace(traffic.batch, host_ns=traffic.batch.host_ns + delay_ns)
        return replace(traffic, batch=batch, key_ns=traffic.key_ns + delay_ns)

    # -- which packets ------------------------------------------------------------------------

    def _of_kinds(self, *kinds: str) -> list[int]:
        """Indices of the faults of these kinds."""
        return [index for index, fault in enumerate(self.faults) if fault.kind in kinds]

    def _hits(self, index: int, traffic: Traffic) -> BoolArray:
        """Packets (n,) that a fault affects."""
        fault = self.faults[index]
        hits: BoolArray = self._targets[index][traffic.sensor]
        if fault.window_ns != (FIRST_NS, LAST_NS):
            since_ns = traffic.batch.host_ns - (self.begin_ns or 0)
            hits = hits & _within(since_ns, fault.window_ns)
        if fault.share < 1:
            hits = hits & is_below(self._draw(index, traffic), fault.share)
        return hits

    def _draw(self, index: int, traffic: Traffic) -> U64Array:
        return draw(self._states[index][traffic.sensor], traffic.number)

    def _first_fault(self, kind: str, traffic: Traffic) -> I64Array:
        """Index of the first fault of a kind that affects each packet, or -1."""
        first = np.full(len(traffic), -1, np.int64)
        for index in reversed(self._of_kinds(kind)):
            first[self._hits(index, traffic)] = index
        return first

    def _count(self, fault: I64Array) -> None:
        """Count one packet for each fault index; -1 is ignored."""
        for index, count in enumerate(np.bincount(fault + 1)[1:].tolist()):
            self._affected[index] += count

    def _per_sensor(self, sensor: I64Array) -> I64Array:
        return np.bincount(sensor + 1, minlength=self._sensors + 1)[1:]


def _targets(fault: Fault, names: Sequence[str]) -> list[bool]:
    """Whether the fault is for each sensor; raises UsageError for another name."""
    if fault.sensor == EVERY_SENSOR:
        return [True] * len(names)
    if fault.sensor not in names:
        near = difflib.get_close_matches(fault.sensor, names, 1)
        advice = f"did you mean {near[0]}?" if near else "choose one, or write * for all of them"
        raise UsageError(
            f"--fault {fault.text}: expected the name of a sensor, one of {', '.join(names)}, "
            f"found {fault.sensor!r}; {advice}"
        )
    return [name == fault.sensor for name in names]


def _within(since_ns: I64Array, window_ns: tuple[int, int]) -> BoolArray:
    inside: BoolArray = (since_ns >= window_ns[0]) & (since_ns < window_ns[1])
    return inside


def _truncate(batch: PacketBatch, rows: I64Array, drawn: U64Array) -> PacketBatch:
    """Cut the payloads at `rows` to a length from 1 byte to one byte less."""
    size = batch.size.copy()
    size[rows] = 1 + (drawn % (size[rows] - 1).astype(np.uint64)).astype(np.int64)
    return replace(batch, size=size, content_key=None)


def _flip_bit(batch: PacketBatch, rows: I64Array, drawn: U64Array) -> PacketBatch:
    """Flip one bit of each payload at `rows`, in a copy: the reader owns the bytes."""
    flipped = concatenated([batch.take(rows)], np.empty(int(batch.size[rows].sum()), np.uint8))
    bit = (drawn % (8 * flipped.size).astype(np.uint64)).astype(np.int64)
    flipped.data[flipped.start + bit // 8] ^= np.left_shift(1, bit % 8).astype(np.uint8)
    first = int(batch.start.min())
    last = int((batch.start + batch.size).max())
    data: U8Array = np.concatenate([batch.data[first:last], flipped.data])
    start = batch.start - first
    start[rows] = last - first + flipped.start
    return replace(batch, data=data, start=start, place=None, content_key=None)


# By kind, in the order of application: function, and smallest payload that can be damaged.
_DAMAGES = {"truncate": (_truncate, 2), "bitflip": (_flip_bit, 1)}
