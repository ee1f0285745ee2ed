"""The MCAP container, held against itself: chunks, indexes, statistics, checksums (mcap.dev/spec).

Chunks are read one at a time; nothing that a length says is believed beyond the file's own size.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mlbatch.verify.encoding import Cursor
from mlbatch.verify.mcap_summary import ChunkPlace, Found, check_summary
from mlbatch.verify.messages import Message
from mlbatch.verify.unpacking import unpacked
from mlbatch.verify.verdict import DamageError, Judge, VerifyError

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_FOOTER_BYTES = _HEAD.size + 20
_HEADER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX = 1, 3, 4, 5, 6, 7
_ATTACHMENT, _METADATA, _DATA_END = 9, 12, 15
# Parts of the data whose damage is told with their place.
_NAMES = {_CHUNK: "chunk", _INDEX: "message index"}
_MESSAGE_HEAD = struct.Struct("<HIQQ")


@dataclass(frozen=True, slots=True)
class _Record:
    opcode: int
    at: int
    length: int

    @property
    def size(self) -> int:
        return _HEAD.size + self.length


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic; type: package/Type."""

    topic: str
    type: str
    encoding: str


class McapFile:
    """An MCAP file; `open` tells what is in it besides chunks, `messages` reads these."""

    def __init__(self, judge: Judge, path: Path, where: str) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.profile = self.library = ""
        self._judge = judge
        self._path = path
        self._where = where
        self._found = Found()
        self._types: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._sent: dict[int, int] = {}
        with path.open("rb") as file:
            self._size = path.stat().st_size
            self._records = self._walk(file)
            for record in self._records:
                self._note(file, record)

    # -- the file's level ---------------------------------------------------------------------

    def _walk(self, file: BinaryIO) -> list[_Record]:
        """All records up to the end of the data."""
        if file.read(len(MAGIC)) != MAGIC:
            raise VerifyError(f"{self._path}: wanted an MCAP file, got another; check the name")
        records: list[_Record] = []
        at = len(MAGIC)
        while not records or records[-1].opcode != _DATA_END:
            file.seek(at)
            head = file.read(_HEAD.size)
            opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
            if not opcode or at + _HEAD.size + length + _FOOTER_BYTES + len(MAGIC) > self._size:
                raise VerifyError(
                    f"{self._path}: wanted a whole MCAP file, got one that ends or is damaged at "
                    f"byte {at}; convert again"
                )
            records.append(_Record(opcode, at, length))
            at += records[-1].size
        return records

    def _note(self, file: BinaryIO, record: _Record) -> None:
        """Keep metadata and attachments."""
        if record.opcode not in (_HEADER, _ATTACHMENT, _METADATA):
            return
        cursor = Cursor(self._body(file, record))
        try:
            if record.opcode == _HEADER:
                self.profile, self.library = cursor.text(), cursor.text()
            elif record.opcode == _METADATA:
                name = cursor.text()
                self.metadata[name] = dict(cursor.part().pairs(_texts))
                self._found.metadata.append((record.at, record.size, name))
            else:
                self._attachment(cursor, record)
        except DamageError as err:
            raise VerifyError(f"{self._path}: byte {record.at}: {err}; convert again") from err

    def _attachment(self, cursor: Cursor, record: _Record) -> None:
        log_ns, create_ns = cursor.whole("Q"), cursor.whole("Q")
        name, media = cursor.text(), cursor.text()
        data = bytes(cursor.raw(cursor.whole("Q")))
        crc = zlib.crc32(cursor.data[: cursor.at])
        self._judge.equal("container", f"{self._where} {name} CRC", crc, cursor.whole("I"))
        self.attachments[name] = data
        row = (record.at, record.size, log_ns, create_ns, len(data), name, media)
        self._found.attachments.append(row)

    def _body(self, file: BinaryIO, record: _Record) -> memoryview:
        file.seek(record.at + _HEAD.size)
        return memoryview(file.read(record.length))

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last log time, once all messages are read."""
        return self._found.first_ns or 0, self._found.last_ns

    # -- messages -----------------------------------------------------------------------------

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file; then the summary is held against them."""
        with self._path.open("rb") as file:
            for record in self._records:
                if record.opcode in (_CHUNK, _DATA_END) and self._found.chunks:
                    self._found.chunks[-1].settle(self._judge, self._where)
                if record.opcode in _NAMES:
                    try:
                        yield from self._part(self._body(file, record), record)
                    except DamageError as err:
                        where = f"{self._where} {_NAMES[record.opcode]} at byte {record.at}"
                        self._judge.blame("container", where, err.wanted, err.got)
                elif record.opcode == _MESSAGE:
                    where = f"{self._where} byte {record.at}"
                    self._judge.blame("container", where, "messages in chunks", "one outside")
            end = self._records[-1]
            file.seek(end.at + end.size)
            summary = file.read()
        self._found.channels = len(self._channels)
        self._found.schemas = len(self._types)
        check_summary(self._judge, self._where, self._found, summary, end.at + end.size)

    def _part(self, body: memoryview, record: _Record) -> Iterator[Message]:
        if record.opcode == _CHUNK:
            yield from self._chunk(body, record)
        else:
            self._found.index(Cursor(body), record.at, record.size)

    def _chunk(self, body: memoryview, record: _Record) -> Iterator[Message]:
        judge, where = self._judge, f"{self._where} chunk at byte {record.at}"
        cursor = Cursor(body)
        first_ns, last_ns, size = cursor.whole("Q"), cursor.whole("Q"), cursor.whole("Q")
        crc, compression = cursor.whole("I"), cursor.text()
        stored = cursor.raw(cursor.whole("Q"))
        cursor.end("a chunk")
        place = ChunkPlace(record.at, record.size, size, compression, len(stored), is_broken=True)
        self._found.chunks.append(place)
        data = unpacked(compression, stored, size)
        place.content = len(data)
        judge.equal("container", f"{where} size", len(data), size)
        if not judge.equal("container", f"{where} CRC", f"{zlib.crc32(data):08x}", f"{crc:08x}"):
            return
        place.is_broken = False
        at = 0
        while at < len(data):
            opcode, length = _HEAD.unpack_from(data, at) if at + 9 <= len(data) else (0, 0)
            begin = at + _HEAD.size
            if begin + length > len(data) or opcode not in (_SCHEMA, _CHANNEL, _MESSAGE):
                raise DamageError("a schema, channel or message", f"opcode {opcode} at {at}")
            inner = data[begin : begin + length]
            if opcode == _MESSAGE:
                yield self._message(inner, place, at)
            else:
                self._describe(opcode, Cursor(inner))
            at = begin + length
        judge.equal("container", f"{where} first and last", place.span_ns, (first_ns, last_ns))

    def _message(self, data: memoryview, place: ChunkPlace, at: int) -> Message:
        if len(data) < _MESSAGE_HEAD.size:
            raise DamageError("a message", f"{len(data)} bytes")
        number, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(data)
        channel = self._channels.get(number)
        if channel is None:
            raise DamageError("a message of a channel before it", f"channel {number}")
        sent = self._sent.get(number, 0)
        where = f"{self._where} {channel.topic} message {sent}"
        self._judge.equal("container", f"{where} sequence", sent, sequence)
        self._sent[number] = sent + 1
        place.add(number, log_ns, at)
        self._found.add(number, log_ns)
        body = data[_MESSAGE_HEAD.size :]
        return Message(
            where, channel.topic, channel.type, channel.encoding, log_ns, publish_ns, body
        )

    def _describe(self, opcode: int, cursor: Cursor) -> None:
        """A schema or channel."""
        number = cursor.whole("H")
        if opcode == _SCHEMA:
            self._types[number] = cursor.text().replace("/msg/", "/")
            return
        kind = self._types.get(cursor.whole("H"), "")
        topic, encoding = cursor.text(), cursor.text()
        self._channels[number] = Channel(topic, kind, encoding)


def _texts(cursor: Cursor) -> tuple[str, str]:
    return cursor.text(), cursor.text()
