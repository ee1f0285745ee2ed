"""Shared by all containers: messages, and reads of bounded length.

`mcap`, `rosbags` and `zipfile` parse the records. The lengths of records are checked against the
file, and sizes of compressed data against a limit, before a library allocates anything.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import SEEK_END, BufferedReader, BytesIO
from pathlib import Path
from typing import NamedTuple

from mlbatch.bounded import open_file
from mlbatch.outputs.damage import DamageError

# Largest unpacked size: this, or this multiple of the stored bytes. Scans shrink to a half or a
# tenth; decompression bombs are a thousand times larger than their stored bytes.
_USUAL_BYTES = 1 << 28
_MOST_TIMES = 256


def check_unpacked_size(size: int, stored: int) -> None:
    """Refuse to unpack `stored` bytes to a declared size that no scan has."""
    most = max(_USUAL_BYTES, _MOST_TIMES * stored)
    if size > most:
        raise DamageError(f"at most {most} bytes in {stored} that are stored", f"{size}")


@dataclass(frozen=True, slots=True)
class Message:
    """A message in a file."""

    # File, topic and number in it.
    where: str
    topic: str
    # package/Type
    type: str
    # cdr or ros1
    encoding: str
    # Log time, and publish time where the container has one.
    log_ns: int
    publish_ns: int
    data: bytes | memoryview


class MessagePlace(NamedTuple):
    """Where a message is in its file.

    number: of its topic's messages; chunk, chunk_bytes: offset in the file and size of the chunk's
    record or data; offset: of the message's record in the chunk.
    """

    topic: str
    number: int
    log_ns: int
    chunk: int
    chunk_bytes: int
    offset: int


@contextmanager
def library_errors(expected: str) -> Iterator[None]:
    """Raise DamageError for whatever a library raises on damaged bytes."""
    try:
        yield
    except DamageError:
        raise
    except Exception as err:
        raise DamageError(expected, str(err) or type(err).__name__) from err


class BoundedFile(BufferedReader):
    """A file that refuses to read past its end, before anything is allocated."""

    def __init__(self, path: Path) -> None:
        super().__init__(open_file(path))
        self.size = self.seek(0, SEEK_END)
        self.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly `size` bytes, or DamageError; all up to the end for -1."""
        left = self.size - self.tell()
        if size is None or size < 0:
            return super().read(left)
        if size > left:
            raise DamageError(f"{size} bytes at byte {self.tell()}", f"{left} to the end of file")
        return super().read(size)


class WholeReads(BytesIO):
    """Bytes that refuse to read past their end; libraries take what is left as whole."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.size = len(data)

    def read(self, size: int | None = -1, /) -> bytes:
        """Exactly `size` bytes, or DamageError."""
        left = self.size - self.tell()
        if size is None or not 0 <= size <= left:
            raise DamageError(f"{size} bytes at offset {self.tell()}", str(left))
        return super().read(size)
