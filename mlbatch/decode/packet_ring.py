"""Raw packets of one sensor, kept until all windows with their columns are decoded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array, U64Array
from mlbatch.lidar.interface import Records

_FIRST_PACKETS = 64
_WORD = 8  # bytes


class KeptPackets(NamedTuple):
    """Packets of a ring: `data[start[i] :][:packet_size]`, until the next are kept."""

    data: U8Array
    start: I64Array  # (P,)
    ring_index: I64Array  # (P,) of the first column


class PacketRing:
    """Ring buffer of whole packets, read column by column.

    A packet takes a whole number of rows of `Records.stride` bytes: row r of the packet in slot p
    begins at byte `(p * rows + r) * stride + start`. A packet is copied once. Every column has a
    ring index, an int64 that counts up and is never reused; the buffer contains the newest. One
    thread may `store` while others read a `view` at ring indexes that are still needed.
    """

    def __init__(self, packet_size: int, records: Records) -> None:
        self._packet_size = packet_size
        self._records = records
        self._rows_per_packet = -(-packet_size // records.stride)
        self._places = self._rows_per_packet * records.per_row
        self._next = 0
        self._capacity = 0
        # Of all packets, and up to the packet in each slot; only where they are asked for.
        self._has_sums = False
        self._sum = np.uint64(0)
        self._sums: U64Array = np.zeros(_FIRST_PACKETS, np.uint64)
        self._use(self._allocate(_FIRST_PACKETS), _FIRST_PACKETS)

    def column_offsets(self, columns: int) -> I64Array:
        """Return the ring indexes of the columns of a packet, relative to the first: (columns,)."""
        return np.arange(columns)

    @property
    def view(self) -> tuple[npt.NDArray[np.void], int]:
        """All columns, (rows, columns of a row), one element of `records.size` bytes each; origin.

        The column at `ring_index` has the flat index `ring_index - origin` modulo the size. `store`
        may replace the view by a larger one at any time: take it once, then use that.
        """
        return self._pieces, 0

    @property
    def nbytes(self) -> int:
        """Size of the buffer in bytes."""
        return self._bytes.nbytes

    def store(
        self,
        data: U8Array,
        start: I64Array,
        oldest_ring_index: int | None,
        place: int | None = None,
    ) -> tuple[U8Array, I64Array]:
        """Copy packets in; return a view (P, packet_size) and each packet's first ring index (P,).

        data, start, place: as in `PacketBatch`; oldest_ring_index: first ring index that is still
        needed, None if none is. The view is valid until the next call.
        """
        kept = self.keep(data, start, oldest_ring_index, place)
        return self.packets(kept), kept.ring_index

    def keep(
        self,
        data: U8Array,
        start: I64Array,
        oldest_ring_index: int | None,
        place: int | None = None,
    ) -> KeptPackets:
        """Copy packets in, as `store`; return where they are."""
        count = len(start)
        oldest = self._next if oldest_ring_index is None else oldest_ring_index // self._places
        slot = self._reserve(count, oldest)
        stride = self._rows_per_packet * self._records.stride
        size = self._packet_size
        first = (slot % self._capacity) * stride
        packets = self._bytes[first : first + count * stride].reshape(count, stride)[:, :size]
        if not _copy_evenly(data, start, packets):
            target = self._bytes.data
            source = data.data
            at = first
            for begin in start.tolist():
                target[at : at + size] = source[begin : begin + size]
                at += stride
        if count and self._has_sums:
            sums = self._sums[slot % self._capacity :][:count]
            np.cumsum(packet_sums(packets), out=sums)
            sums += self._sum
            self._sum = sums[-1]
        self._next = slot + count
        starts = first + np.arange(count) * stride
        return KeptPackets(self._bytes, starts, np.arange(slot, slot + count) * self._places)

    def packets(self, kept: KeptPackets) -> U8Array:
        """Return a view (P, packet_size) of packets that were kept last."""
        stride = self._rows_per_packet * self._records.stride
        count = len(kept.start)
        first = int(kept.start[0]) if count else 0
        rows = kept.data[first : first + count * stride].reshape(count, stride)
        return rows[:, : self._packet_size]

    def keep_sums(self) -> None:
        """Sum packets from now on, for `sum_until`."""
        self._has_sums = True

    def sum_until(self, ring_index: int) -> int:
        """Return the sum of all packets since `keep_sums`, up to that of a column still needed.

        See `packet_sums`. Only for the thread that stores packets.
        """
        return int(self._sums[ring_index // self._places % self._capacity])

    def _allocate(self, packets: int) -> U8Array:
        """Return a buffer for so many packets, all zero."""
        rows = packets * self._rows_per_packet
        records = self._records
        # Spare bytes: rows begin at `start`, and columns may be longer than rows.
        spare = records.start + records.size + records.per_row * records.step
        return np.zeros(rows * records.stride + spare, np.uint8)

    def _use(self, data: U8Array, packets: int) -> None:
        """Switch to the buffer `data` for so many packets."""
        self._bytes = data
        self._capacity = packets
        records = self._records
        rows = packets * self._rows_per_packet
        # Elements of a void type may overlap and are still copied as a whole.
        self._pieces: npt.NDArray[np.void] = np.ndarray(
            (rows, records.per_row),
            np.dtype((np.void, records.size)),
            buffer=self._bytes.data,
            offset=records.start,
            strides=(records.stride, records.step),
        )

    def _reserve(self, count: int, oldest: int) -> int:
        """Return the first of `count` contiguous slots; slots before `oldest` may be reused."""
        while True:
            slot = self._next
            room = self._capacity - slot % self._capacity
            if count > room:
                slot += room
            if slot + count - min(oldest, slot) <= self._capacity:
                return slot
            self._grow(oldest, count)

    def _grow(self, oldest: int, count: int) -> None:
        old = self._bytes
        capacity = self._capacity
        live = np.arange(oldest, self._next)
        larger = max(2 * capacity, 1 << int(np.ceil(np.log2(2 * count + 1))))
        new = self._allocate(larger)
        stride = self._rows_per_packet * self._records.stride
        before = old[: capacity * stride].reshape(capacity, stride)
        after = new[: larger * stride].reshape(larger, stride)
        after[live % larger] = before[live % capacity]
        sums = np.zeros(larger, np.uint64)
        sums[live % larger] = self._sums[live % capacity]
        self._sums = sums
        # Last, since other threads read columns meanwhile.
        self._use(new, larger)


def packet_sums(packets: U8Array) -> U64Array:
    """Return the checksums of packets (n, size): sums of their 64-bit words, modulo 2^64.

    They cost a hundredth of what CRC-32 of zlib costs. Every change of a single byte changes the
    sum; words that change places do not.
    """
    size = packets.shape[1]
    words = packets if size < _WORD else packets[:, : size // _WORD * _WORD].view(np.uint64)
    sums: U64Array = words.sum(axis=1, dtype=np.uint64)
    if size > _WORD and size % _WORD:
        # The last word overlaps the one before.
        sums += packets[:, size - _WORD :].view(np.uint64)[:, 0]
    return sums


def _copy_evenly(data: U8Array, start: I64Array, packets: U8Array) -> bool:
    """Copy evenly spaced payloads, as captures of a single lidar have, to `packets` (n, size).

    Return whether they are; else nothing is copied.
    """
    step = int(start[1] - start[0]) if len(start) > 1 else 0
    if step <= 0 or not bool((start[1:] - start[:-1] == step).all()):
        return False
    packets[:] = np.ndarray(packets.shape, np.uint8, data.data, int(start[0]), (step, 1))
    return True
