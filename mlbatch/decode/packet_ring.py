"""Raw packets of one sensor, kept until the window that holds their last column closes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array
from mlbatch.lidar.interface import Records

_FIRST_PACKETS = 64


class PacketRing:
    """Whole packets in a reused buffer; their columns lie in rows of equal length.

    A packet takes a whole number of rows, so row r of the packet in slot p begins at byte
    `(p * rows + r) * stride + start`: gathering columns is one `take` of rows (or of pieces of
    them), and a packet is copied once. Places number columns and count up for ever; the buffer
    holds the newest. One thread may `store` while others `gather` places that are still needed.
    """

    def __init__(self, packet_size: int, records: Records) -> None:
        self._packet_size = packet_size
        self._records = records
        self._rows_per_packet = -(-packet_size // records.stride)
        self._places = self._rows_per_packet * records.per_row
        self._is_plain = records.per_row == 1 and records.size == records.stride
        self._next = 0
        self._capacity = 0
        self._use(self._allocate(_FIRST_PACKETS), _FIRST_PACKETS)

    @property
    def pieces(self) -> npt.NDArray[np.void]:
        """Columns where they lie, (rows, columns of a row); that at `place` is number `place`.

        Counted row by row, and modulo their number. Another thread may put a larger one in place.
        """
        pieces: npt.NDArray[np.void] = self._pieces
        return pieces

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._bytes.nbytes

    def store(
        self, data: U8Array, start: I64Array, oldest_place: int | None
    ) -> tuple[U8Array, I64Array]:
        """Copy packets in; give a view of them, (P, packet_size), and the places of their columns.

        data, start: as in a PacketBatch; oldest_place: first place that is still needed.
        The view and the columns are valid until the next call.
        """
        count = len(start)
        oldest = self._next if oldest_place is None else oldest_place // self._places
        slot = self._reserve(count, oldest)
        stride, size = self._rows_per_packet * self._records.stride, self._packet_size
        first = (slot % self._capacity) * stride
        packets = self._bytes[first : first + count * stride].reshape(count, stride)[:, :size]
        if not _copy_evenly(data, start, packets):
            target, source, at = self._bytes.data, data.data, first
            for begin in start.tolist():
                target[at : at + size] = source[begin : begin + size]
                at += stride
        self._next = slot + count
        return packets, np.arange(slot, slot + count) * self._places

    def gather(self, place: I64Array, out: U8Array) -> None:
        """Copy the columns at `place` (n,) to the rows of `out` (n, records.size)."""
        # Looked up once, since another thread may put larger ones in their place.
        if self._is_plain:
            rows = self._rows
            rows.take(place % len(rows), axis=0, out=out, mode="clip")
            return
        count, windows = self._windows
        # A quotient of numbers by one other is much faster than a remainder.
        per_row = self._records.per_row
        row = place // per_row
        at = (place - row * per_row) * self._records.step
        row -= row // count * count
        at += row * self._records.stride
        out.view(windows.dtype)[:, 0] = windows[at]

    def _allocate(self, packets: int) -> U8Array:
        """Room for so many packets, all zero."""
        rows, records = packets * self._rows_per_packet, self._records
        # More than the slots need, since rows begin later and columns may be longer than rows.
        spare = records.start + records.size + records.per_row * records.step
        return np.zeros(rows * records.stride + spare, np.uint8)

    def _use(self, data: U8Array, packets: int) -> None:
        """Look for packets in `data` from now on."""
        self._bytes, self._capacity = data, packets
        rows, records = packets * self._rows_per_packet, self._records
        begin, end = records.start, records.start + rows * records.stride
        self._rows = self._bytes[begin:end].reshape(rows, -1)
        # As bytes of one element each, pieces may overlap and still move in one go.
        self._pieces: npt.NDArray[np.void] = np.ndarray(
            (rows, records.per_row),
            np.dtype((np.void, records.size)),
            buffer=self._bytes.data,
            offset=begin,
            strides=(records.stride, records.step),
        )
        # All that begins at any byte of so many rows: one index instead of two.
        windows: npt.NDArray[np.void] = np.ndarray(
            ((rows - 1) * records.stride + (records.per_row - 1) * records.step + 1,),
            self._pieces.dtype,
            buffer=self._bytes.data,
            offset=begin,
            strides=(1,),
        )
        self._windows = rows, windows

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
        larger = max(2 * capacity, 1 << int(np.ceil(np.log2(2 * count + 1))))
        new = self._allocate(larger)
        stride = self._rows_per_packet * self._records.stride
        before = old[: capacity * stride].reshape(capacity, stride)
        after = new[: larger * stride].reshape(larger, stride)
        after[live % larger] = before[live % capacity]
        # Only now, since other threads gather columns all the time.
        self._use(new, larger)


def _copy_evenly(data: U8Array, start: I64Array, packets: U8Array) -> bool:
    """Copy payloads to the rows of `packets` (n, size) at once, if they are evenly spaced.

    As in the capture of a single lidar; else nothing is done.
    """
    step = int(start[1] - start[0]) if len(start) > 1 else 0
    if step <= 0 or not bool((start[1:] - start[:-1] == step).all()):
        return False
    packets[:] = np.ndarray(packets.shape, np.uint8, data.data, int(start[0]), (step, 1))
    return True
