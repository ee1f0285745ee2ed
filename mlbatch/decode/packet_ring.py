"""Raw packets of one sensor, kept where they were read until their windows are decoded."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array, U64Array
from mlbatch.lidar.interface import Records
from mlbatch.native.arena import PacketArena
from mlbatch.native.capture import CaptureLoops


class KeptPackets(NamedTuple):
    """Packets of a ring: `data[start[i] :][:packet_size]`, until the next are kept."""

    data: U8Array
    start: I64Array  # (P,)
    ring_index: I64Array  # (P,) of the first column


class PacketRing:
    """Packets of one sensor in an arena; a ring index is the place of a column there.

    A packet that was not read into the arena is copied to it. One thread may `keep` while others
    read a `view` at ring indexes that are still needed.
    """

    def __init__(self, packet_size: int, records: Records, arena: PacketArena) -> None:
        self._size = packet_size
        self._arena = arena
        self._records = records
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
        """Return the ring indexes of the columns of a packet, relative to the first: (columns,)."""
        if columns != len(self._offsets):
            row, position = np.divmod(np.arange(columns), self._records.per_row)
            self._offsets = np.asarray(row * self._records.stride + position * self._records.step)
            self._offsets.flags.writeable = False
        return self._offsets

    @property
    def view(self) -> tuple[npt.NDArray[np.void], int]:
        """A record at each place, (places, 1), one element of `records.size` bytes each; origin.

        The column at `ring_index` has the flat index `ring_index - origin` modulo the size. `keep`
        may replace the view by a larger one at any time: take it once, then use that.
        """
        if self._view[2] is not self._arena.data:
            self._view = self._viewed()
        return self._view[:2]

    def keep(self, data: U8Array, start: I64Array, place: int | None = None) -> KeptPackets:
        """Keep packets until the arena frees them; data, start, place: as in `PacketBatch`."""
        if place is None:
            data, place, start = self._copied(data, start)
        kept = KeptPackets(data, start, start + (place + self._records.start))
        if self._has_sums and len(start):
            self._add_sums(kept)
        return kept

    def keep_sums(self) -> None:
        """Sum packets from now on, for `sum_until`."""
        self._has_sums = True

    def sum_until(self, ring_index: int) -> int:
        """Return the sum of all packets since `keep_sums`, up to that of a column still needed.

        See `CaptureLoops.sums`. Only for the thread that keeps packets.
        """
        return int(self._sums[np.searchsorted(self._places, ring_index, side="right") - 1])

    def _copied(self, data: U8Array, start: I64Array) -> tuple[U8Array, int, I64Array]:
        """Copy packets to the arena; return the region, its place, and where they begin there."""
        region, place = self._arena.reserve(len(start) * self._size)
        target = np.arange(len(start)) * self._size
        self._loops.copy_runs(data, start, np.full(len(start), self._size), region, target)
        return region, place, target

    def _add_sums(self, kept: KeptPackets) -> None:
        places = kept.ring_index
        each = self._loops.sums(kept.data, kept.start, self._size)
        sums = np.cumsum(each, dtype=np.uint64) + self._sum
        self._sum = sums[-1]
        is_needed = self._places >= self._arena.oldest - self._size
        indexes = np.concatenate([self._places[is_needed], places])
        order = indexes.argsort()
        self._places = indexes[order]
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
