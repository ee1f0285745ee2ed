"""Output files written in order: gathered writes, checksums, page cache, continued files.

Continuing a file needs no code that knows its content. A writer that is given the same scans and
messages produces the same bytes and index again; so a resumed run repeats all writing, with
scans of the right size and without points, and the files here drop the bytes that are on the disk.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, BinaryIO, TypeAlias, TypeVar, cast

from mlbatch.errors import ExportError
from mlbatch.writers.direct_writes import DirectWrites

Bytes: TypeAlias = bytes | bytearray | memoryview  # views have items of one byte
Checksum: TypeAlias = Callable[[Bytes, int], int]
Scratch = TypeVar("Scratch")

# POSIX guarantees 16 buffers a write; all current systems take 1024.
_MOST_BUFFERS = 512
# Drop written pages from the page cache every so many bytes.
_DROP_BYTES = 64 << 20
# Advise so many bytes before them again: they may not have been on the disk the last time.
_REPEAT_BYTES = 256 << 20


def borrow(idle: list[Scratch], new: Callable[[], Scratch]) -> Scratch:
    """Return scratch that no thread uses, or new scratch; give it back by `idle.append`."""
    # Not `if idle`: another thread may take the last one in between.
    try:
        return idle.pop()
    except IndexError:
        return new()


def _best_checksum() -> Checksum:
    """Return CRC-32 as in zlib from the fastest installed library."""
    with contextlib.suppress(ImportError):
        return cast(Checksum, importlib.import_module("isal.isal_zlib").crc32)
    return zlib.crc32


crc32 = _best_checksum()


def write_all(file: io.FileIO, parts: Sequence[Bytes]) -> None:
    """Write parts one after the other to an unbuffered file, without joining them."""
    left = [memoryview(part) for part in parts if len(part)]
    while left:
        count = os.writev(file.fileno(), left[:_MOST_BUFFERS])
        while left and count >= len(left[0]):
            count -= len(left.pop(0))
        if count:
            left[0] = left[0][count:]


def drop_from_cache(descriptor: int, begin: int, end: int) -> None:
    """Start writing these bytes to the disk and drop them from the page cache.

    POSIX_FADV_DONTNEED drops clean pages only, so each range is advised again later. Waiting for
    the disk (fdatasync) is slower. Keeping the pages is slowest: every write needs new ones, until
    memory is full and the run stalls.
    """
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(descriptor, begin, end - begin, os.POSIX_FADV_DONTNEED)


class WriteBehind:
    """Small files written one after the other, dropped from the page cache some time later."""

    def __init__(self) -> None:
        self._files: deque[tuple[Path, int]] = deque()
        self._bytes = 0

    def add(self, path: Path, size: int) -> None:
        """Add a written file; drop those that are old enough to be on the disk."""
        self._files.append((path, size))
        self._bytes += size
        while self._bytes > _DROP_BYTES:
            path, size = self._files.popleft()
            self._bytes -= size
            # The file may be gone; dropping is an optimisation only.
            with contextlib.suppress(OSError), path.open("rb", buffering=0) as file:
                drop_from_cache(file.fileno(), 0, size)


class OutputFile:
    """A large file, unbuffered; skips the bytes that a continued file already contains.

    From its first `_DROP_BYTES` on it is written past the page cache where the system can.
    kept_bytes: length of the part that a continued file keeps, 0 for a new file;
    position_bytes: of the next byte, written or skipped.
    """

    def __init__(self, path: Path, kept_bytes: int | None) -> None:
        """kept_bytes: part of an existing file to keep; None: create a new file."""
        self.path = path
        self.kept_bytes = kept_bytes or 0
        self.position_bytes = 0
        self._dropped_bytes = 0
        self._direct: DirectWrites | None = None
        self._file = io.FileIO(path, "w+" if kept_bytes is None else "r+")
        if kept_bytes is not None:
            _truncate(self._file, path, kept_bytes)

    def look_at(self, position: int, count: int) -> bytes:
        """Return up to `count` bytes of the file at any position."""
        return os.pread(self._file.fileno(), count, position)

    def put(self, *parts: Bytes) -> None:
        """Append parts; the end of the kept bytes must not be inside them."""
        size = sum(map(len, parts))
        if self.position_bytes < self.kept_bytes:
            self.skip(size)
            return
        if self._direct is None:
            write_all(self._file, parts)
        else:
            for part in parts:
                self._direct.put(part)
        self.position_bytes += size
        if self.position_bytes - self._dropped_bytes >= _DROP_BYTES:
            begin = max(0, self._dropped_bytes - _REPEAT_BYTES)
            drop_from_cache(self._file.fileno(), begin, self.position_bytes)
            self._dropped_bytes = self.position_bytes
            if self._direct is None:
                direct = DirectWrites(self._file.fileno(), self.position_bytes)
                self._direct = direct if direct.is_direct else None

    @property
    def handed_bytes(self) -> int:
        """Bytes from the start that the system has."""
        return self.position_bytes if self._direct is None else self._direct.handed_bytes

    def skip(self, size: int) -> None:
        """Advance over kept bytes."""
        self.position_bytes += size
        if self.position_bytes > self.kept_bytes:
            raise _not_as_before(self.path)

    def complete(self) -> None:
        """Hand the rest to the system and close the file."""
        if self._direct is not None:
            self._direct.finish()
        self.close()

    def close(self) -> None:
        """Close the file; what was not handed to the system is lost."""
        self._file.close()


def open_buffered(path: Path, kept_bytes: int | None) -> BinaryIO:
    """Open a file as a library for writing expects it, new or continued; see `OutputFile`."""
    if kept_bytes is None:
        return path.open("wb")
    # A library that writes in order uses no other methods.
    return cast(BinaryIO, _KeptFile(path, kept_bytes))


class _KeptFile:
    """Drops the first `kept_bytes` that are written; positions include them."""

    def __init__(self, path: Path, kept_bytes: int) -> None:
        self._path = path
        self._left = kept_bytes
        self._file = path.open("r+b")
        _truncate(self._file, path, kept_bytes)

    def write(self, data: Bytes) -> int:
        """Write what follows the kept bytes; their end must not be inside `data`."""
        if not self._left:
            return self._file.write(data)
        size = memoryview(data).nbytes
        if size > self._left:
            raise _not_as_before(self._path)
        self._left -= size
        return size

    def tell(self) -> int:
        """Return the position that an uninterrupted run would have."""
        return self._file.tell() - self._left

    def seek(self, offset: int) -> int:
        """Move to a byte to overwrite."""
        return self._file.seek(offset)

    def flush(self) -> None:
        """Hand what was written to the system."""
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _truncate(file: IO[bytes], path: Path, kept_bytes: int) -> None:
    """Cut a file that is open for reading and writing, and move to its end."""
    size = file.seek(0, io.SEEK_END)
    if size < kept_bytes:
        file.close()
        raise ExportError(
            f"{path}: expected {kept_bytes} bytes of the interrupted run, found {size}; leave out "
            "--resume to start over"
        )
    file.truncate(kept_bytes)
    file.seek(kept_bytes)


def _not_as_before(path: Path) -> ExportError:
    """Return the error about data whose pieces end elsewhere than in the interrupted run."""
    return ExportError(
        f"{path}: expected the scans of the interrupted run, found others; leave out --resume to "
        "start over"
    )
