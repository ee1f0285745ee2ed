"""One SQLite file of a ROS 2 bag: its topics, and its messages page by page.

Tables: facts/messages.md, section 5. The file is never written to: it is opened as immutable, so
that bags on read-only media and bags of other users can be read.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from functools import partial
from io import FileIO
from pathlib import Path

import numpy as np

from mlbatch.errors import RecordingError
from mlbatch.readers.bag.packet_messages import u32
from mlbatch.readers.bag.recording import BagRecording, Portion, is_latched
from mlbatch.readers.bag.sqlite_table import WINDOW_BYTES, HandOver, Rows, Table
from mlbatch.readers.source import Source
from mlbatch.ros.definitions import definition_text, type_key
from mlbatch.types import I64Array, Recording, StreamTable, Topic, U8Array

MAGIC = b"SQLite format 3\0"
BUFFER_BYTES = WINDOW_BYTES
_MAX_MESSAGE_BYTES = 1 << 28
# Where the file's header tells its version, pages and their size (SQLite file format, 1.3).
_HEAD_BYTES, _PAGE_SIZE_AT, _CHANGES_AT, _PAGES_AT, _VALID_FOR_AT = 100, 16, 24, 28, 92
_COMPUTED = re.compile(r"\b(virtual|as)\b")
_ASKED_TABLES = ("messages", "topics", "message_definitions", "sqlite_master")
_ZSTD = b"\x28\xb5\x2f\xfd"
_BEFORE_ALL = (-(1 << 63), -(1 << 63))
_COUNT = "SELECT count(*) FROM messages WHERE timestamp > ? AND timestamp < ?"
_COLUMNS = ["id", "topic_id", "timestamp", "data"]
_RESERVED_AT = 20
# No more is written where the header of a compressed database does not tell how large it is.
_MOST_BYTES = 1 << 40
_BY_TIME = (
    "SELECT id, topic_id, timestamp, data FROM messages WHERE timestamp >= ?1 AND "
    "(timestamp > ?1 OR id > ?2) AND topic_id IN ({}) ORDER BY timestamp, id"
)
# Without an index over times, messages come in the order of recording.
_BY_ID = (
    "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ?2 AND topic_id IN ({}) "
    "ORDER BY id"
)


@dataclass(slots=True)
class Damage:
    """What could not be read: a line each, and the number of messages."""

    notes: list[str] = field(default_factory=list)
    lost: int = 0

    def add(self, note: str, lost: int = 1) -> None:
        """Note something that is lost."""
        if note not in self.notes:
            self.notes.append(note)
        self.lost += lost


class Database:
    """An opened file.

    topics: by the numbers that this file gives them; first_ns: time of its first message, or None;
    notes: what is wrong with it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.size_bytes = path.stat().st_size
        self._plain = self._unpacked()
        self._logged = False
        try:
            with contextlib.closing(self._connect()) as connection:
                self.topics = _topics(connection)
                self._indexed = _has_time_index(connection)
                self.first_ns = self._first_ns(connection)
        except (sqlite3.Error, LookupError, TypeError, ValueError) as err:
            raise RecordingError(
                f"{path}: wanted a ROS 2 bag (tables topics and messages), got a database that "
                f"cannot be read ({err}); record or copy it again, or try `sqlite3 .recover`"
            ) from err

    def _unpacked(self) -> Path:
        """The file, or a temporary copy of it if it is compressed; gone with this object."""
        with Source(self.path) as source, self.path.open("rb") as file:
            if file.read(len(MAGIC)) == MAGIC:
                return self.path
            folder = Path(tempfile.mkdtemp(prefix="mlbatch-"))
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            target = folder / "bag.db3"
            piece = memoryview(bytearray(BUFFER_BYTES))
            count = source.fill(piece)
            left = _said_bytes(bytes(piece[: min(count, _HEAD_BYTES)]), self.path)
            try:
                with target.open("wb") as out:
                    # What a database holds beyond its pages is no part of it, and may be endless.
                    while count and left:
                        left -= out.write(piece[: min(count, left)])
                        count = source.fill(piece)
            except OSError as err:
                raise RecordingError(
                    f"{self.path}: wanted room to decompress it to {folder.parent}, "
                    f"got: {err.strerror}; free some space there, or set TMPDIR to another place"
                ) from err
            if source.fault:
                self.notes.append(f"{self.path.name}: {source.fault}; its end is missing")
            return target

    def _connect(self) -> sqlite3.Connection:
        uri = self._plain.resolve().as_uri() + "?mode=ro"
        log = self._plain.with_name(self._plain.name + "-wal")
        if log.is_file() and log.stat().st_size:
            # The last messages of a recorder that crashed are still in the log.
            with contextlib.suppress(sqlite3.Error):
                connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
                connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
                self._logged = True
                return connection
            note = f"{log.name}: cannot be read with the bag; its last messages are missing"
            self.notes += [note] if note not in self.notes else []
        # One thread at a time may go on with the reading; SQLite would insist on the first.
        connection = sqlite3.connect(uri + "&immutable=1", uri=True, check_same_thread=False)
        # Without it, a file that was cut off would be refused as a whole.
        connection.execute("PRAGMA writable_schema = ON")
        return connection

    def _first_ns(self, connection: sqlite3.Connection) -> int | None:
        """Time of the first message, for the order of files; None if there is none."""
        order = "timestamp" if self._indexed else "id"
        try:
            row = connection.execute(
                f"SELECT timestamp FROM messages ORDER BY {order} LIMIT 1"
            ).fetchone()
        except sqlite3.DatabaseError:
            # What is wrong with the table shows when it is read.
            return None
        return row[0] if row is not None and isinstance(row[0], int) else None

    def pages(
        self, numbers: dict[int, int], buffer: U8Array, damage: Damage
    ) -> Generator[Portion, None, None]:
        """Messages of the topics `numbers` (this file's number: the recording's) in `buffer`."""
        if not numbers:
            return
        with (
            contextlib.closing(self._connect()) as connection,
            self._plain.open("rb", buffering=0) as file,
        ):
            reading = _Reading(self.path.name, connection, numbers, buffer, damage)
            with contextlib.suppress(HandOver, OSError, sqlite3.Error):
                yield from reading.direct(self._table(connection, file), indexed=self._indexed)
                return
            yield from reading.portions(indexed=self._indexed)

    def _table(self, connection: sqlite3.Connection, file: FileIO) -> Table:
        """The table of messages in the file; HandOver where it is not laid out as usual."""
        columns = connection.execute("PRAGMA table_info(messages)").fetchall()
        if self._logged or [row[1] for row in columns] != _COLUMNS or columns[0][5] != 1:
            raise HandOver
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
        place = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE type = 'table' AND name = 'messages'"
        ).fetchone()
        if place is None or not isinstance(place[0], int):
            raise HandOver
        reserved = file.read(_RESERVED_AT + 1)[_RESERVED_AT]
        return Table(file, page_bytes, page_bytes - reserved, place[0])


@dataclass(slots=True)
class _Page:
    """Messages in the buffer so far: (begin, end, log time, topic)."""

    rows: list[tuple[int, int, int, int]] = field(default_factory=list)
    fill: int = 0

    def portion(self, buffer: U8Array) -> Portion:
        """The page as arrays."""
        columns: I64Array = np.array(self.rows, np.int64).reshape(-1, 4)
        begin, end, log_ns, topic = (np.ascontiguousarray(column) for column in columns.T)
        return Portion(buffer, begin, end, log_ns, topic)


class _Reading:
    """One pass over a file."""

    def __init__(
        self,
        name: str,
        connection: sqlite3.Connection,
        numbers: dict[int, int],
        buffer: U8Array,
        damage: Damage,
    ) -> None:
        self._name, self._connection, self._numbers = name, connection, numbers
        self._buffer, self._damage = buffer, damage
        self._last = _BEFORE_ALL
        self._marks = ", ".join(str(number) for number in numbers)

    def direct(self, table: Table, *, indexed: bool) -> Generator[Portion, None, None]:
        """Messages straight from the pages, as long as their order is that of the index."""
        here = np.array(sorted(self._numbers), np.int64)
        there = np.array([self._numbers[number] for number in here.tolist()], np.int64)
        before_ns = _BEFORE_ALL[0]
        for rows in table.rows(here, self._buffer):
            if indexed:
                before_ns = self._check_order(rows.log_ns, before_ns)
            if _any_zstd(self._buffer, rows):
                raise HandOver
            if len(rows.number):
                self._last = int(rows.log_ns[-1]), int(rows.number[-1])
            if len(rows.start):
                topic = there[np.searchsorted(here, rows.topic[rows.wanted])]
                log_ns, end = rows.log_ns[rows.wanted], rows.start + rows.size
                yield Portion(self._buffer, rows.start, end, log_ns, topic)

    def _check_order(self, log_ns: I64Array, before_ns: int) -> int:
        """The last of the times of rows, which must be the next ones in the order of time.

        Rows that come later but belong here would be counted between the times of these.
        """
        if not len(log_ns):
            return before_ns
        last_ns = int(log_ns[-1])
        between = int(((log_ns > before_ns) & (log_ns < last_ns)).sum())
        (count,) = self._connection.execute(_COUNT, (before_ns, last_ns)).fetchone()
        if log_ns[0] < before_ns or (np.diff(log_ns) < 0).any() or count != between:
            raise HandOver
        return last_ns

    def portions(self, *, indexed: bool) -> Generator[Portion, None, None]:
        """All messages; a database that is damaged is read as far as it goes."""
        by_id = _BY_ID.format(self._marks)
        query, go_on = _BY_TIME.format(self._marks) if indexed else by_id, True
        while go_on:
            page = _Page()
            try:
                go_on = self._fill(query, page)
            except sqlite3.Error as err:
                # Where the index leads to damage, the order of recording may lead further.
                go_on = query != by_id
                if go_on:
                    note = f"{self._name}: {err}; messages come in the order of recording"
                    self._damage.add(note, lost=0)
                    query = by_id
                else:
                    self._damage.add(f"{self._name}: {err}; the rest of the file was not read")
            if page.rows:
                yield page.portion(self._buffer)

    def _fill(self, query: str, page: _Page) -> bool:
        """Fill a page; whether there is more."""
        numbers, rows, view = self._numbers, page.rows, self._buffer.data
        room, fill = len(view), 0
        with contextlib.closing(self._connection.execute(query, self._last)) as cursor:
            for place, topic, log_ns, data in cursor:
                if not isinstance(data, bytes) or not isinstance(log_ns, int):
                    self._damage.add(f"{self._name}: a message without bytes or time")
                    self._last = self._last[0], place
                    continue
                if data[:4] == _ZSTD:
                    data = self._unzipped(data)
                end = fill + len(data)
                if end > room:
                    if fill:
                        return True
                    # A single message that is larger than the buffer.
                    self._buffer = np.zeros(2 * end, np.uint8)
                    view, room = self._buffer.data, 2 * end
                view[fill:end] = data
                rows.append((fill, end, log_ns, numbers[topic]))
                fill, self._last = end, (log_ns, place)
        return False

    def _unzipped(self, data: bytes) -> bytes:
        """A message that was compressed by itself; nothing if it is damaged."""
        import zstandard

        try:
            # The size that the data claim is what would be allocated.
            if zstandard.frame_content_size(data) > _MAX_MESSAGE_BYTES:
                return b""
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=_MAX_MESSAGE_BYTES)
        except zstandard.ZstdError:
            return b""


def _any_zstd(buffer: U8Array, rows: Rows) -> bool:
    """Whether messages are compressed one by one."""
    start = rows.start[rows.size >= len(_ZSTD)]
    return bool((u32(buffer, start) == int.from_bytes(_ZSTD, "little")).any())


def _said_bytes(head: bytes, path: Path) -> int:
    """Size of a database by its header."""
    if not head.startswith(MAGIC) or len(head) < _HEAD_BYTES:
        raise RecordingError(
            f"{path}: wanted a compressed SQLite database, got one that begins with "
            f"{head[:8].hex(' ')}; record or copy it again"
        )
    page_bytes, changes, pages, valid_for = (
        int.from_bytes(head[at : at + size], "big")
        for at, size in ((_PAGE_SIZE_AT, 2), (_CHANGES_AT, 4), (_PAGES_AT, 4), (_VALID_FOR_AT, 4))
    )
    # Old versions of SQLite leave the number of pages as it was.
    is_told = pages > 0 and changes == valid_for
    return pages * (1 << 16 if page_bytes == 1 else page_bytes) if is_told else _MOST_BYTES


def _tables(connection: sqlite3.Connection) -> set[str]:
    """Names of the tables; ValueError where one that is asked is computed (a view, columns).

    What is computed comes from the file, and may never end.
    """
    found = set()
    for row in connection.execute("SELECT name, type, sql FROM sqlite_master"):
        name, kind, text = (str(cell).lower() for cell in row)
        found |= {name} if kind == "table" else set()
        computed = kind != "table" or _COMPUTED.search(text) is not None
        if name in _ASKED_TABLES and computed:
            raise ValueError(f"{kind} {name} is computed")
    return found


def _topics(connection: sqlite3.Connection) -> dict[int, Topic]:
    """Topics by number; definitions are there from schema 4 on."""
    connection.row_factory = sqlite3.Row
    tables = _tables(connection)
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in tables:
        for row in connection.execute("SELECT * FROM message_definitions"):
            text, kind = str(row["encoded_message_definition"] or ""), str(row["encoding"] or "")
            definitions[type_key(str(row["topic_type"]))] = text, kind
    found = {}
    for row in connection.execute("SELECT * FROM topics"):
        cells = dict(row)
        key = type_key(str(cells["type"]))
        text, kind = definitions.get(key, ("", ""))
        if not text.strip():
            text, kind = definition_text(key), "ros2msg"
        # Early versions have no such column, and converters leave fields empty.
        qos = str(cells.get("offered_qos_profiles") or "")
        encoding = str(cells.get("serialization_format") or "cdr")
        found[int(cells["id"])] = Topic(
            str(cells["name"]), key, encoding, text, kind if text else "", qos, is_latched(qos)
        )
    connection.row_factory = None
    connection.execute("SELECT id, topic_id, timestamp, data FROM messages LIMIT 0")
    return found


def _has_time_index(connection: sqlite3.Connection) -> bool:
    """Whether messages can be had in the order of time without sorting them all."""
    plan = connection.execute("EXPLAIN QUERY PLAN " + _BY_TIME.format("1"), _BEFORE_ALL)
    return not any("TEMP B-TREE" in str(row[3]) for row in plan)


CONTAINER = "ROS 2 bag (sqlite3)"


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is a database."""
    return head.startswith(MAGIC)


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open a single file; its payloads come from streams (topic)."""
    return open_folder(path, [path], streams)


def open_folder(
    folder: Path, files: Sequence[Path], streams: StreamTable, notes: Sequence[str] = ()
) -> Recording:
    """Open the files of a bag as one recording, in the order of their first messages."""
    databases = [Database(path) for path in files]
    # Files without a message come last; equal times keep the order of names.
    databases.sort(key=lambda one: (one.first_ns is None, one.first_ns or 0))
    topics: dict[Topic, None] = {}
    for database in databases:
        topics |= dict.fromkeys(database.topics.values())
    standing = [*notes, *(note for database in databases for note in database.notes)]
    return BagRecording(
        folder,
        CONTAINER,
        sum(database.size_bytes for database in databases),
        tuple(topics),
        streams,
        partial(_portions, databases),
        tuple(standing),
    )


def _portions(
    databases: Sequence[Database], recording: BagRecording
) -> Generator[Portion, None, None]:
    """One pass over all files."""
    buffer = np.zeros(BUFFER_BYTES, np.uint8)
    before = 0
    for database in databases:
        numbers = {
            number: recording.number(topic)
            for number, topic in database.topics.items()
            if recording.wants(topic)
        }
        damage, read = Damage(), 0
        for portion in database.pages(numbers, buffer, damage):
            read += int((portion.end - portion.begin).sum())
            recording.position_bytes = before + min(read, database.size_bytes)
            yield portion
        before += database.size_bytes
        recording.position_bytes = before
        for note in damage.notes:
            recording.notes.append(note)
        recording.counts.frames += damage.lost
        recording.counts.skip("truncated", damage.lost)
