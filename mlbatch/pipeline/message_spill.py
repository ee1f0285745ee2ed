"""Messages that wait for a distant scan, in a temporary file instead of memory.

The file has sorted runs, each written at once. Messages are read back in order over all runs, as in
an external merge sort; memory contains one piece of each run that is being read. The file has no
name, so that the system removes it with the process.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO, TypeAlias, cast

from mlbatch.errors import ExportError
from mlbatch.types import Message, Topic

# By timestamp, topic, and order in the recordings: the order in the output.
Key: TypeAlias = tuple[int, str, int]
Entry: TypeAlias = tuple[Key, Message]

# Timestamp, log time, order, number of the topic, bytes of the message.
_HEAD = struct.Struct("<qqqII")
_PIECE_BYTES = 1 << 16


@dataclass(slots=True)
class _Run:
    """What is left of a sorted run: bytes [at, end) of the file; the bytes read of it."""

    at: int
    end: int
    data: bytes = b""
    used: int = 0


@dataclass(slots=True)
class MessageSpill:
    """Messages in a temporary file; `len`: how many."""

    _file: BinaryIO | None = None
    _topics: list[Topic] = field(default_factory=list)
    _numbers: dict[Topic, int] = field(default_factory=dict)
    # A heap of the first entry of each run: its key and place in `_runs`.
    _heads: list[tuple[Key, int]] = field(default_factory=list)
    _runs: dict[int, _Run] = field(default_factory=dict)
    _begun: int = 0
    _end: int = 0
    _count: int = 0

    def __len__(self) -> int:
        return self._count

    def add(self, entries: Sequence[Entry]) -> None:
        """Write entries, sorted by key, as a run."""
        if not entries:
            return
        with _disk_errors():
            if self._file is None:
                # Closed in `_free`: it is in use for longer than a call.
                opened = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
                self._file = cast(BinaryIO, opened)
            begin = self._end
            for part in _parts(entries):
                raw = b"".join(map(self._encoded, part))
                os.pwrite(self._file.fileno(), raw, self._end)
                self._end += len(raw)
        self._runs[self._begun] = _Run(begin, self._end)
        heapq.heappush(self._heads, (entries[0][0], self._begun))
        self._begun += 1
        self._count += len(entries)

    @property
    def first(self) -> Key | None:
        """Key of the first message; None without any."""
        return self._heads[0][0] if self._heads else None

    def pop(self) -> Entry:
        """Take the first message."""
        key, number = self._heads[0]
        run = self._runs[number]
        _, host_ns, _, topic, size = _HEAD.unpack(self._read(run, _HEAD.size))
        data = self._read(run, size)
        self._count -= 1
        following = self._next_key(run)
        if following is None:
            del self._runs[number]
            heapq.heappop(self._heads)
            self._free()
        else:
            heapq.heapreplace(self._heads, (following, number))
        return key, Message(self._topics[topic], host_ns, data)

    def _next_key(self, run: _Run) -> Key | None:
        """Key of the next entry of a run; None at its end."""
        if run.at == run.end and run.used == len(run.data):
            return None
        self._fill(run, _HEAD.size)
        stamp_ns, _, order, topic, _ = _HEAD.unpack_from(run.data, run.used)
        return stamp_ns, self._topics[topic].name, order

    def _encoded(self, entry: Entry) -> bytes:
        (stamp_ns, _, order), message = entry
        number = self._numbers.setdefault(message.topic, len(self._topics))
        if number == len(self._topics):
            self._topics.append(message.topic)
        head = _HEAD.pack(stamp_ns, message.host_ns, order, number, len(message.data))
        return head + message.data

    def _read(self, run: _Run, size: int) -> bytes:
        """Take the next bytes of a run."""
        self._fill(run, size)
        taken = run.data[run.used : run.used + size]
        run.used += size
        return taken

    def _fill(self, run: _Run, size: int) -> None:
        """Read until the next `size` bytes of a run are in memory."""
        missing = size - (len(run.data) - run.used)
        if missing <= 0 or self._file is None:
            return
        count = min(max(missing, _PIECE_BYTES), run.end - run.at)
        with _disk_errors():
            more = os.pread(self._file.fileno(), count, run.at)
            if len(more) < missing:
                raise OSError("a temporary file that lost its end")
        run.data = run.data[run.used :] + more
        run.used = 0
        run.at += len(more)

    def _free(self) -> None:
        """Close the file, and so remove it, once nothing is left in it."""
        if not self._runs and self._file is not None:
            self._file.close()
            self._file = None
            self._end = 0


def _parts(entries: Sequence[Entry]) -> Iterator[list[Entry]]:
    """Entries in portions of about the size of a piece, so that no large copy is made."""
    part: list[Entry] = []
    size = 0
    for entry in entries:
        part.append(entry)
        size += len(entry[1].data)
        if size >= _PIECE_BYTES:
            yield part
            part = []
            size = 0
    if part:
        yield part


@contextlib.contextmanager
def _disk_errors() -> Iterator[None]:
    try:
        yield
    except OSError as err:
        raise ExportError(
            f"{tempfile.gettempdir()}: expected room for messages that wait for their scan, found "
            f"{err.strerror or str(err)!r}; free space there, or set TMPDIR to another folder"
        ) from err
