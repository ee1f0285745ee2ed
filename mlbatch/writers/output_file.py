"""Output files written in order: gathered writes, checksums, page cache.

A page that is written costs its allocation, a copy, and later its removal: more than half of the
CPU of a large output. Systems with O_DIRECT take whole blocks from aligned memory instead. Parts
of any length are collected to such blocks here; where the file system refuses, the same bytes are
written through the cache.
"""

from __future__ import annotations

import contextlib
import errno
import io
import mmap
import os
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32, crc32_combine

Bytes: TypeAlias = bytes | bytearray | memoryview  # views have items of one byte
Scratch = TypeVar("Scratch")

# POSIX guarantees 16 buffers a write; all current systems take 1024.
_MOST_BUFFERS = 512
# Drop written pages from the page cache every so many bytes.
_DROP_BYTES = 64 << 20
# Advise so many bytes before them again: they may not have been on the disk the last time.
_REPEAT_BYTES = 256 << 20


def take_scratch(idle: list[Scratch], new: Callable[[], Scratch]) -> Scratch:
    """Return scratch that no thread uses, or new scratch; give it back by `idle.append`."""
    # Not `if idle`: another thread may take the last one in between.
    try:
        return idle.pop()
    except IndexError:
        return new()


# A piece stays in the cache of a core between its checksum and its copy to the system.
_PIECE_BYTES = 1 << 18


def joined_crc(first: int, second: int, size: int) -> int:
    """Return the CRC-32 of bytes and `size` more bytes, from those of both."""
    joined: int = crc32_combine(first, second, size)
    return joined


def file_crc(path: Path) -> int:
    """Return the CRC-32 of a file."""
    crc = 0
    with path.open("rb", buffering=0) as file:
        while piece := file.read(_PIECE_BYTES):
            crc = crc32(piece, crc)
    return crc


def write_all(file: io.FileIO, parts: Sequence[Bytes]) -> None:
    """Write parts one after the other to an unbuffered file, without joining them."""
    left = [memoryview(part) for part in parts if len(part)]
    while left:
        count = os.writev(file.fileno(), left[:_MOST_BUFFERS])
        while left and count >= len(left[0]):
            count -= len(left.pop(0))
        if count:
            left[0] = left[0][count:]


def write_summed(file: io.FileIO, parts: Sequence[Bytes]) -> int:
    """Write parts as `write_all`; returns the CRC-32 of all."""
    crc = 0
    waiting: list[Bytes] = []
    waiting_bytes = 0
    for part in parts:
        view = memoryview(part)
        for begin in range(0, len(view), _PIECE_BYTES):
            piece = view[begin : begin + _PIECE_BYTES]
            crc = crc32(piece, crc)
            waiting.append(piece)
            waiting_bytes += len(piece)
            if waiting_bytes >= _PIECE_BYTES:
                write_all(file, waiting)
                waiting, waiting_bytes = [], 0
    write_all(file, waiting)
    return crc


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
    """A large file, unbuffered.

    From its first `_DROP_BYTES` on it is written past the page cache where the system can.
    position_bytes: of the next byte; crc: CRC-32 of what is before it.
    """

    def __init__(self, path: Path) -> None:
        self.crc = 0
        self.position_bytes = 0
        self._dropped_bytes = 0
        self._direct: DirectWrites | None = None
        self._file = io.FileIO(path, "w+")

    def put(self, *parts: Bytes, crc: int | None = None) -> None:
        """Append parts, of a known CRC-32 or not."""
        size = sum(map(len, parts))
        if crc is not None:
            self.crc = joined_crc(self.crc, crc, size)
        else:
            for part in parts:
                self.crc = crc32(part, self.crc)
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

    def complete(self) -> None:
        """Hand the rest to the system and close the file."""
        if self._direct is not None:
            self._direct.finish()
        self.close()

    def close(self) -> None:
        """Close the file; what was not handed to the system is lost."""
        self._file.close()


# Unit of lengths, positions and addresses; blocks of almost all disks are as long or shorter.
BLOCK_BYTES = 4096
# Bytes that are collected for one write; they fit into the second-level cache.
_STAGE_BYTES = 2 << 20


class DirectWrites:
    """Appends to an open file from `position` on; other writes to it must be complete."""

    def __init__(self, descriptor: int, position: int) -> None:
        """descriptor: open for reading and writing."""
        self._descriptor = descriptor
        self._stage = mmap.mmap(-1, _STAGE_BYTES)
        self._bytes: npt.NDArray[np.uint8] = np.frombuffer(self._stage, np.uint8)
        # The begun block is written again as a whole.
        self._base = position - position % BLOCK_BYTES
        self._filled = position - self._base
        self._bytes[: self._filled] = np.frombuffer(
            os.pread(descriptor, self._filled, self._base), np.uint8
        )
        self._is_direct = _set_direct(descriptor, True)

    @property
    def is_direct(self) -> bool:
        """Whether the file system takes writes past the page cache."""
        return self._is_direct

    def put(self, part: Bytes) -> None:
        """Append bytes; they are written once they fill the stage."""
        if not len(part):
            return
        values = np.frombuffer(part, np.uint8)
        begin = 0
        while begin < len(values):
            end = min(len(values), begin + _STAGE_BYTES - self._filled)
            filled = self._filled + end - begin
            # Not by memoryviews, which would keep the interpreter lock.
            np.copyto(self._bytes[self._filled : filled], values[begin:end])
            self._filled = filled
            begin = end
            if filled == _STAGE_BYTES:
                self._write()

    def finish(self) -> None:
        """Write the rest, which is not a whole block, through the page cache."""
        self._leave()
        self._write()

    def _write(self) -> None:
        """Write what was collected."""
        done = 0
        view = memoryview(self._stage)[: self._filled]
        while done < self._filled:
            try:
                done += os.pwrite(self._descriptor, view[done:], self._base + done)
            except OSError as err:
                if err.errno != errno.EINVAL or not self._is_direct:
                    raise
                self._leave()
                continue
            if done % BLOCK_BYTES and self._is_direct:
                self._leave()
        self._base += self._filled
        self._filled = 0

    def _leave(self) -> None:
        if self._is_direct:
            _set_direct(self._descriptor, False)
            self._is_direct = False


def _set_direct(descriptor: int, is_direct: bool) -> bool:
    """Switch writes past the page cache on or off; return False where there are none."""
    if not hasattr(os, "O_DIRECT"):
        return False
    import fcntl

    flags = fcntl.fcntl(descriptor, fcntl.F_GETFL) & ~os.O_DIRECT
    with contextlib.suppress(OSError):
        fcntl.fcntl(descriptor, fcntl.F_SETFL, flags | (os.O_DIRECT if is_direct else 0))
        return is_direct
    return False
