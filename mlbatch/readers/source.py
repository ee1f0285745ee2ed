"""Bytes of a recording, plain or compressed, read in order into a caller's buffer.

Magic numbers: RFC 1952 (gzip, 1F 8B) and RFC 8878 (zstd, 28 B5 2F FD). The content decides, never
the file's name. Memory does not depend on how far the data expands.
"""

from __future__ import annotations

import importlib
import os
import stat
import zlib
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np

from mlbatch.errors import RecordingError
from mlbatch.readers.byte_records import SLACK
from mlbatch.types import U8Array

_GZIP, _ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
_GZIP_WINDOW = 31  # zlib's word for "gzip header, largest window"
_PIECE_BYTES = 1 << 18
HEAD_BYTES = 64


class _Stream(Protocol):
    """What `Source` reads from; an error leaves the bytes of earlier calls valid."""

    def readinto(self, target: memoryview) -> int | None: ...


class _Inflate:
    """A gzip file, also of several members, as a stream."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._inflate = zlib.decompressobj(_GZIP_WINDOW)
        self._input = b""

    def readinto(self, target: memoryview) -> int:
        """Fill `target` as far as one piece of input goes; 0 at the end."""
        while True:
            if self._inflate.eof:
                self._input = self._input or self._file.read(_PIECE_BYTES)
                if not self._input.startswith(_GZIP):  # The end, or padding after it.
                    return 0
                self._inflate = zlib.decompressobj(_GZIP_WINDOW)
            piece = self._input or self._file.read(_PIECE_BYTES)
            output = self._inflate.decompress(piece, len(target))
            self._input = self._inflate.unconsumed_tail or self._inflate.unused_data
            if output:
                target[: len(output)] = output
                return len(output)
            if not piece and not self._inflate.eof:
                raise EOFError("they end early")


class Source:
    """An open recording; use as a context manager.

    size_bytes: of the file on disk; fault: why reading stopped early, "" while all is well.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fault = ""
        self._file = _opened(path)
        try:
            self.size_bytes = path.stat().st_size
            magic = self._file.read(len(_ZSTD))
            self._file.seek(0)
            self._stream = _stream(self._file, magic)
        except OSError as err:
            self._file.close()
            raise RecordingError(_unreadable(path, err)) from err

    def __enter__(self) -> Source:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    @property
    def position_bytes(self) -> int:
        """Bytes of the file on disk that have been read."""
        return self._file.tell()

    def fill(self, target: memoryview) -> int:
        """Read until `target` is full or the data end; return the number of bytes."""
        done = 0
        while done < len(target) and not self.fault:
            try:
                count = self._stream.readinto(target[done:])
            except OSError as err:
                raise RecordingError(_unreadable(self.path, err)) from err
            except (EOFError, zlib.error, _zstd_error()) as err:
                self.fault = f"corrupt or cut-off compressed data ({err})"
                break
            if not count:
                break
            done += count
        return done


def read_head(path: Path) -> bytes:
    """The first bytes of a recording, decompressed; an error where there is none."""
    head = bytearray(HEAD_BYTES)
    with Source(path) as source:
        count = source.fill(memoryview(head))
        if source.fault and not count:
            raise RecordingError(f"{path}: {source.fault}; nothing can be read, copy it again")
        if not count:
            raise RecordingError(
                f"{path}: wanted a recording, got 0 bytes; record or copy it again"
            )
    return bytes(head[:count])


def _opened(path: Path) -> FileIO:
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise RecordingError(
                f"{path}: wanted a recording, got a folder; name the files inside it"
            )
        if not stat.S_ISREG(mode):
            raise RecordingError(
                f"{path}: wanted a regular file, since it is read more than once; save it first"
            )
        return path.open("rb", buffering=0)
    except OSError as err:
        raise RecordingError(_unreadable(path, err)) from err


def _unreadable(path: Path, err: OSError) -> str:
    if isinstance(err, FileNotFoundError):
        return f"{path}: wanted a recording, got no such file; check the path"
    if isinstance(err, PermissionError):
        return f"{path}: wanted a recording, got no permission to read it; check its access rights"
    return f"{path}: wanted a recording, could not read it ({err.strerror}); check the disk"


def _stream(file: FileIO, magic: bytes) -> _Stream:
    if magic.startswith(_GZIP):
        return _Inflate(file)
    if magic == _ZSTD:
        import zstandard

        reader: _Stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        return reader
    return file


def _zstd_error() -> type[Exception]:
    import zstandard

    return zstandard.ZstdError


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
