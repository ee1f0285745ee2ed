"""Bytes of a recording: files, plain or compressed, read in order through one sliding window.

Magic numbers: RFC 1952 (gzip, 1F 8B) and RFC 8878 (zstd, 28 B5 2F FD). The content decides, not the
file name. Memory follows the bytes that are there, not the sizes that a file claims.
"""

from __future__ import annotations

import bz2
import gzip
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

from mlbatch.arrays import U8Array
from mlbatch.errors import RecordingError
from mlbatch.native.arena import PacketArena
from mlbatch.readers.byte_records import SLACK

BUFFER_BYTES = 4 << 20
# Chunks and messages are smaller in practice: 0.75 to 4 MB in rosbag2, else less than 100 MB.
MAX_RECORD_BYTES = 1 << 28
HEAD_BYTES = 64
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_GZIP_MAGIC = b"\x1f\x8b"
_PIECE_BYTES = 1 << 18
# Blocks up to this size are decompressed by one call.
_ONE_CALL_BYTES = 16 << 20


class _Stream(Protocol):
    """Interface that `Source` reads from; an error leaves the bytes of earlier calls valid."""

    def readinto(self, target: memoryview) -> int | None: ...


class _Gzip(gzip.GzipFile):
    """A gzip file of one or more members as a stream, piece by piece: a fault costs its own."""

    readinto = gzip.GzipFile.readinto1


class Source:
    """An open recording; a context manager.

    size_bytes: of the file on disk; fault: why reading stopped early, or "".
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fault = ""
        self._file = _opened(path)
        try:
            self.size_bytes = path.stat().st_size
            magic = self._file.read(len(ZSTD_MAGIC))
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
    def is_plain(self) -> bool:
        """Whether the file is not compressed as a whole."""
        return self._stream is self._file

    @property
    def position_bytes(self) -> int:
        """Bytes of the file on disk that have been read or skipped."""
        return self._file.tell()

    def fill(self, target: memoryview) -> int:
        """Read until `target` is full or the data end; return the number of bytes."""
        done = 0
        while done < len(target) and not self.fault:
            try:
                count = self._stream.readinto(target[done:])
            except (EOFError, gzip.BadGzipFile, zlib.error, _zstd_error()) as err:
                self.fault = f"corrupt or cut-off compressed data ({err})"
                break
            except OSError as err:
                raise RecordingError(_unreadable(self.path, err)) from err
            if not count:
                break
            done += count
        return done

    def skip(self, count: int) -> int:
        """Skip the next `count` bytes, or as many as there are; return how many."""
        if self.is_plain:
            count = max(0, min(count, self.size_bytes - self._file.tell()))
            self._file.seek(count, os.SEEK_CUR)
            return count
        waste = memoryview(bytearray(_PIECE_BYTES))
        left = count
        while left and (skipped := self.fill(waste[:left])):
            left -= skipped
        return count - left

    def look_at(self, place: int, count: int) -> bytes:
        """Bytes at any place of a plain file; fewer or none at its end or where it is unreadable.

        The position does not change.
        """
        if not self.is_plain or place < 0 or place >= self.size_bytes:
            return b""
        try:
            return os.pread(self._file.fileno(), min(count, self.size_bytes - place), place)
        except OSError:
            return b""


class Window:
    """A reused buffer that slides over a source.

    `data[begin:end]` are the bytes of the (decompressed) file from offset `place` on. The first
    `front` bytes of `data` are free for other use, and SLACK bytes follow `end`. `begin` may be
    moved behind `end`: `refill` then skips the bytes between.
    """

    def __init__(
        self,
        source: Source,
        size: int = BUFFER_BYTES,
        front: int = 0,
        arena: PacketArena | None = None,
    ) -> None:
        """arena: where each refill gets a new region; None: one buffer is used again."""
        self._arena = arena
        # In the arena, of `data[0]`.
        self.arena_place: int | None = None
        self.data: U8Array = np.zeros(0, np.uint8)
        self._allocate(front + size + SLACK)
        self.begin = front
        self.end = front
        self._front = front
        self._source = source
        self._has_ended = False
        # Place in the file of byte 0 of `data`.
        self._origin = -front

    @property
    def place(self) -> int:
        """Place in the file of byte `begin`."""
        return self._origin + self.begin

    def place_of(self, at: int) -> int:
        """Place in the file of byte `at` of `data`."""
        return self._origin + at

    def refill(self, need: int = 0, most: int = 0) -> bool:
        """Move the unread bytes to the front and read more after them; False at the file's end.

        The buffer grows where the unread bytes fill it, or are to be `need` bytes. most: unread
        bytes after which reading stops; 0: no limit but the buffer.
        """
        front = self._front
        if self.begin > self.end:
            left = self.begin - self.end
            skipped = self._source.skip(left)
            self._origin += self.end + skipped - front
            self.begin = front + left - skipped
            self.end = front
            if skipped < left:
                return False
        if self._has_ended:
            return False
        kept = self.end - self.begin
        unread = self.data[self.begin : self.end]
        self._origin += self.begin - front
        size = len(self.data) - front - SLACK
        if kept >= size or need > size:
            # A new array, since packets of the old one may still be in use.
            self._allocate(front + max(2 * kept, need) + SLACK)
        elif self._arena is not None:
            self._allocate(len(self.data))
        self.data[front : front + kept] = unread
        self.begin = front
        self.end = front + kept
        stop = len(self.data) - SLACK
        if most > kept:
            stop = min(stop, front + most)
        count = self._source.fill(self.data.data[self.end : stop])
        self._has_ended = count < stop - self.end
        self.end += count
        return count > 0

    def _allocate(self, count: int) -> None:
        if self._arena is None:
            self.data = np.empty(count, np.uint8)
        else:
            self.data, self.arena_place = self._arena.reserve_for_reading(count)


class Decompressor:
    """Decompresses single chunks and messages; zstd into a buffer that is reused."""

    def __init__(self) -> None:
        self._data: U8Array = np.zeros(BUFFER_BYTES, np.uint8)

    def decompress(self, compression: str, stored: memoryview, size: int) -> U8Array:
        """Up to `size` bytes, valid until the next call; fewer where `stored` is cut or corrupt.

        compression: `zstd`, `lz4` (frame) or `bz2`; no bytes for others.
        """
        if compression == "zstd":
            return self._zstd(stored, size)
        if compression == "lz4":
            # The package has no types: a plain import would not pass the type checker.
            frame = importlib.import_module("lz4.frame")
            return _in_pieces(frame.LZ4FrameDecompressor().decompress, stored, size)
        if compression == "bz2":
            return _in_pieces(bz2.BZ2Decompressor().decompress, stored, size)
        return np.zeros(0, np.uint8)

    def _zstd(self, stored: memoryview, size: int) -> U8Array:
        import zstandard

        if len(self._data) < size:
            # Untouched pages cost nothing, should the chunk contain less than it claims.
            self._data = np.zeros(size, np.uint8)
        done = 0
        target = self._data.data
        with zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True) as reader:
            try:
                while done < size and (count := reader.readinto(target[done:size])):
                    done += count
            except zstandard.ZstdError:
                # The bytes before the fault are valid.
                return self._data[:done]
        return self._data[:done]


def decompressed(stored: bytes, most_bytes: int) -> bytes:
    """The content of one zstd frame; nothing if it is damaged or claims more than `most_bytes`."""
    import zstandard

    try:
        # The size that the frame claims is what would be allocated.
        if zstandard.frame_content_size(stored) > most_bytes:
            return b""
        return zstandard.ZstdDecompressor().decompress(stored, max_output_size=most_bytes)
    except zstandard.ZstdError:
        return b""


def _in_pieces(
    decompress: Callable[[bytes | memoryview, int], bytes], stored: memoryview, size: int
) -> U8Array:
    """Up to `size` bytes of a decompressor that keeps the input it has not used; none if corrupt.

    Large results in pieces, since a result exists twice while it grows.
    """
    try:
        first = decompress(stored, min(size, _ONE_CALL_BYTES))
        if len(first) < _ONE_CALL_BYTES or size == len(first):
            return np.frombuffer(first, np.uint8)
        data = np.zeros(size, np.uint8)
        done = 0
        piece = first
        while piece:
            data[done : done + len(piece)] = np.frombuffer(piece, np.uint8)
            done += len(piece)
            piece = decompress(b"", min(size - done, _PIECE_BYTES)) if done < size else b""
    except EOFError:
        return data[:done]
    except (RuntimeError, ValueError, OSError):
        return np.zeros(0, np.uint8)
    return data[:done]


def read_head(path: Path) -> bytes:
    """The first HEAD_BYTES of a recording, decompressed; RecordingError where there are none."""
    head = bytearray(HEAD_BYTES)
    with Source(path) as source:
        count = source.fill(memoryview(head))
        if source.fault and not count:
            raise RecordingError(f"{path}: {source.fault}; nothing can be read, copy it again")
        if not count:
            raise RecordingError(
                f"{path}: expected a recording, found 0 bytes; record or copy it again"
            )
    return bytes(head[:count])


def _opened(path: Path) -> FileIO:
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise RecordingError(
                f"{path}: expected a recording, found a folder; name the files inside it"
            )
        if not stat.S_ISREG(mode):
            raise RecordingError(
                f"{path}: expected a regular file, since it is read more than once; save it first"
            )
        return path.open("rb", buffering=0)
    except OSError as err:
        raise RecordingError(_unreadable(path, err)) from err


def _unreadable(path: Path, err: OSError) -> str:
    expected = f"{path}: expected a recording"
    # As a path, s3://bucket/name is s3:/bucket/name.
    scheme, is_url, rest = str(path).partition(":/")
    if is_url and scheme.isalnum() and isinstance(err, FileNotFoundError):
        return (
            f"{scheme}://{rest.lstrip('/')}: expected a recording on this machine, found a URL; "
            "copy it here, or give it to mlbatch convert or batch, which read URLs"
        )
    if isinstance(err, FileNotFoundError):
        return f"{expected}, found no such file; check the path"
    if isinstance(err, PermissionError):
        return f"{expected}, found no permission to read it; check its access rights"
    return f"{expected}, could not read it ({err.strerror}); check the disk"


def _stream(file: FileIO, magic: bytes) -> _Stream:
    if magic.startswith(_GZIP_MAGIC):
        return _Gzip(fileobj=file, mode="rb")
    if magic == ZSTD_MAGIC:
        import zstandard

        reader: _Stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        return reader
    return file


def _zstd_error() -> type[Exception]:
    import zstandard

    return zstandard.ZstdError
