"""Packets on their way through faults: who sent them, and their place in the new order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.types import PacketBatch

# Places count by two, so that a packet fits right behind any other.
PLACES = 2


@dataclass(slots=True)
class Traffic:
    """Packets of a batch, (n,) each.

    sensor: its number, -1 none; lane: what its packets of one size share, -1 none; number: of the
    packet in its lane; key_ns, place: packets leave in the order of both; key_ns is the largest
    arrival up to the packet (and its delay).
    """

    batch: PacketBatch
    sensor: I64Array
    lane: I64Array
    number: I64Array
    key_ns: I64Array
    place: I64Array

    def __len__(self) -> int:
        return len(self.place)

    def take(self, index: I64Array | slice) -> Traffic:
        """The packets at `index`, over the same bytes."""
        return Traffic(
            self.batch.take(index),
            self.sensor[index],
            self.lane[index],
            self.number[index],
            self.key_ns[index],
            self.place[index],
        )

    def where(self, chosen: BoolArray) -> Traffic:
        """The chosen packets; the same ones if they are all chosen."""
        return self if bool(chosen.all()) else self.take(chosen.nonzero()[0])

    def compact(self) -> Traffic:
        """The same packets in bytes of their own, which outlive the batch."""
        room = np.empty(int(self.batch.size.sum()), np.uint8)
        return replace(self, batch=joined([self.batch], room))

    def in_order(self) -> Traffic:
        """Sorted by key and place; packets that share both keep their order."""
        key, place = self.key_ns, self.place
        ahead, level = key[1:] > key[:-1], key[1:] == key[:-1]
        if bool((ahead | level & (place[1:] >= place[:-1])).all()):
            return self
        return self.take(np.lexsort((place, key)))


def nothing() -> Traffic:
    """Traffic without a packet."""
    none = np.zeros(0, np.int64)
    batch = PacketBatch(np.zeros(0, np.uint8), none, none, none, none)
    return Traffic(batch, none, none, none, none, none)


def joined(batches: Sequence[PacketBatch], out: U8Array) -> PacketBatch:
    """The packets of all batches one after the other, copied to `out` (a new one if too small)."""
    size = np.concatenate([batch.size for batch in batches])
    end = np.cumsum(size)
    start = end - size
    total = int(size.sum())
    if len(out) < total:
        out = np.empty(total * 3 // 2, np.uint8)
    first = 0
    for batch in batches:
        rows = slice(first, first + len(batch))
        _copy(batch, out, start[rows])
        first += len(batch)
    return PacketBatch(
        out,
        start,
        size,
        np.concatenate([batch.stream for batch in batches]),
        np.concatenate([batch.host_ns for batch in batches]),
    )


def _copy(batch: PacketBatch, out: U8Array, at: I64Array) -> None:
    """Copy payloads to `out`, all of one size at a time."""
    for size in np.unique(batch.size).tolist():
        if size:
            rows = (batch.size == size).nonzero()[0]
            payloads = sliding_window_view(batch.data, size)[batch.start[rows]]
            sliding_window_view(out, size, writeable=True)[at[rows]] = payloads


@dataclass(slots=True)
class Overtaking:
    """Puts packets behind the next one of their lane, to arrive together with it.

    Of each lane at most one packet waits for its next one; with it, the fault that chose it.
    """

    _waiting: dict[int, tuple[int, Traffic]] = field(default_factory=dict)

    def turn(self, traffic: Traffic, chosen: I64Array) -> tuple[list[Traffic], I64Array]:
        """The traffic after this, and the faults of those that were overtaken.

        chosen: (n,) fault that has a packet overtaken, or -1.
        """
        lots, stays = [], np.ones(len(traffic), bool)
        faults = [chosen[:0]]
        traffic = replace(
            traffic,
            batch=replace(traffic.batch, host_ns=traffic.batch.host_ns.copy()),
            key_ns=traffic.key_ns.copy(),
            place=traffic.place.copy(),
        )
        lanes = {*self._waiting, *np.unique(traffic.lane[chosen >= 0]).tolist()}
        for lane in sorted(lanes):
            rows = (traffic.lane == lane).nonzero()[0]
            if not len(rows):
                continue
            fault = chosen[rows]
            if lane in self._waiting:
                number, before = self._waiting.pop(lane)
                lots.append(_behind(before, traffic, rows[:1]))
                faults.append(np.array([number]))
                fault[0] = -1
            front = _every_second(fault >= 0).nonzero()[0]
            if len(front) and front[-1] == len(rows) - 1:
                last, front = rows[-1:], front[:-1]
                self._waiting[lane] = int(fault[-1]), traffic.take(last).compact()
                stays[last] = False
            faults.append(fault[front])
            _move(traffic, rows[front], traffic, rows[front + 1])
        return [*lots, traffic.where(stays)], np.concatenate(faults)

    def finish(self, key_ns: int, places: int) -> list[Traffic]:
        """Packets that nothing came behind: they arrive last, at `key_ns`, from `places` on."""
        rest = [traffic for _, traffic in self._waiting.values()]
        self._waiting = {}
        for traffic in rest:
            traffic.key_ns[:] = traffic.batch.host_ns[:] = key_ns
            traffic.place += places
        return rest


def _every_second(chosen: BoolArray) -> BoolArray:
    """Of each run of chosen packets the first, third, ...: the others are those that overtake."""
    at = np.arange(len(chosen))
    others = np.maximum.accumulate(np.where(chosen, -1, at))
    first: BoolArray = chosen & ((at - others) % 2 == 1)
    return first


def _behind(one: Traffic, other: Traffic, row: I64Array) -> Traffic:
    _move(one, np.zeros(1, np.int64), other, row)
    return one


def _move(traffic: Traffic, rows: I64Array, other: Traffic, behind: I64Array) -> None:
    """Have packets arrive right behind others."""
    traffic.batch.host_ns[rows] = other.batch.host_ns[behind]
    traffic.key_ns[rows] = other.key_ns[behind]
    traffic.place[rows] = other.place[behind] + 1


class Queue:
    """Holds packets until their new time has come, and merges them with the others."""

    def __init__(self) -> None:
        self._held: list[Traffic] = []
        self._out: U8Array = np.zeros(0, np.uint8)

    @property
    def held(self) -> int:
        """Packets that wait."""
        return sum(len(traffic) for traffic in self._held)

    def turn(self, lots: Sequence[Traffic], until_ns: int | None) -> Traffic:
        """Take traffic (at least one lot) in; give out, in order, all that is due by `until_ns`.

        None: all of it. No later traffic may be due before `until_ns`.
        """
        ready, later = [], []
        for traffic in self._held:
            stop = len(traffic)
            if until_ns is not None:
                stop = int(np.searchsorted(traffic.key_ns, until_ns, side="right"))
            ready.append(traffic.take(slice(0, stop)))
            later.append(traffic.take(slice(stop, None)))
        for traffic in lots:
            due = np.ones(len(traffic), bool) if until_ns is None else traffic.key_ns <= until_ns
            ready.append(traffic.where(due))
            if not due.all():
                later.append(traffic.where(~due).in_order().compact())
        self._held = [traffic for traffic in later if len(traffic)]
        return self._merged([traffic for traffic in ready if len(traffic)] or ready[:1])

    def _merged(self, ready: Sequence[Traffic]) -> Traffic:
        if len(ready) == 1:
            return ready[0].in_order()
        batch = joined([traffic.batch for traffic in ready], self._out)
        self._out = batch.data
        return Traffic(
            batch,
            np.concatenate([traffic.sensor for traffic in ready]),
            np.concatenate([traffic.lane for traffic in ready]),
            np.concatenate([traffic.number for traffic in ready]),
            np.concatenate([traffic.key_ns for traffic in ready]),
            np.concatenate([traffic.place for traffic in ready]),
        ).in_order()
