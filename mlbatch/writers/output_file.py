"""Bytes to files as they lie in memory: checksums, and writes that gather what lies apart."""

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


def open_output(path: Path, kept_bytes: int | None) -> BinaryIO:
    """A new file, or what an existing one holds up to `kept_bytes`, to be written again."""
    if kept_bytes is None:
        return path.open("wb")
    # What is written in order needs no more of a file than this.
    return cast(BinaryIO, KeptFile(path, kept_bytes))


def cut(file: IO[bytes], path: Path, kept_bytes: int) -> None:
    """Leave a file that is open for reading and writing what stays of it, and go to its end."""
    size = file.seek(0, io.SEEK_END)
    if size < kept_bytes:
        file.close()
        raise ExportError(
            f"{path}: wanted {kept_bytes} bytes of the interrupted run to go on after them, "
            f"got {size}; leave out --resume to begin anew"
        )
    file.truncate(kept_bytes)
    file.seek(kept_bytes)


def not_as_before(path: Path) -> ExportError:
    """The error about pieces that do not end where those of the interrupted run did."""
    return ExportError(
        f"{path}: wanted the scans of the interrupted run to go on after them, got others; leave "
        "out --resume to begin anew"
    )


class KeptFile:
    """Skips the first `kept_bytes` that are written; `tell` counts them nevertheless."""

    def __init__(self, path: Path, kept_bytes: int) -> None:
        self._path = path
        self._left = kept_bytes
        self._file = path.open("r+b")
        cut(self._file, path, kept_bytes)

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Write what goes beyond the kept bytes; these must end where a piece of data ends."""
        if not self._left:
            return self._file.write(data)
        size = memoryview(data).nbytes
        if size > self._left:
            raise not_as_before(self._path)
        self._left -= size
        return size

    def tell(self) -> int:
        """Where the next byte would lie in an uninterrupted writing."""
        return self._file.tell() - self._left

    def seek(self, offset: int) -> int:
        """Go to a byte that is to be written over."""
        return self._file.seek(offset)

    def flush(self) -> None:
        """Hand what was written to the system."""
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


# Views have a byte for each of their items.
Bytes: TypeAlias = bytes | bytearray | memoryview
Checksum: TypeAlias = Callable[[Bytes, int], int]
Scratch = TypeVar("Scratch")

# POSIX promises that a write takes 16 pieces; all systems of today take 1024.
_MOST_PIECES = 512
# After so many bytes, what was written is dropped from the memory of the system; so many bytes
# before them may not have been on the disk the last time.
_STEP_BYTES, _LATE_BYTES = 64 << 20, 256 << 20


def taken(idle: list[Scratch], new: Callable[[], Scratch]) -> Scratch:
    """Scratch that no thread uses, or new one."""
    # Not by looking first: another thread may take the last one in between.
    try:
        return idle.pop()
    except IndexError:
        return new()


def _best_checksum() -> Checksum:
    """CRC-32 as zlib has it, of the fastest library that is installed."""
    with contextlib.suppress(ImportError):
        return cast(Checksum, importlib.import_module("isal.isal_zlib").crc32)
    return zlib.crc32


crc32 = _best_checksum()


def write_all(file: io.FileIO, parts: Sequence[Bytes]) -> None:
    """Write parts one after the other to an unbuffered file, without joining them."""
    left = [memoryview(part) for part in parts if len(part)]
    while left:
        count = os.writev(file.fileno(), left[:_MOST_PIECES])
        while left and count >= len(left[0]):
            count -= len(left.pop(0))
        if count:
            left[0] = left[0][count:]


class OutputFile:
    """A large file that is written in order; what a continued one already holds is skipped.

    kept_bytes: what it already holds; position_bytes: of the next byte, written or skipped.
    """

    def __init__(self, path: Path, kept_bytes: int | None) -> None:
        """kept_bytes: what stays of an existing file, None: begin a new one."""
        self.path = path
        self._file = io.FileIO(path, "w" if kept_bytes is None else "r+")
        self.kept_bytes = kept_bytes or 0
        self.position_bytes = self._dropped_bytes = 0
        if kept_bytes is not None:
            cut(self._file, path, kept_bytes)

    def look_at(self, place: int, count: int) -> bytes:
        """Bytes anywhere in what stays of the file."""
        return os.pread(self._file.fileno(), count, place)

    def put(self, *parts: Bytes) -> None:
        """Append parts, which must not begin before and end after the end of what stays."""
        size = sum(map(len, parts))
        if self.position_bytes < self.kept_bytes:
            self.skip(size)
            return
        write_all(self._file, parts)
        self.position_bytes += size
        if self.position_bytes - self._dropped_bytes >= _STEP_BYTES:
            self._drop()

    def skip(self, size: int) -> None:
        """Go past bytes that stay."""
        self.position_bytes += size
        if self.position_bytes > self.kept_bytes:
            raise not_as_before(self.path)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _drop(self) -> None:
        forget(self._file.fileno(), max(0, self._dropped_bytes - _LATE_BYTES), self.position_bytes)
        self._dropped_bytes = self.position_bytes


class Trail:
    """Files that were written one after the other, until the system has forgotten them."""

    def __init__(self) -> None:
        self._files: deque[tuple[Path, int]] = deque()
        self._bytes = 0

    def add(self, path: Path, size: int) -> None:
        """Go on to the next file: those far enough behind should be on the disk by now."""
        self._files.append((path, size))
        self._bytes += size
        while self._bytes > _STEP_BYTES:
            path, size = self._files.popleft()
            self._bytes -= size
            # Whatever became of it, it was written well.
            with contextlib.suppress(OSError), path.open("rb", buffering=0) as file:
                forget(file.fileno(), 0, size)


def forget(descriptor: int, begin: int, end: int) -> None:
    """Have the system write these bytes to the disk, and keep them in its memory no longer.

    It forgets what is on the disk already and only begins to write the rest, which is why a stretch
    is named again at the next steps. Waiting for the disk (fdatasync) takes longer. Not to forget
    takes longest: every page is a new one, and at last a full memory stops the run.
    """
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(descriptor, begin, end - begin, os.POSIX_FADV_DONTNEED)
