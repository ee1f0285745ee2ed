"""Packets on their way through the faults: reordered, delayed, merged in their new order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.types import PacketBatch

# Step of `Traffic.order`, so that one packet fits between two others.
ORDER_STEP = 2


@dataclass(slots=True)
class Traffic:
    """Packets of a batch, with (n,) values each; they are output by (`key_ns`, `order`)."""

    batch: PacketBatch
    # Index of the sensor; -1: none.
    sensor: I64Array
    # Index of the group: packets of one sensor and one size; -1: none.
    group: I64Array
    # Number of the packet in its group.
    number: I64Array
    # Largest receive time up to the packet, plus its delay.
    key_ns: I64Array
    order: I64Array

    def __len__(self) -> int:
        return len(self.order)

    def take(self, index: I64Array | slice) -> Traffic:
        """The packets at `index`; payloads are shared."""
        return Traffic(
            self.batch.take(index),
            self.sensor[index],
            self.group[index],
            self.number[index],
            self.key_ns[index],
            self.order[index],
        )

    def where(self, chosen: BoolArray) -> Traffic:
        """The chosen packets; `self` if all are chosen."""
        return self if bool(chosen.all()) else self.take(chosen.nonzero()[0])

    def copied(self) -> Traffic:
        """The same packets with a copy of their payloads, which outlives the batch."""
        buffer = np.empty(int(self.batch.size.sum()), np.uint8)
        return replace(self, batch=concatenated([self.batch], buffer))

    def in_order(self) -> Traffic:
        """Sorted by key and order; equal packets keep their positions."""
        key_ns = self.key_ns
        order = self.order
        later = key_ns[1:] > key_ns[:-1]
        same = key_ns[1:] == key_ns[:-1]
        if bool((later | same & (order[1:] >= order[:-1])).all()):
            return self
        return self.take(np.lexsort((order, key_ns)))


def no_traffic() -> Traffic:
    """Traffic without packets."""
    none = np.zeros(0, np.int64)
    batch = PacketBatch(np.zeros(0, np.uint8), none, none, none, none)
    return Traffic(batch, none, none, none, none, none)


def concatenated(batches: Sequence[PacketBatch], buffer: U8Array) -> PacketBatch:
    """The packets of all batches, copied to `buffer`, or to a new one if it is too small."""
    size = np.concatenate([batch.size for batch in batches])
    end = np.cumsum(size)
    start = end - size
    total = int(size.sum())
    if len(buffer) < total:
        buffer = np.empty(total * 3 // 2, np.uint8)
    first = 0
    for batch in batches:
        rows = slice(first, first + len(batch))
        _copy_payloads(batch, buffer, start[rows])
        first += len(batch)
    return PacketBatch(
        buffer,
        start,
        size,
        np.concatenate([batch.stream for batch in batches]),
        np.concatenate([batch.host_ns for batch in batches]),
    )


def _copy_payloads(batch: PacketBatch, buffer: U8Array, at: I64Array) -> None:
    """Copy payloads to `buffer` at `at`, all payloads of one size at once."""
    for size in np.unique(batch.size).tolist():
        if size:
            rows = (batch.size == size).nonzero()[0]
            payloads = sliding_window_view(batch.data, size)[batch.start[rows]]
            sliding_window_view(buffer, size, writeable=True)[at[rows]] = payloads


@dataclass(slots=True)
class Reorder:
    """Moves packets behind the next packet of their group, to its receive time.

    At most one packet of each group waits for its next one, with the fault that chose it.
    """

    _waiting: dict[int, tuple[int, Traffic]] = field(default_factory=dict)

    def apply(self, traffic: Traffic, chosen: I64Array) -> tuple[list[Traffic], I64Array]:
        """The traffic afterwards, and the faults of the packets that were moved.

        chosen: (n,) index of the fault that moves a packet, or -1.
        """
        released = []
        stays = np.ones(len(traffic), bool)
        faults = [chosen[:0]]
        traffic = replace(
            traffic,
            batch=replace(traffic.batch, host_ns=traffic.batch.host_ns.copy()),
            key_ns=traffic.key_ns.copy(),
            order=traffic.order.copy(),
        )
        groups = {*self._waiting, *np.unique(traffic.group[chosen >= 0]).tolist()}
        for group in sorted(groups):
            rows = (traffic.group == group).nonzero()[0]
            if not len(rows):
                continue
            fault = chosen[rows]
            if group in self._waiting:
                number, before = self._waiting.pop(group)
                _move_behind(before, np.zeros(1, np.int64), traffic, rows[:1])
                released.append(before)
                faults.append(np.array([number]))
                fault[0] = -1
            moved = _every_second(fault >= 0).nonzero()[0]
            if len(moved) and moved[-1] == len(rows) - 1:
                last = rows[-1:]
                moved = moved[:-1]
                self._waiting[group] = int(fault[-1]), traffic.take(last).copied()
                stays[last] = False
            faults.append(fault[moved])
            _move_behind(traffic, rows[moved], traffic, rows[moved + 1])
        return [*released, traffic.where(stays)], np.concatenate(faults)

    def finish(self, key_ns: int, order: int) -> list[Traffic]:
        """Packets without a next one; they are output last, at `key_ns`, from `order` on."""
        rest = [traffic for _, traffic in self._waiting.values()]
        self._waiting = {}
        for traffic in rest:
            traffic.key_ns[:] = key_ns
            traffic.batch.host_ns[:] = key_ns
            traffic.order += order
        return rest


def _every_second(chosen: BoolArray) -> BoolArray:
    """The first, third, ... of each run of chosen packets; the others are those that overtake."""
    index = np.arange(len(chosen))
    last_other = np.maximum.accumulate(np.where(chosen, -1, index))
    moved: BoolArray = chosen & ((index - last_other) % 2 == 1)
    return moved


def _move_behind(traffic: Traffic, rows: I64Array, other: Traffic, other_rows: I64Array) -> None:
    """Give packets the receive times of other packets, and places right behind those."""
    traffic.batch.host_ns[rows] = other.batch.host_ns[other_rows]
    traffic.key_ns[rows] = other.key_ns[other_rows]
    traffic.order[rows] = other.order[other_rows] + 1


class PacketQueue:
    """Delays packets until their new receive time, and merges them with the others."""

    def __init__(self) -> None:
        self._held: list[Traffic] = []
        # Buffer of merged payloads, reused.
        self._buffer: U8Array = np.zeros(0, np.uint8)

    def push(self, parts: Sequence[Traffic], until_ns: int | None) -> Traffic:
        """Add traffic (at least one part); return in order all packets due by `until_ns`.

        None: all packets. Later traffic must not be due before `until_ns`.
        """
        ready = []
        later = []
        for traffic in self._held:
            stop = len(traffic)
            if until_ns is not None:
                stop = int(np.searchsorted(traffic.key_ns, until_ns, side="right"))
            ready.append(traffic.take(slice(0, stop)))
            later.append(traffic.take(slice(stop, None)))
        for traffic in parts:
            due = np.ones(len(traffic), bool) if until_ns is None else traffic.key_ns <= until_ns
            ready.append(traffic.where(due))
            if not due.all():
                later.append(traffic.where(~due).in_order().copied())
        self._held = [traffic for traffic in later if len(traffic)]
        return self._merged([traffic for traffic in ready if len(traffic)] or ready[:1])

    def _merged(self, ready: Sequence[Traffic]) -> Traffic:
        if len(ready) == 1:
            return ready[0].in_order()
        batch = concatenated([traffic.batch for traffic in ready], self._buffer)
        self._buffer = batch.data
        return Traffic(
            batch,
            np.concatenate([traffic.sensor for traffic in ready]),
            np.concatenate([traffic.group for traffic in ready]),
            np.concatenate([traffic.number for traffic in ready]),
            np.concatenate([traffic.key_ns for traffic in ready]),
            np.concatenate([traffic.order for traffic in ready]),
        ).in_order()
