"""Writes past the page cache, for files of gigabytes.

A page that is written costs its allocation, a copy, and later its removal: more than half of the
CPU of a large output. Systems with O_DIRECT take whole blocks from aligned memory instead. Parts
of any length are collected to such blocks here; where the file system refuses, the same bytes are
written through the cache.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Bytes: TypeAlias = bytes | bytearray | memoryview

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
