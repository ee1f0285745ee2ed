"""ROS 1 bags: read from front to back, with and without an index, in constant memory.

Source: wiki.ros.org/Bags/Format/2.0; docs/sources/messages.md, section 5. A record is a header of
`name=value` fields with a length before it, and data with a length before them. Messages come in
file order; recordings that were cut off by a crash (`.active`) are read as far as they go. Records
are read many at once where their headers differ in values alone.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.errors import RecordingError
from mlbatch.readers.bag.recording import BagRecording, Portion
from mlbatch.readers.byte_records import records
from mlbatch.readers.source import BUFFER_BYTES, Decompressor, Source, Window, read_head
from mlbatch.ros.definitions import type_key
from mlbatch.types import CutOff, Recording, StreamTable, Topic
from mlbatch.units import NS_PER_S

CONTAINER = "ROS 1 bag"

_NAME = b"#ROSBAG V"
_MAGIC = b"#ROSBAG V2.0\n"
# `rosbag record` begins a new chunk every 0.75 MB by default.
_MAX_CHUNK_BYTES = 1 << 28
_MAX_INDEX_BYTES = 16 << 20
_PLAIN = "none"
_COMPRESSIONS = ("lz4", "bz2")
_U32 = struct.Struct("<I")
_WORD_BYTES = 4
# The field `op=` with the length of a value of one byte before it.
_TIME = struct.Struct("<II")
_OP = b"\x04\0\0\0op="
# The longest header contains the name of a topic; the shortest the kind of the record.
_MAX_HEAD_BYTES = 1 << 20
_LEAST_HEAD_BYTES = len(_OP) + 1
# Records may be as short as their lengths: most records kept at a time.
_MOST_RECORDS = 1 << 18


def recognises(head: bytes) -> bool:
    """Whether a file that begins with `head` is a ROS 1 bag, of any version."""
    return head.startswith(_NAME)


def open_packets(path: Path, streams: StreamTable, buffer_bytes: int = BUFFER_BYTES) -> Recording:
    """Open a bag; its payloads come from streams (topic).

    buffer_bytes: for tests, results do not depend on it.
    """
    head = read_head(path)
    if not head.startswith(_MAGIC):
        version = head[: len(_MAGIC)].split(b"\n")[0].decode("latin-1")
        raise RecordingError(
            f"{path}: expected a bag of version 2.0 ({_MAGIC.decode().strip()}), found {version}; "
            "convert it with `rosbag fix` or `rosbag reindex`"
        )
    with Source(path) as source:
        size_bytes = source.size_bytes
        topics, last_ns, note = _index(source, path, buffer_bytes)
    opening_notes = (note,) if note else ()
    portions = partial(_portions, buffer_bytes)
    recording = BagRecording(
        path,
        CONTAINER,
        size_bytes,
        streams,
        portions,
        opening_notes,
        topics=topics,
        last_ns=last_ns,
    )
    if not topics:
        # A connection precedes its first message: all messages have to be read.
        for _ in portions(recording):
            pass
            recording.notes = list(opening_notes)
    return recording


def _index(
    source: Source, path: Path, buffer_bytes: int
) -> tuple[tuple[Topic, ...], int | None, str]:
    """Topics and newest log time by the index at a bag's end, or none and why.

    The reason is a note, if something is wrong.
    """
    window = Window(source, buffer_bytes)
    window.begin = len(_MAGIC)
    try:
        while not len((walked := _walk(window.data, window.begin, window.end)).rows):
            if _claims_too_much(window) or not window.refill():
                return (), None, CutOff("the bag ends within its header")
        fields = _head_fields(_bytes(window.data, *walked.rows[0, :2].tolist()))
        place = _number(fields, "index_pos")
        count = _number(fields, "conn_count")
        if fields.get("encryptor"):
            raise RecordingError(
                f"{path}: expected a bag that can be read, found one that is encrypted "
                f"({fields['encryptor'].decode('latin-1')}); decrypt it with `rosbag decrypt`"
            )
        if not place:
            note = "the bag was not closed and has no index; it is read record by record"
            return (), None, CutOff(note)
        if not source.is_plain:
            # A file compressed as a whole is only read in order; its index may be intact.
            return (), None, ""
        index = np.frombuffer(source.look_at(place, _MAX_INDEX_BYTES), np.uint8)
        records = _walk(index, 0, len(index)).rows
        topics = [topic for _, topic in _connections(index, records)]
        last_ns = _last_ns(index, records)
    except _HeadError as err:
        return (), None, f"the bag's index is damaged ({err}); it is read record by record"
    if len(topics) < count:
        note = "the bag's index is incomplete; it is read record by record"
        return (), None, CutOff(note) if place >= source.size_bytes else note
    return tuple(dict.fromkeys(topics)), last_ns, ""


# -- records --------------------------------------------------------------------------------------


class _Op(IntEnum):
    """Kind of a record."""

    MESSAGE = 2
    BAG = 3
    INDEX = 4
    CHUNK = 5
    CHUNK_INFO = 6
    CONNECTION = 7


class _HeadError(ValueError):
    """Bytes that are no header."""


def _head_fields(raw: bytes) -> dict[str, bytes]:
    """Fields of a header."""
    return {
        raw[name:begin].rstrip(b"=").decode("latin-1"): raw[begin:end]
        for name, begin, end in _places(raw)
    }


def _places(raw: bytes) -> list[tuple[int, int, int]]:
    """Places of the fields of a header: begin of the name, begin and end of the value."""
    found = []
    at = 0
    while at < len(raw):
        if at + _WORD_BYTES > len(raw):
            raise _HeadError("a field without a length")
        end = at + _WORD_BYTES + _U32.unpack_from(raw, at)[0]
        equals = raw.find(b"=", at + _WORD_BYTES, end)
        if end > len(raw) or equals < 0:
            raise _HeadError("a field that is longer than its header, or has no value")
        found.append((at + _WORD_BYTES, equals + 1, end))
        at = end
    return found


def _number(fields: dict[str, bytes], name: str) -> int:
    """The value of a field that contains a little-endian number."""
    if name not in fields or len(fields[name]) not in (1, 4, 8):
        raise _HeadError(f"no number {name!r}")
    return int.from_bytes(fields[name], "little")


def _op_of(raw: bytes) -> int:
    """Kind of a record with this header; quicker than reading all fields."""
    at = raw.find(_OP)
    if at < 0:
        raise _HeadError("a record without a kind")
    return raw[at + len(_OP)] if at + len(_OP) < len(raw) else 0


def _connection_topic(fields: dict[str, bytes], data: bytes) -> tuple[int, Topic]:
    """Number and topic of a connection, from its record's header and data."""
    about = _head_fields(data)
    texts = {name: value.decode("utf-8", "replace") for name, value in about.items()}
    topic = fields.get("topic", about.get("topic", b"")).decode("utf-8", "replace")
    if not topic or "type" not in texts:
        raise _HeadError("a connection without topic or type")
    return _number(fields, "conn"), Topic(
        topic,
        type_key(texts["type"]),
        "ros1",
        texts.get("message_definition", ""),
        "ros1msg",
        latched=texts.get("latching") == "1",
    )


class _Records(NamedTuple):
    """Records in a row; those before byte `next` are complete.

    rows: (n, 4) int64, places and sizes: header, its size, data, their size.
    """

    rows: I64Array
    next: int


def _walk(data: U8Array, begin: int, end: int) -> _Records:
    """The whole records of `data[begin:end]`, at most _MOST_RECORDS of them."""
    heads = []
    bodies = []
    view = data.data
    length_at = _U32.unpack_from
    at = begin
    for _ in range(_MOST_RECORDS):
        if at + _WORD_BYTES > end:
            break
        head_size = length_at(view, at)[0]
        body = at + _WORD_BYTES + head_size
        # Zeros would be records without a header, very many of them.
        if body + _WORD_BYTES > end or head_size < _LEAST_HEAD_BYTES:
            break
        after = body + _WORD_BYTES + length_at(view, body)[0]
        if after > end:
            break
        heads.append(at)
        bodies.append(body)
        at = after
    head = np.array(heads, np.int64) + _WORD_BYTES
    body_at = np.array(bodies, np.int64)
    data_at = body_at + _WORD_BYTES
    following = np.append(head[1:] - _WORD_BYTES, at)[: len(head)]
    return _Records(np.stack([head, body_at - head, data_at, following - data_at], axis=1), at)


@dataclass(frozen=True, slots=True)
class _Template:
    """A message header; others of its length with the same fixed bytes have its layout."""

    fixed: I64Array
    value: U8Array
    connection_at: int
    time_at: int

    @classmethod
    def of(cls, raw: bytes) -> _Template | None:
        """From one header; None if it is not that of a message."""
        places = {raw[name : begin - 1]: (begin, end) for name, begin, end in _places(raw)}
        connection = places.get(b"conn", (0, 0))
        time = places.get(b"time", (0, 0))
        op = places.get(b"op", (0, 0))
        if raw[op[0] : op[1]] != bytes([_Op.MESSAGE]):
            return None
        if connection[1] - connection[0] != 4 or time[1] - time[0] != 8:
            raise _HeadError("a message without connection or time")
        fixed = np.ones(len(raw), bool)
        fixed[slice(*connection)] = False
        fixed[slice(*time)] = False
        at = np.flatnonzero(fixed)
        return cls(at, np.frombuffer(raw, np.uint8)[at], connection[0], time[0])


class _Headers(NamedTuple):
    """Headers of n records: is_message (n,) bool; connection, log_ns: (n,) int64."""

    is_message: BoolArray
    connection: I64Array
    log_ns: I64Array


@dataclass(slots=True)
class _HeaderReader:
    """Reads headers; remembers layouts of message headers by their length."""

    _templates: dict[int, list[_Template]] = field(default_factory=dict)

    def read(self, data: U8Array, found: I64Array) -> _Headers:
        """Headers of records (n, 4); _HeadError where one is damaged."""
        count = len(found)
        heads = _Headers(
            np.zeros(count, bool), np.zeros(count, np.int64), np.zeros(count, np.int64)
        )
        for size in np.unique(found[:, 1]).tolist():
            rows = np.flatnonzero(found[:, 1] == size)
            if size:
                self._read_equal(data, found[rows, 0], size, rows, heads)
        return heads

    def _read_equal(
        self, data: U8Array, begin: I64Array, size: int, rows: I64Array, heads: _Headers
    ) -> None:
        """Headers of one length."""
        raw = records(data, np.dtype([("byte", "u1", (size,))]), begin)["byte"]
        known = self._templates.setdefault(size, [])
        tried = 0
        while len(rows):
            if tried == len(known):
                template = _Template.of(raw[0].tobytes())
                if template is None:
                    raw = raw[1:]
                    rows = rows[1:]
                    continue
                known.append(template)
            template = known[tried]
            tried += 1
            fits = (raw[:, template.fixed] == template.value).all(axis=1)
            words = np.ascontiguousarray(raw[fits])
            heads.is_message[rows[fits]] = True
            heads.connection[rows[fits]] = _u32(words, template.connection_at)
            seconds = _u32(words, template.time_at)
            rest_ns = _u32(words, template.time_at + 4)
            heads.log_ns[rows[fits]] = seconds * NS_PER_S + rest_ns
            raw = raw[~fits]
            rows = rows[~fits]


def _u32(rows: U8Array, at: int) -> I64Array:
    """Little-endian words at byte `at` of each row."""
    word: I64Array = np.ascontiguousarray(rows[:, at : at + 4]).view("<u4")[:, 0].astype(np.int64)
    return word


# -- one pass -------------------------------------------------------------------------------------


def _bytes(data: U8Array, begin: int, size: int) -> bytes:
    return data[begin : begin + size].tobytes()


def _connections(data: U8Array, found: I64Array) -> Iterator[tuple[int, Topic]]:
    """The connections among records, with their numbers."""
    for head, head_size, body, size in found.tolist():
        fields = _head_fields(_bytes(data, head, head_size))
        if _number(fields, "op") == _Op.CONNECTION:
            yield _connection_topic(fields, _bytes(data, body, size))


def _last_ns(data: U8Array, found: I64Array) -> int | None:
    """Newest log time by the chunk infos of an index; None where it is not stated for all."""
    if len(found) == _MOST_RECORDS:
        return None
    ends_ns = []
    for head, head_size, _, _ in found.tolist():
        fields = _head_fields(_bytes(data, head, head_size))
        if _number(fields, "op") != _Op.CHUNK_INFO:
            continue
        end = fields.get("end_time", b"")
        if len(end) != _TIME.size:
            return None
        seconds, rest_ns = _TIME.unpack(end)
        ends_ns.append(seconds * NS_PER_S + rest_ns)
    return max(ends_ns, default=None)


def _claims_too_much(window: Window) -> str:
    """Why the bytes at the front of the window cannot be a record, or ""."""
    data = window.data
    at = window.begin
    end = window.end
    if at + _WORD_BYTES > end:
        return ""
    head = int.from_bytes(_bytes(data, at, _WORD_BYTES), "little")
    if not _LEAST_HEAD_BYTES <= head <= _MAX_HEAD_BYTES:
        return f"expected a header of {_LEAST_HEAD_BYTES} to {_MAX_HEAD_BYTES} bytes, found {head}"
    at += _WORD_BYTES + head
    size = int.from_bytes(_bytes(data, at, _WORD_BYTES), "little") if at + 4 <= end else 0
    if size > _MAX_CHUNK_BYTES:
        return f"expected a record of at most {_MAX_CHUNK_BYTES} bytes, found {size}"
    return ""


def _portions(buffer_bytes: int, recording: BagRecording) -> Generator[Portion, None, None]:
    """One pass over a bag."""
    with Source(recording.path) as source:
        yield from _Pass(recording, source).portions(buffer_bytes)


class _Pass:
    """Reads a bag from front to back; notes and counts what it cannot read."""

    def __init__(self, recording: BagRecording, source: Source) -> None:
        self._recording = recording
        self._source = source
        self._reader = _HeaderReader()
        self._decompressor = Decompressor()
        self._gathered: U8Array = np.zeros(BUFFER_BYTES, np.uint8)
        # Topic of each connection, -1 where its topic is not selected.
        self._topics: dict[int, int] = {}
        self._cut = False

    def portions(self, buffer_bytes: int) -> Generator[Portion, None, None]:
        """All selected messages."""
        window = Window(self._source, buffer_bytes)
        window.begin = len(_MAGIC)
        window.refill()
        while True:
            self._recording.position_bytes = self._source.position_bytes
            walked = _walk(window.data, window.begin, window.end)
            try:
                yield from self._records(window.data, walked.rows)
            except _HeadError as err:
                note = f"{_at(window)}: {err}; the rest of the bag was not read"
                self._recording.lose(CutOff(note))
                return
            window.begin = walked.next
            fault = _claims_too_much(window)
            if fault:
                note = f"{_at(window)}: {fault}; the rest of the bag was not read"
                self._recording.lose(CutOff(note))
                return
            if len(walked.rows) < _MOST_RECORDS and not window.refill():
                yield from self._end(window)
                return

    def _records(self, data: U8Array, found: I64Array) -> Generator[Portion, None, None]:
        """Records outside chunks: chunks, and messages of a bag that was never closed."""
        # Messages of many chunks are read together, if they are in one buffer.
        source = data
        parts: list[I64Array] = []
        gathered_bytes = 0
        bare: list[int] = []
        for index, (head, head_size, body, size) in enumerate(found.tolist()):
            raw = _bytes(data, head, head_size)
            op = _op_of(raw)
            if op in (_Op.MESSAGE, _Op.CONNECTION):
                bare.append(index)
            if op != _Op.CHUNK:
                continue
            fields = _head_fields(raw)
            chunk, begin, end = data, body, body + size
            if _compression(fields) != _PLAIN:
                chunk = self._unpack(fields, data.data[body : body + size])
                begin, end = 0, len(chunk)
                if len(chunk) <= len(self._gathered):
                    if gathered_bytes + len(chunk) > len(self._gathered):
                        yield from self._messages(source, parts)
                        parts = []
                        gathered_bytes = 0
                    begin, end = gathered_bytes, gathered_bytes + len(chunk)
                    self._gathered[begin:end] = chunk
                    chunk = self._gathered
                    gathered_bytes = end
            if chunk is not source:
                yield from self._messages(source, parts)
                source, parts = chunk, []
            for part in self._inside(chunk, begin, end):
                parts.append(part)
                if len(part) == _MOST_RECORDS:
                    yield from self._messages(source, parts)
                    parts = []
        yield from self._messages(source, parts)
        yield from self._messages(data, [found[bare]] if bare else [])

    def _inside(self, data: U8Array, begin: int, end: int) -> Iterator[I64Array]:
        """The records of a chunk, in parts."""
        for walked in _parts(data, begin, end):
            yield walked.rows
        if walked.next < end and not self._cut:
            self._recording.lose(
                f"a chunk: expected whole records, found {end - walked.next} other bytes; "
                "the rest of the chunk was not read"
            )

    def _unpack(self, fields: dict[str, bytes], stored: memoryview) -> U8Array:
        """The bytes of a compressed chunk, as far as they can be read."""
        compression = _compression(fields)
        whole = _number(fields, "size")
        found = np.zeros(0, np.uint8)
        if 0 < whole <= _MAX_CHUNK_BYTES and compression in _COMPRESSIONS:
            found = self._decompressor.decompress(compression, stored, whole)
        if len(found) < whole and not self._cut:
            self._recording.lose(
                f"a chunk ({compression}): expected {whole} bytes, found {len(found)}; "
                "the rest of the chunk was not read"
            )
            # A cut record at its end is not reported again.
            *_, last = _parts(found, 0, len(found))
            return found[: last.next]
        return found

    def _messages(self, data: U8Array, parts: list[I64Array]) -> Generator[Portion, None, None]:
        """The selected messages among records; new connections are stored."""
        if not parts:
            return
        found = np.concatenate(parts)
        try:
            heads = self._reader.read(data, found)
            for connection, topic in _connections(data, found[~heads.is_message]):
                self._connect(connection, topic)
        except _HeadError as err:
            if len(parts) == 1:
                self._recording.lose(f"a chunk: {err}; it was not read")
                return
            for part in parts:
                yield from self._messages(data, [part])
            return
        rows = np.flatnonzero(heads.is_message)
        numbers, inverse = np.unique(heads.connection[rows], return_inverse=True)
        known = np.array([self._topics.get(at, -1) for at in numbers.tolist()], np.int64)
        topic_of = known[inverse]
        rows = rows[topic_of >= 0]
        topic_of = topic_of[topic_of >= 0]
        if len(rows):
            begin = found[rows, 2]
            yield Portion(data, begin, begin + found[rows, 3], heads.log_ns[rows], topic_of)

    def _connect(self, connection: int, topic: Topic) -> None:
        at = self._recording.number(topic)
        self._topics[connection] = at if self._recording.selects(topic) else -1

    def _end(self, window: Window) -> Generator[Portion, None, None]:
        """The bytes left at the end of the file: none, or a part of a record."""
        left = window.end - window.begin
        if self._source.fault:
            self._recording.notes.append(CutOff(f"{_at(window)}: {self._source.fault}"))
        if left <= 0:
            return
        note = f"{_at(window)}: the bag ends within a record; it was cut off"
        self._recording.lose(CutOff(note))
        head = window.begin + _WORD_BYTES
        body = head + int.from_bytes(_bytes(window.data, window.begin, _WORD_BYTES), "little")
        # A cut chunk is read like a whole one; that it was cut is already counted.
        self._cut = True
        data = body + _WORD_BYTES
        record = np.array([[head, body - head, data, window.end - data]], np.int64)
        with contextlib.suppress(_HeadError):
            if window.end > data:
                yield from self._records(window.data, record)


def _parts(data: U8Array, begin: int, end: int) -> Iterator[_Records]:
    """The records of `data[begin:end]`, _MOST_RECORDS at a time; at least one part."""
    yield (walked := _walk(data, begin, end))
    while len(walked.rows) == _MOST_RECORDS:
        yield (walked := _walk(data, walked.next, end))


def _compression(fields: dict[str, bytes]) -> str:
    return fields.get("compression", b"").decode("latin-1") or _PLAIN


def _at(window: Window) -> str:
    return f"byte {window.place}"
