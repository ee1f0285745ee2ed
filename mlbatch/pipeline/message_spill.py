"""Messages that wait for a distant scan, in a temporary SQLite database instead of memory."""

from __future__ import annotations

import contextlib
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeAlias

from mlbatch.errors import ExportError
from mlbatch.types import Message, Topic

if TYPE_CHECKING:
    import sqlite3

# By timestamp, topic, and order in the recordings: the order in the output.
Key: TypeAlias = tuple[int, str, int]
Entry: TypeAlias = tuple[Key, Message]

# The data may be lost with the process: no journal, and one transaction that never ends.
_BEGIN = """
PRAGMA journal_mode = OFF;
PRAGMA synchronous = OFF;
CREATE TABLE message(
    stamp_ns INTEGER, topic TEXT, added INTEGER, host_ns INTEGER, number INTEGER, data BLOB);
CREATE INDEX by_key ON message(stamp_ns, topic, added);
BEGIN;
"""
_IN_ORDER = "SELECT rowid, * FROM message ORDER BY stamp_ns, topic, added"
# Messages that are read at once.
_READ_BYTES = 1 << 16


class MessageSpill:
    """Messages in a file without a name, which the system removes; `len`: how many."""

    def __init__(self) -> None:
        self._base: sqlite3.Connection | None = None
        self._topics: list[Topic] = []
        self._count = 0
        # The first messages, already read; some, as long as there are any.
        self._ready: deque[Entry] = deque()

    def __len__(self) -> int:
        return self._count

    @property
    def first(self) -> Key | None:
        """Key of the first message; None without any."""
        return self._ready[0][0] if self._ready else None

    def add(self, entries: Sequence[Entry]) -> None:
        """Add entries."""
        if not entries:
            return
        self._count += len(entries)
        with _disk_errors():
            if self._base is None:
                self._base = _open()
            # Among those that were read there may be a place for the new ones.
            for added in (entries, self._ready):
                rows = [
                    (*key, one.host_ns, self._number(one.topic), one.data) for key, one in added
                ]
                self._base.executemany("INSERT INTO message VALUES (?, ?, ?, ?, ?, ?)", rows)
            self._ready.clear()
            self._read(self._base)

    def pop(self) -> Entry:
        """Take the first message."""
        entry = self._ready.popleft()
        self._count -= 1
        if self._base is not None and not self._ready:
            with _disk_errors():
                self._read(self._base)
            if not self._count:
                self._base.close()
                self._base = None
        return entry

    def _read(self, base: sqlite3.Connection) -> None:
        """Move the first messages from the file to memory."""
        rows = []
        size = 0
        for row, stamp_ns, name, added, host_ns, topic, data in base.execute(_IN_ORDER):
            message = Message(self._topics[topic], host_ns, data)
            self._ready.append(((stamp_ns, name, added), message))
            rows.append((row,))
            size += len(data)
            if size >= _READ_BYTES:
                break
        base.executemany("DELETE FROM message WHERE rowid = ?", rows)

    def _number(self, topic: Topic) -> int:
        if topic not in self._topics:
            self._topics.append(topic)
        return self._topics.index(topic)


def _open() -> sqlite3.Connection:
    import sqlite3

    # It opens the file at the first statement; after that the file needs no name.
    with tempfile.NamedTemporaryFile(prefix="mlbatch-") as file:
        base = sqlite3.connect(file.name, isolation_level=None, check_same_thread=False)
        base.executescript(_BEGIN)
    return base


@contextlib.contextmanager
def _disk_errors() -> Iterator[None]:
    import sqlite3

    try:
        yield
    except (OSError, sqlite3.Error) as err:
        raise ExportError(
            f"{tempfile.gettempdir()}: expected room for messages that wait for their scan, found "
            f"{getattr(err, 'strerror', None) or str(err)!r}; free space there, or set TMPDIR to "
            "another folder"
        ) from err
