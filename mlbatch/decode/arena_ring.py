"""Packets of one sensor that stay where they were read: the same interface as `PacketRing`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array, U64Array
from mlbatch.decode.packet_ring import KeptPackets
from mlbatch.lidar.interface import Records
from mlbatch.native.arena import PacketArena
from mlbatch.native.capture import CaptureLoops


class ArenaRing:
    """Packets of one sensor in the arena of the run; a ring index is the place of a column there.

    Only the bytes of headers are gathered, for the lidar to read. A packet that was not read into
    the arena is copied to it.
    """

    def __init__(
        self, packet_size: int, records: Records, header_bytes: I64Array, arena: PacketArena
    ) -> None:
        """header_bytes: (k, 2), as `Lidar.header_bytes`."""
        self._size = packet_size
        self._header_bytes = header_bytes
        self._arena = arena
        self._records = records
        self._headers: U8Array = np.zeros((0, packet_size), np.uint8)
        self._loops = CaptureLoops()
        self._view = self._viewed()
        # Of the last call.
        self._offsets: I64Array = np.zeros(0, np.int64)
        # Of all packets, and up to each one that is still needed, by place; where asked for.
        self._has_sums = False
        self._sum = np.uint64(0)
        self._places: I64Array = np.zeros(0, np.int64)
        self._sums: U64Array = np.zeros(0, np.uint64)

    @property
    def nbytes(self) -> int:
        """Size of the arena in bytes."""
        return self._arena.data.nbytes

    def column_offsets(self, columns: int) -> I64Array:
        """See `PacketRing`."""
        if columns != len(self._offsets):
            row, place = np.divmod(np.arange(columns), self._records.per_row)
            self._offsets = np.asarray(row * self._records.stride + place * self._records.step)
            self._offsets.flags.writeable = False
        return self._offsets

    @property
    def view(self) -> tuple[npt.NDArray[np.void], int]:
        """See `PacketRing`."""
        if self._view[2] is not self._arena.data:
            self._view = self._viewed()
        return self._view[:2]

    def store(
        self,
        data: U8Array,
        start: I64Array,
        oldest_ring_index: int | None,
        place: int | None = None,
    ) -> tuple[U8Array, I64Array]:
        """See `PacketRing`; of the view only the bytes of headers are those of the packets."""
        kept = self.keep(data, start, oldest_ring_index, place)
        return self.packets(kept), kept.ring_index

    def keep(
        self,
        data: U8Array,
        start: I64Array,
        oldest_ring_index: int | None,
        place: int | None = None,
    ) -> KeptPackets:
        """See `PacketRing`; packets stay where they are."""
        if place is None:
            data, place, start = self._copied(data, start)
        kept = KeptPackets(data, start, start + (place + self._records.start))
        if self._has_sums and len(start):
            self._add_sums(kept, oldest_ring_index)
        return kept

    def packets(self, kept: KeptPackets) -> U8Array:
        """See `PacketRing`; only the bytes of headers are those of the packets."""
        count = len(kept.start)
        if count > len(self._headers):
            self._headers = np.zeros((2 * count, self._size), np.uint8)
        headers = self._headers[:count]
        self._loops.gather(kept.data, kept.start, self._header_bytes, headers)
        return headers

    def keep_sums(self) -> None:
        """See `PacketRing`."""
        self._has_sums = True

    def sum_until(self, ring_index: int) -> int:
        """See `PacketRing`."""
        return int(self._sums[np.searchsorted(self._places, ring_index, side="right") - 1])

    def _copied(self, data: U8Array, start: I64Array) -> tuple[U8Array, int, I64Array]:
        """Copy packets to the arena; return the region, its place, and where they begin there."""
        region, place = self._arena.reserve(len(start) * self._size)
        target = np.arange(len(start)) * self._size
        self._loops.copy_runs(data, start, np.full(len(start), self._size), region, target)
        return region, place, target

    def _add_sums(self, kept: KeptPackets, oldest: int | None) -> None:
        places = kept.ring_index
        each = self._loops.sums(kept.data, kept.start, self._size)
        sums = np.cumsum(each, dtype=np.uint64) + self._sum
        self._sum = sums[-1]
        is_needed = self._places >= (places.min() if oldest is None else oldest - self._size)
        known = np.concatenate([self._places[is_needed], places])
        order = known.argsort()
        self._places = known[order]
        self._sums = np.concatenate([self._sums[is_needed], sums])[order]

    def _viewed(self) -> tuple[npt.NDArray[np.void], int, U8Array]:
        """A record at each place, its origin, and the array of the arena."""
        data = self._arena.data
        pieces: npt.NDArray[np.void] = np.ndarray(
            (self._arena.capacity, 1),
            np.dtype((np.void, self._records.size)),
            buffer=data.data,
            strides=(1, 1),
        )
        return pieces, self._arena.origin, data
