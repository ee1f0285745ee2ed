"""Memory for packets from reading to decoding, so that they are not copied in between."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import U8Array

# Behind the last byte, so that a view of records may begin at each byte.
_SPARE = 1 << 16


class PacketArena:
    """A ring of bytes in which every byte has a place: a number that counts up and is not reused.

    The capture reader reads into it, and compiled decoding reads records where they are. Each
    region is contiguous. A larger array replaces `data` where what is still needed leaves no room;
    the old one stays as it is for those who have it.

    data: `capacity` bytes and spare ones; origin: a place that is byte 0 of `data`;
    read_bytes: to read at a time, 0: as the reader likes; oldest: first place still needed.
    """

    def __init__(self, read_bytes: int = 0) -> None:
        self.read_bytes = read_bytes
        self.data: U8Array = np.zeros(_SPARE, np.uint8)
        self.capacity = 0
        self.origin = 0
        self._next = 0
        self.oldest = 0
        # First place of the region that is being read.
        self._reading: int | None = None

    def keep_from(self, oldest: int | None) -> None:
        """Free all before `oldest`, None: all so far; what is reserved later stays."""
        self.oldest = self._next if oldest is None else oldest

    def reserve(self, count: int) -> tuple[U8Array, int]:
        """Return a region of `count` bytes, with any content, and the place of the first."""
        while True:
            at = self._next
            begin = (at - self.origin) % self.capacity if self.capacity else 0
            if count > self.capacity - begin:
                at += self.capacity - begin
                begin = 0
            oldest = min(self.oldest, at if self._reading is None else self._reading)
            if at + count - oldest <= self.capacity:
                self._next = at + count
                return self.data[begin : begin + count], at
            self._grow(oldest, count)

    def reserve_for_reading(self, count: int) -> tuple[U8Array, int]:
        """Return a region as `reserve`, which also stays until the next call."""
        region, self._reading = self.reserve(count)
        return region, self._reading

    def _grow(self, oldest: int, count: int) -> None:
        """Replace the array by a larger one, in which all from `oldest` on is contiguous."""
        live = max(self._next - oldest, 0)
        capacity = max(2 * self.capacity, live + 2 * count)
        # To be filled before it is read: zeros would be written by the processor, of MB.
        new = np.empty(capacity + _SPARE, np.uint8)
        if live:
            begin = (oldest - self.origin) % self.capacity
            first = min(live, self.capacity - begin)
            new[:first] = self.data[begin : begin + first]
            new[first:live] = self.data[: live - first]
        self.data = new
        self.capacity = capacity
        self.origin = oldest
        self._next = max(self._next, oldest)
