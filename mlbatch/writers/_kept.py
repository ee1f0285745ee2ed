"""A file that is continued: what it already holds is written a second time, and goes nowhere.

A writer that is given the same scans and messages again makes the same file again, byte for byte
and index for index. So a resumed run repeats the whole writing, with scans of the right size and
no points, while the bytes that are safe on the disk stay as they are.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO, BinaryIO, cast

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
