"""ROS 2 bags in SQLite files: a folder, or one of its files, plain or compressed.

Source: docs/sources/messages.md, section 5 (db schemas 3 and 4, metadata versions 4 to 9). The
content of the files decides; metadata.yaml only says which files there should be. Files are never
written to: they are opened as immutable, so that bags on read-only media can be read.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Generator, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.errors import RecordingError
from mlbatch.readers.bag.recording import BagRecording, Portion, is_latched
from mlbatch.readers.source import (
    BUFFER_BYTES,
    MAX_RECORD_BYTES,
    ZSTD_MAGIC,
    Source,
    decompressed,
)
from mlbatch.ros.definitions import definition_text, type_key
from mlbatch.types import CutOff, Recording, StreamTable, Topic

CONTAINER = "ROS 2 bag (sqlite3)"

_MAGIC = b"SQLite format 3\0"
# SQLite file format, 1.3: size of the header, places of page size, counters and number of pages.
_HEAD_BYTES = 100
_PAGE_SIZE_AT = 16
_CHANGES_AT = 24
_PAGES_AT = 28
_VALID_FOR_AT = 92
# Kind of a page: rows of a table.
_TABLE_LEAF = 13
# Most bytes to write where the header of a compressed database does not state its size.
_MOST_BYTES = 1 << 40
_COMPUTED = re.compile(r"\b(virtual|as)\b")
_QUERIED_TABLES = ("messages", "topics", "message_definitions", "sqlite_master")
_BEFORE_ALL = (-(1 << 63), -(1 << 63))
_BY_TIME = (
    "SELECT id, topic_id, timestamp, data FROM messages WHERE timestamp >= ?1 AND "
    "(timestamp > ?1 OR id > ?2) AND topic_id IN ({}) ORDER BY timestamp, id"
)
# Without an index over times, messages come in the order of recording.
_BY_ID = (
    "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ?2 AND topic_id IN ({}) "
    "ORDER BY id"
)


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is a database."""
    return head.startswith(_MAGIC)


def open_packets(path: Path, streams: StreamTable) -> Recording:
    """Open a single file; its payloads come from streams (topic)."""
    return open_folder(path, [path], streams)


def open_folder(
    folder: Path,
    files: Sequence[Path],
    streams: StreamTable,
    notes: Sequence[str] = (),
    buffer_bytes: int = BUFFER_BYTES,
) -> Recording:
    """Open the files of a bag as one recording, in the order of their first messages.

    buffer_bytes: for tests, results do not depend on it.
    """
    databases = [_Database(path) for path in files]
    # Files without a message come last; equal times keep the order of names.
    databases.sort(key=lambda one: (one.first_ns is None, one.first_ns or 0))
    topics: dict[Topic, None] = {}
    for database in databases:
        topics |= dict.fromkeys(database.topics.values())
    opening_notes = [*notes, *(note for database in databases for note in database.notes)]
    return BagRecording(
        folder,
        CONTAINER,
        sum(database.size_bytes for database in databases),
        streams,
        partial(_portions, databases, buffer_bytes),
        tuple(opening_notes),
        topics=tuple(topics),
        last_ns=max((one.last_ns for one in databases if one.last_ns is not None), default=None),
    )


def _portions(
    databases: Sequence[_Database], buffer_bytes: int, recording: BagRecording
) -> Generator[Portion, None, None]:
    """One pass over all files."""
    buffer = np.zeros(buffer_bytes, np.uint8)
    before = 0
    for database in databases:
        numbers = {
            number: recording.number(topic)
            for number, topic in database.topics.items()
            if recording.selects(topic)
        }
        read = 0
        for portion in database.portions(numbers, buffer, recording):
            read += int((portion.end - portion.begin).sum())
            recording.position_bytes = before + min(read, database.size_bytes)
            yield portion
        before += database.size_bytes
        recording.position_bytes = before


class _Database:
    """An opened file.

    topics: by their numbers in this file; first_ns, last_ns: times of its first and last message,
    or None; notes: what is wrong with it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.size_bytes = path.stat().st_size
        self._plain = self._decompressed()
        try:
            with contextlib.closing(self._connect()) as connection:
                self.topics = _topics(connection)
                self._indexed = _has_time_index(connection)
                self.first_ns = self._edge_ns(connection, "ASC")
                self.last_ns = self._edge_ns(connection, "DESC")
                self._cut = self._cut_messages(connection)
        except (sqlite3.Error, LookupError, TypeError, ValueError) as err:
            raise RecordingError(
                f"{path}: expected a ROS 2 bag (tables topics and messages), found a database that "
                f"cannot be read ({err}); record or copy it again, or try `sqlite3 .recover`"
            ) from err

    def _decompressed(self) -> Path:
        """The file, or a temporary copy of it if it is compressed; removed with this object."""
        with Source(self.path) as source, self.path.open("rb") as file:
            if file.read(len(_MAGIC)) == _MAGIC:
                return self.path
            folder = Path(tempfile.mkdtemp(prefix="mlbatch-"))
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            target = folder / "bag.db3"
            piece = memoryview(bytearray(BUFFER_BYTES))
            count = source.fill(piece)
            left = _database_bytes(bytes(piece[: min(count, _HEAD_BYTES)]), self.path)
            try:
                with target.open("wb") as out:
                    # Bytes beyond the pages are no part of the database, and may be endless.
                    while count and left:
                        left -= out.write(piece[: min(count, left)])
                        count = source.fill(piece)
            except OSError as err:
                raise RecordingError(
                    f"{self.path}: expected room to decompress it to {folder.parent}, "
                    f"found: {err.strerror}; free some space there, or set TMPDIR to another place"
                ) from err
            if source.fault:
                note = f"{self.path.name}: {source.fault}; its end is missing"
                self.notes.append(CutOff(note))
            return target

    def _connect(self) -> sqlite3.Connection:
        uri = self._plain.resolve().as_uri() + "?mode=ro"
        log = self._plain.with_name(self._plain.name + "-wal")
        if log.is_file() and log.stat().st_size:
            # After a crash of `ros2 bag record` the last messages are still in the log.
            with contextlib.suppress(sqlite3.Error):
                connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
                connection.execute("SELECT count(*) FROM sqlite_master").fetchall()
                return connection
            note = CutOff(f"{log.name}: cannot be read with the bag; its last messages are missing")
            self.notes += [note] if note not in self.notes else []
        # Reading may continue in another thread, one at a time; SQLite would insist on the first.
        connection = sqlite3.connect(uri + "&immutable=1", uri=True, check_same_thread=False)
        # Without it, SQLite refuses a file that was cut off.
        connection.execute("PRAGMA writable_schema = ON")
        return connection

    def _edge_ns(self, connection: sqlite3.Connection, direction: str) -> int | None:
        """Time of the first (ASC) or last (DESC) message; None if there is none."""
        order = "timestamp" if self._indexed else "id"
        try:
            row = connection.execute(
                f"SELECT timestamp FROM messages ORDER BY {order} {direction} LIMIT 1"
            ).fetchone()
        except sqlite3.DatabaseError:
            # Reported when the table is read.
            return None
        return row[0] if row is not None and isinstance(row[0], int) else None

    def _cut_messages(self, connection: sqlite3.Connection) -> frozenset[int]:
        """Numbers of messages in a last page that is cut off, whose end SQLite reads as zeros."""
        with self._plain.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            page_bytes = _page_bytes(head)
            size = file.seek(0, 2)
            part = size % page_bytes
            if not part or size > _database_bytes(head, self.path):
                return frozenset()
            file.seek(size - part)
            page = file.read(part)
        found = f"expected {page_bytes} bytes, found {part}"
        note = CutOff(f"{self.path.name}: its last page was cut off: {found}")
        self.notes += [] if self.notes else [note]
        if page[0] == _TABLE_LEAF:
            return frozenset(_cut_rows(page, page_bytes))
        # The page continues another one, or is of an index: of the message that was written last.
        with contextlib.suppress(sqlite3.DatabaseError):
            row = connection.execute("SELECT max(id) FROM messages").fetchone()
            return frozenset() if row[0] is None else frozenset(row)
        # Reported when the table is read.
        return frozenset()

    def portions(
        self, numbers: dict[int, int], buffer: U8Array, recording: BagRecording
    ) -> Generator[Portion, None, None]:
        """Messages of the topics `numbers` (this file's number: the recording's) in `buffer`.

        A damaged database is read as far as possible; the recording counts what is lost.
        """
        if not numbers:
            return
        name = self.path.name
        marks = ", ".join(str(number) for number in numbers)
        by_id = _BY_ID.format(marks)
        query = _BY_TIME.format(marks) if self._indexed else by_id
        with contextlib.closing(self._connect()) as connection:
            page = _Page(name, numbers, buffer, recording, self._cut)
            has_more = True
            while has_more:
                try:
                    has_more = page.fill(connection, query)
                except sqlite3.Error as err:
                    # Where the index leads to damage, the order of recording may lead further.
                    has_more = query != by_id
                    if has_more:
                        note = f"{name}: {err}; messages come in the order of recording"
                        recording.lose(note, 0)
                        query = by_id
                    else:
                        note = f"{name}: {err}; the rest of the file was not read"
                        recording.lose(CutOff(note))
                if page.rows:
                    yield page.portion()


class _Page:
    """Messages of one portion, copied into a reused buffer."""

    def __init__(
        self,
        name: str,
        numbers: dict[int, int],
        buffer: U8Array,
        recording: BagRecording,
        cut: frozenset[int],
    ) -> None:
        """cut: numbers of messages that are not whole."""
        # (begin, end, log time, topic)
        self.rows: list[tuple[int, int, int, int]] = []
        self._name = name
        self._numbers = numbers
        self._buffer = buffer
        self._recording = recording
        self._cut = cut
        # Time and number of the last message read, of all portions.
        self._last = _BEFORE_ALL

    def fill(self, connection: sqlite3.Connection, query: str) -> bool:
        """Read messages until the buffer is full; whether there are more."""
        self.rows = rows = []
        numbers = self._numbers
        view = self._buffer.data
        room = len(view)
        fill = 0
        last = self._last
        try:
            with contextlib.closing(connection.execute(query, last)) as cursor:
                for number, topic, log_ns, data in cursor:
                    if not isinstance(data, bytes) or not isinstance(log_ns, int):
                        self._recording.lose(f"{self._name}: a message without bytes or time")
                        last = (last[0], number)
                        continue
                    if number in self._cut:
                        self._recording.lose()
                        last = (log_ns, number)
                        continue
                    if data.startswith(ZSTD_MAGIC):
                        # `ros2 bag record --compression-mode message` compresses each message.
                        data = decompressed(data, MAX_RECORD_BYTES)
                    end = fill + len(data)
                    if end > room:
                        if fill:
                            return True
                        # A single message that is larger than the buffer.
                        room = 2 * end
                        self._buffer = np.zeros(room, np.uint8)
                        view = self._buffer.data
                    view[fill:end] = data
                    rows.append((fill, end, log_ns, numbers[topic]))
                    fill = end
                    last = (log_ns, number)
            return False
        finally:
            self._last = last

    def portion(self) -> Portion:
        """The messages as arrays."""
        columns: I64Array = np.array(self.rows, np.int64).reshape(-1, 4)
        begin, end, log_ns, topic = (np.ascontiguousarray(column) for column in columns.T)
        return Portion(self._buffer, begin, end, log_ns, topic)


def _database_bytes(head: bytes, path: Path) -> int:
    """Size of a database by its header."""
    if not head.startswith(_MAGIC) or len(head) < _HEAD_BYTES:
        raise RecordingError(
            f"{path}: expected a compressed SQLite database, found one that begins with "
            f"{head[:8].hex(' ')}; record or copy it again"
        )
    changes = int.from_bytes(head[_CHANGES_AT : _CHANGES_AT + 4], "big")
    pages = int.from_bytes(head[_PAGES_AT : _PAGES_AT + 4], "big")
    valid_for = int.from_bytes(head[_VALID_FOR_AT : _VALID_FOR_AT + 4], "big")
    # Old versions of SQLite do not update the number of pages.
    if not pages or changes != valid_for:
        return _MOST_BYTES
    return pages * _page_bytes(head)


def _page_bytes(head: bytes) -> int:
    """Size of the pages by the header; 1 stands for 65536."""
    size = int.from_bytes(head[_PAGE_SIZE_AT : _PAGE_SIZE_AT + 2], "big")
    return 1 << 16 if size < 2 else size


def _cut_rows(page: bytes, page_bytes: int) -> Iterator[int]:
    """Numbers of the rows of a page of a table that are not whole (SQLite file format, 1.6).

    page: as much of it as there is.
    """
    for place in range(8, 8 + 2 * int.from_bytes(page[3:5], "big"), 2):
        begin = int.from_bytes(page[place : place + 2], "big")
        # Two integers of 7 bits a byte: the size of the row and its number.
        values = []
        value = 0
        for end, byte in enumerate(page[begin : begin + 18], begin + 1):
            value = value << 7 | byte & 0x7F
            if byte < 0x80:
                values.append(value)
                value = 0
            if len(values) == 2:
                if end + _bytes_in_page(values[0], page_bytes) > len(page):
                    yield values[1]
                break


def _bytes_in_page(row_bytes: int, page_bytes: int) -> int:
    """How much of a row is in its own page; the rest of a long one, and 4 bytes, lead to others."""
    most = page_bytes - 35
    if row_bytes <= most:
        return row_bytes
    least = (page_bytes - 12) * 32 // 255 - 23
    kept = least + (row_bytes - least) % (page_bytes - 4)
    return (kept if kept <= most else least) + 4


def _tables(connection: sqlite3.Connection) -> set[str]:
    """Names of the tables; ValueError if a queried one is computed (a view, columns).

    What is computed comes from the file, and may never end.
    """
    found = set()
    for row in connection.execute("SELECT name, type, sql FROM sqlite_master"):
        name, kind, text = (str(cell).lower() for cell in row)
        found |= {name} if kind == "table" else set()
        is_computed = kind != "table" or _COMPUTED.search(text) is not None
        if name in _QUERIED_TABLES and is_computed:
            raise ValueError(f"{kind} {name} is computed")
    return found


def _topics(connection: sqlite3.Connection) -> dict[int, Topic]:
    """Topics by number; definitions exist from schema 4 on."""
    connection.row_factory = sqlite3.Row
    tables = _tables(connection)
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in tables:
        for row in connection.execute("SELECT * FROM message_definitions"):
            text = str(row["encoded_message_definition"] or "")
            definitions[type_key(str(row["topic_type"]))] = (text, str(row["encoding"] or ""))
    found = {}
    for row in connection.execute("SELECT * FROM topics"):
        cells = dict(row)
        key = type_key(str(cells["type"]))
        text, text_format = definitions.get(key, ("", ""))
        if not text.strip():
            text = definition_text(key)
            text_format = "ros2msg"
        # Early versions have no such column, and converters leave fields empty.
        qos = str(cells.get("offered_qos_profiles") or "")
        found[int(cells["id"])] = Topic(
            name=str(cells["name"]),
            type=key,
            encoding=str(cells.get("serialization_format") or "cdr"),
            definition=text,
            format=text_format if text else "",
            qos=qos,
            latched=is_latched(qos),
        )
    connection.row_factory = None
    connection.execute("SELECT id, topic_id, timestamp, data FROM messages LIMIT 0")
    return found


def _has_time_index(connection: sqlite3.Connection) -> bool:
    """Whether messages can be read in order of time without sorting all of them."""
    plan = connection.execute("EXPLAIN QUERY PLAN " + _BY_TIME.format("1"), _BEFORE_ALL)
    return not any("TEMP B-TREE" in str(row[3]) for row in plan)
