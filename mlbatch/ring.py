"""Raw packets of one sensor, kept until the window that holds their last column closes."""

from __future__ import annotations

import numpy as np

from mlbatch.types import I64Array, U8Array

_FIRST_PACKETS = 64


class RawRing:
    """Whole packets in a reused buffer; their columns lie in rows of equal length.

    A packet takes a whole number of records, so record c of the packet in slot p begins at byte
    `(p * records_per_slot + c) * record_size + record_start`: gathering columns is one `take` of
    rows, and a packet is copied once. Places count up for ever; the buffer holds the newest.
    """

    def __init__(self, packet_size: int, record_start: int, record_size: int) -> None:
        self._packet_size = packet_size
        self._record_start = record_start
        self._record_size = record_size
        self._records = -(-packet_size // record_size)
        self._next = 0
        self._capacity = 0
        self._bytes = np.empty(0, np.uint8)
        self._allocate(_FIRST_PACKETS)

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._bytes.nbytes

    def store(
        self, data: U8Array, start: I64Array, oldest_place: int | None
    ) -> tuple[U8Array, I64Array]:
        """Copy packets in; give a view of them, (P, packet_size), and the places of their records.

        data, start: as in a PacketBatch; oldest_place: first place that is still needed.
        The view and the rows are valid until the next call.
        """
        count = len(start)
        oldest = self._next if oldest_place is None else oldest_place // self._records
        slot = self._reserve(count, oldest)
        stride, size = self._records * self._record_size, self._packet_size
        at = (slot % self._capacity) * stride
        target, source = self._bytes.data, data.data
        for begin in start.tolist():
            target[at : at + size] = source[begin : begin + size]
            at += stride
        first = (slot % self._capacity) * stride
        packets = self._bytes[first : first + count * stride].reshape(count, stride)[:, :size]
        self._next = slot + count
        return packets, np.arange(slot, slot + count) * self._records

    def gather(self, place: I64Array, out: U8Array) -> None:
        """Copy the records at `place` (n,) to the rows of `out` (n, record_size)."""
        self._rows.take(place % len(self._rows), axis=0, out=out, mode="clip")

    def _allocate(self, packets: int) -> None:
        self._capacity = packets
        rows = packets * self._records
        # One record more than the slots need, since rows begin `record_start` bytes later.
        spare = self._record_size + self._record_start
        self._bytes = np.zeros(rows * self._record_size + spare, np.uint8)
        begin = self._record_start
        self._rows = self._bytes[begin : begin + rows * self._record_size].reshape(rows, -1)

    def _reserve(self, count: int, oldest: int) -> int:
        """First of `count` slots in one piece; what is older than slot `oldest` may go."""
        while True:
            slot, room = self._next, self._capacity - self._next % self._capacity
            if count > room:
                slot += room
            if slot + count - min(oldest, slot) <= self._capacity:
                return slot
            self._grow(oldest, count)

    def _grow(self, oldest: int, count: int) -> None:
        old, capacity = self._bytes, self._capacity
        live = np.arange(oldest, self._next)
        self._allocate(max(2 * capacity, 1 << int(np.ceil(np.log2(2 * count + 1)))))
        stride = self._records * self._record_size
        before = old[: capacity * stride].reshape(capacity, stride)
        after = self._bytes[: self._capacity * stride].reshape(self._capacity, stride)
        after[live % self._capacity] = before[live % capacity]
