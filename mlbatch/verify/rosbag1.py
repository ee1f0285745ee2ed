"""The container of ROS 1 bags, held against itself (wiki.ros.org/Bags/Format/2.0).

A bag has no checksums and no place for what tells of the run: report and table lie beside it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mlbatch.verify.messages import Message
from mlbatch.verify.verdict import DamageError, Judge, VerifyError

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32 = struct.Struct("<I")
_ENTRY = struct.Struct("<III")
_PAIR = struct.Struct("<II")
_LONGEST_HEADER = 1 << 20
_NS = 10**9

LIMITS = {"container": "lengths and indexes; bags have no checksums"}


@dataclass(frozen=True, slots=True)
class _Record:
    """Fields of a record's header; its data lie at `at`, `length` bytes."""

    fields: dict[str, bytes]
    start: int
    at: int
    length: int

    @property
    def op(self) -> int:
        return self.fields.get("op", b"\0")[0]

    @property
    def end(self) -> int:
        return self.at + self.length

    def number(self, name: str) -> int:
        if name not in self.fields:
            raise DamageError(f"field {name}", ", ".join(self.fields))
        return int.from_bytes(self.fields[name], "little")

    def time_ns(self, name: str) -> int:
        word = self.number(name)
        return (word & 0xFFFFFFFF) * _NS + (word >> 32)


@dataclass(slots=True)
class _Chunk:
    """Messages of a chunk by connection, (time, offset)."""

    start: int
    messages: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    indexes: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    @property
    def info(self) -> tuple[int, int, int, dict[int, int]]:
        """What the bag's index should say of it."""
        times = [time for found in self.messages.values() for time, _ in found]
        counts = {number: len(found) for number, found in self.messages.items()}
        return self.start, min(times, default=0), max(times, default=0), counts


class BagFile:
    """A ROS 1 bag; `messages` reads it once from start to end."""

    def __init__(self, judge: Judge, path: Path, where: str) -> None:
        self._judge = judge
        self._path = path
        self._where = where
        self._size = path.stat().st_size
        self._topics: dict[int, tuple[str, str]] = {}
        self._sent: dict[str, int] = {}
        self._chunks: list[_Chunk] = []

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file; then the index is held against them."""
        with self._path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise VerifyError(f"{self._path}: wanted a ROS 1 bag, got another; check the name")
            at = len(MAGIC)
            try:
                head = self._read(file, at)
                index_at = head.number("index_pos")
                if head.op != _BAG or not at < index_at <= self._size:
                    raise DamageError("a bag with an index", f"one at byte {index_at}")
                at = head.end
                while at < index_at:
                    record = self._read(file, at)
                    yield from self._take(file, record)
                    at = record.end
                self._check_index(file, head, at)
            except DamageError as err:
                raise VerifyError(
                    f"{self._path}: damaged at byte {at}: {err}; convert again"
                ) from err

    def _read(self, file: BinaryIO, at: int) -> _Record:
        """The record at a place; its data are not read."""
        file.seek(at)
        size = self._length(file, at)
        if size > _LONGEST_HEADER:
            raise DamageError("a header", f"one of {size} bytes")
        fields = _fields(file.read(size))
        data_at = at + 2 * _U32.size + size
        length = self._length(file, at)
        if data_at + length > self._size:
            raise DamageError(f"{length} bytes", f"{self._size - data_at} to the end of the file")
        return _Record(fields, at, data_at, length)

    def _length(self, file: BinaryIO, at: int) -> int:
        word = file.read(_U32.size)
        if len(word) < _U32.size:
            raise DamageError("a record", f"the end of the file at byte {at}")
        length: int = _U32.unpack(word)[0]
        return length

    def _data(self, file: BinaryIO, record: _Record) -> bytes:
        file.seek(record.at)
        return file.read(record.length)

    def _take(self, file: BinaryIO, record: _Record) -> Iterator[Message]:
        """A chunk or the index of one."""
        if record.op == _CHUNK:
            kind = record.fields.get("compression", b"").decode("ascii", "replace")
            if kind != "none":
                raise DamageError("a chunk without compression, as mlbatch writes them", kind)
            where = f"{self._where} chunk at byte {record.start} size"
            self._judge.equal("container", where, record.length, record.number("size"))
            yield from self._chunk(self._data(file, record), _Chunk(record.start))
        elif record.op == _INDEX and self._chunks:
            data = self._data(file, record)
            entries = [(s * _NS + ns, at) for s, ns, at in _ENTRY.iter_unpack(_cut(data, _ENTRY))]
            self._chunks[-1].indexes[record.number("conn")] = entries
        else:
            raise DamageError("a chunk or its index", f"a record of kind {record.op}")

    def _chunk(self, data: bytes, chunk: _Chunk) -> Iterator[Message]:
        self._chunks.append(chunk)
        view, at = memoryview(data), 0
        while at < len(view):
            record = _inner(view, at)
            number = record.number("conn")
            if record.op == _CONNECTION:
                about = _fields(bytes(view[record.at : record.end]))
                kind = about.get("type", b"").decode("utf-8", "replace")
                topic = record.fields.get("topic", b"").decode("utf-8", "replace")
                self._topics[number] = (topic, kind)
            elif record.op == _MESSAGE and number in self._topics:
                topic, kind = self._topics[number]
                log_ns = record.time_ns("time")
                chunk.messages.setdefault(number, []).append((log_ns, at))
                sent = self._sent[topic] = self._sent.get(topic, -1) + 1
                where = f"{self._where} {topic} message {sent}"
                content = view[record.at : record.end]
                yield Message(where, topic, kind, "ros1", log_ns, log_ns, content)
            else:
                raise DamageError("a connection or a message of one", f"kind {record.op}")
            at = record.end

    def _check_index(self, file: BinaryIO, head: _Record, at: int) -> None:
        """The index at the end against what was read."""
        judge, where = self._judge, self._where
        for chunk in self._chunks:
            name = f"{where} index of the chunk at byte {chunk.start}"
            judge.equal("container", name, chunk.messages, chunk.indexes)
        topics: dict[int, str] = {}
        infos = []
        while at < self._size:
            record = self._read(file, at)
            if record.op == _CONNECTION:
                name = record.fields.get("topic", b"").decode("utf-8", "replace")
                topics[record.number("conn")] = name
            elif record.op == _CHUNK_INFO:
                counts = dict(_PAIR.iter_unpack(_cut(self._data(file, record), _PAIR)))
                times = record.time_ns("start_time"), record.time_ns("end_time")
                infos.append((record.number("chunk_pos"), *times, counts))
            else:
                raise DamageError("a record of the index", f"kind {record.op}")
            at = record.end
        wanted = [chunk.info for chunk in self._chunks]
        judge.equal("container", f"{where} chunks in the index", wanted, infos)
        names = {number: topic for number, (topic, _) in self._topics.items()}
        judge.equal("container", f"{where} connections in the index", names, topics)
        said = (head.number("conn_count"), head.number("chunk_count"))
        counts_met = (len(self._topics), len(self._chunks))
        judge.equal("container", f"{where} connections and chunks", counts_met, said)


def _cut(data: bytes, entry: struct.Struct) -> bytes:
    if len(data) % entry.size:
        raise DamageError(f"entries of {entry.size} bytes", f"{len(data)} bytes")
    return data


def _inner(view: memoryview, at: int) -> _Record:
    """A record inside a chunk."""
    if at + _U32.size > len(view):
        raise DamageError("a record", f"{len(view) - at} bytes")
    head_at = at + _U32.size
    head_end = head_at + _U32.unpack_from(view, at)[0]
    if head_end + _U32.size > len(view):
        raise DamageError("a record inside its chunk", f"one up to byte {head_end}")
    data_at = head_end + _U32.size
    record = _Record(
        _fields(bytes(view[head_at:head_end])), at, data_at, _U32.unpack_from(view, head_end)[0]
    )
    if record.end > len(view):
        raise DamageError("a record inside its chunk", f"one up to byte {record.end}")
    return record


def _fields(data: bytes) -> dict[str, bytes]:
    """Fields of a header: each with its length, as name=value."""
    found, at = {}, 0
    while at < len(data):
        if at + _U32.size > len(data):
            raise DamageError("a field", f"{len(data) - at} bytes")
        end = at + _U32.size + _U32.unpack_from(data, at)[0]
        name, equals, value = data[at + _U32.size : end].partition(b"=")
        if end > len(data) or not equals:
            raise DamageError("a field name=value", repr(name[:40]))
        found[name.decode("latin-1")] = value
        at = end
    return found
