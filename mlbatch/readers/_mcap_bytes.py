"""The bytes of an MCAP file: a reused window that moves forward, and chunks that are unpacked.

What is of no interest is stepped over, where the file is not compressed as a whole. Memory follows
what a file holds, not what it claims: the window grows by doubling, as bytes really arrive.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.readers._bytes import SLACK
from mlbatch.readers._source import Source

BUFFER_BYTES = 4 << 20
# No recorder makes larger chunks or messages: rosbag2 has 0.75 to 4 MB, others less than 100 MB.
MAX_RECORD_BYTES = 1 << 28
_PIECE_BYTES = 1 << 18
# Most chunks are smaller, and are had at once.
_FIRST_BYTES = 16 << 20


class SkippingSource(Source):
    """A source whose bytes can be left out, and looked at out of turn, if the file is plain."""

    def __enter__(self) -> SkippingSource:
        return self

    @property
    def is_plain(self) -> bool:
        """Whether the bytes are those of the file on disk."""
        return self._stream is self._file

    def skip(self, count: int) -> int:
        """Leave out the next `count` bytes, or as many as there are; return how many."""
        if self.is_plain:
            count = max(0, min(count, self.size_bytes - self._file.tell()))
            self._file.seek(count, os.SEEK_CUR)
            return count
        waste = memoryview(bytearray(_PIECE_BYTES))
        left = count
        while left and (got := self.fill(waste[:left])):
            left -= got
        return count - left

    def look_at(self, place: int, count: int) -> bytes:
        """Bytes anywhere in a plain file; fewer or none where it ends or cannot be read."""
        if not self.is_plain or place < 0 or place >= self.size_bytes:
            return b""
        try:
            return os.pread(self._file.fileno(), min(count, self.size_bytes - place), place)
        except OSError:
            return b""


class Window:
    """Bytes `begin` to `end` of `data` are those of the file from `place` on.

    `begin` may be moved behind `end`: what lies between is then left out by `refill`.
    """

    def __init__(self, source: SkippingSource, size: int = BUFFER_BYTES) -> None:
        self.data: U8Array = np.zeros(size + SLACK, np.uint8)
        self.begin = self.end = 0
        self._source = source
        self._origin = 0

    @property
    def place(self) -> int:
        """Where in the (decompressed) file byte `begin` lies."""
        return self._origin + self.begin

    def place_of(self, at: int) -> int:
        """Where in the file byte `at` of `data` lies."""
        return self._origin + at

    def refill(self) -> bool:
        """Keep the unread bytes in front, read more behind them; False at the file's end."""
        if self.begin > self.end:
            left = self.begin - self.end
            got = self._source.skip(left)
            self._origin += self.end + got
            self.begin, self.end = left - got, 0
            if self.begin:
                return False
        kept = self.end - self.begin
        self._origin += self.begin
        if kept + SLACK >= len(self.data):
            # A new array, since packets of the old one may still be in use.
            self.data = np.append(self.data[self.begin : self.end], np.zeros(kept, np.uint8))
        else:
            self.data[:kept] = self.data[self.begin : self.end]
        self.begin, self.end = 0, kept
        count = self._source.fill(self.data.data[kept : len(self.data) - SLACK])
        self.end += count
        return count > 0


def in_pieces(
    unpack: Callable[[bytes | memoryview, int], bytes], stored: memoryview, size: int
) -> U8Array:
    """Up to `size` bytes that a decompressor makes of `stored`; none where they are corrupt.

    unpack: as `BZ2Decompressor.decompress`, which keeps the input that it did not come to. Piece by
    piece, since large results are held twice while they grow.
    """
    try:
        first = unpack(stored, min(size, _FIRST_BYTES))
        if len(first) < _FIRST_BYTES or size == len(first):
            return np.frombuffer(first, np.uint8)
        data = np.zeros(size, np.uint8)
        done, piece = 0, first
        while piece:
            data[done : done + len(piece)] = np.frombuffer(piece, np.uint8)
            done += len(piece)
            piece = unpack(b"", min(size - done, _PIECE_BYTES)) if done < size else b""
    except EOFError:
        return data[:done]
    except (RuntimeError, ValueError, OSError):
        return np.zeros(0, np.uint8)
    return data[:done]


class Unzipper:
    """Decompresses chunks into one reused buffer."""

    def __init__(self) -> None:
        self._data: U8Array = np.zeros(BUFFER_BYTES, np.uint8)

    def unpack(self, compression: str, stored: memoryview, size: int) -> U8Array:
        """Up to `size` bytes of a chunk; fewer where it is cut off or corrupt."""
        if compression == "lz4":
            return self._unlz4(stored, size)
        return self._unzstd(stored, size)

    def _unlz4(self, stored: memoryview, size: int) -> U8Array:
        # The package tells no types, so that a plain import would not pass the type checker.
        frame = importlib.import_module("lz4.frame")
        return in_pieces(frame.LZ4FrameDecompressor().decompress, stored, size)

    def _unzstd(self, stored: memoryview, size: int) -> U8Array:
        import zstandard

        if len(self._data) < size:
            # Untouched pages cost nothing, should the chunk hold less than it claims.
            self._data = np.zeros(size, np.uint8)
        done, target = 0, self._data.data
        with zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True) as reader:
            try:
                while done < size and (count := reader.readinto(target[done:size])):
                    done += count
            except zstandard.ZstdError:
                # What came out before the fault is whole.
                return self._data[:done]
        return self._data[:done]
