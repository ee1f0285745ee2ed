"""ROS 1 bags: chunks checked against the indexes; there are no checksums.

`rosbags` parses the records. Source: wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import SEEK_CUR
from pathlib import Path
from typing import TypeAlias

from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Header, RecordType, read_uint32

from mlbatch.outputs.containers import (
    BoundedFile,
    Message,
    MessagePlace,
    WholeReads,
    library_errors,
)
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError

BAG_MAGIC = b"#ROSBAG V2.0\n"
LIMITS = {"container": "lengths and indexes; bags have no checksums"}
# Time and offset of each message, by connection.
Index: TypeAlias = dict[int, list[tuple[int, int]]]


@dataclass(frozen=True, slots=True)
class _Chunk:
    """A chunk record, and offset and size of its data."""

    header: Header
    at: int
    size: int


class BagFile:
    """A ROS 1 bag of mlbatch. It has no metadata: report and table are separate files."""

    def __init__(self, log: CheckLog, path: Path, where: str) -> None:
        self._log = log
        self._path = path
        self._where = where
        self._counts: Counter[str] = Counter()
        self._types: dict[str, str] = {}

    def messages(self) -> Iterator[Message]:
        """All messages in the order of the file; each chunk is checked against the index."""
        try:
            with BoundedFile(self._path) as file:
                chunks = self._chunks(file)
                reader = Reader(self._path)
                with library_errors("the index of a bag"):
                    reader.open()
                try:
                    yield from self._messages(file, chunks, reader)
                finally:
                    reader.close()
        except DamageError as err:
            raise VerifyError(f"{self._path}: {err}; convert again") from err

    def places(self, topics: Collection[str]) -> list[MessagePlace]:
        """Where the messages of topics are, in the order of the file, by its index."""
        with BoundedFile(self._path) as file:
            chunks = self._chunks(file)
        reader = Reader(self._path)
        with library_errors("the index of a bag"):
            reader.open()
        self._types = {one.topic: one.msgtype.replace("/msg/", "/") for one in reader.connections}
        entries = [
            (chunk, offset, time_ns, one.topic)
            for one in reader.connections
            if one.topic in topics
            for time_ns, chunk, offset in reader.indexes.get(one.id, ())
        ]
        # Forgets all.
        reader.close()
        found: list[MessagePlace] = []
        counts: Counter[str] = Counter()
        for at, offset, time_ns, topic in sorted(entries):
            chunk = chunks[at]
            place = MessagePlace(topic, counts[topic], time_ns, chunk.at, chunk.size, offset)
            found.append(place)
            counts[topic] += 1
        return found

    def message_at(self, log: CheckLog, place: MessagePlace) -> Message:
        """One message; DamageError if there is none."""
        where = f"{self._where} {place.topic} message {place.number}"
        with BoundedFile(self._path) as file, library_errors(f"{where} at its place"):
            file.seek(place.chunk + place.offset)
            header = Header.read(file)
            kind, log_ns = header.get_uint8("op"), header.get_time("time")
            data = file.read(read_uint32(file))
            is_inside = file.tell() <= place.chunk + place.chunk_bytes
        if (kind, log_ns, is_inside) != (RecordType.MSGDATA, place.log_ns, True):
            raise DamageError(f"{where}, as by the index", "another record")
        kind_of_message = self._types[place.topic]
        return Message(where, place.topic, kind_of_message, "ros1", log_ns, log_ns, data)

    def _chunks(self, file: BoundedFile) -> dict[int, _Chunk]:
        """All chunks by position; the records of the bag and its index are checked against them."""
        chunks: dict[int, _Chunk] = {}
        # Positions of chunks by the index at the end.
        indexed: list[int] = []
        kinds: Counter[int] = Counter()
        index_at = 0
        first_index_at = file.size
        counts = (0, 0)
        file.seek(len(BAG_MAGIC))
        while (at := file.tell()) < file.size:
            with library_errors(f"a record at byte {at}"):
                header = Header.read(file)
                kind = header.get_uint8("op")
                size = read_uint32(file)
                data_at = file.tell()
                if size > file.size - data_at:
                    raise DamageError(f"{size} bytes at byte {data_at}", "the end of the file")
                if not kinds:
                    allowed = {RecordType.BAGHEADER}
                    index_at = header.get_uint64("index_pos")
                    counts = (header.get_uint32("conn_count"), header.get_uint32("chunk_count"))
                elif at < index_at:
                    allowed = {RecordType.CHUNK, RecordType.IDXDATA}
                else:
                    allowed = {RecordType.CONNECTION, RecordType.CHUNK_INFO}
                    first_index_at = min(first_index_at, at)
                if kind not in allowed:
                    names = " or ".join(record.name for record in sorted(allowed))
                    raise DamageError(f"a record {names} at byte {at}", f"type {kind}")
                if kind == RecordType.CHUNK:
                    chunks[at] = _Chunk(header, data_at, size)
                elif kind == RecordType.CHUNK_INFO:
                    indexed.append(header.get_uint64("chunk_pos"))
            kinds[kind] += 1
            file.seek(size, SEEK_CUR)
        if index_at != first_index_at:
            raise DamageError(f"an index at byte {first_index_at}", f"byte {index_at}")
        found = (kinds[RecordType.CONNECTION], len(indexed))
        # The library reads as many records as the counts say, and nothing after them.
        if counts != found:
            raise DamageError(
                f"{counts[0]} connections, {counts[1]} chunks in the index", f"{found}"
            )
        self._log.ok("container")
        # The library follows these positions without a check.
        if indexed != list(chunks):
            raise DamageError(f"chunks at {list(chunks)} in the index", f"{indexed}")
        return chunks

    def _messages(
        self, file: BoundedFile, chunks: dict[int, _Chunk], reader: Reader
    ) -> Iterator[Message]:
        log = self._log
        indexes: dict[int, Index] = {}
        for number, entries in reader.indexes.items():
            for time_ns, chunk_at, offset in entries:
                own = indexes.setdefault(chunk_at, {})
                own.setdefault(number, []).append((time_ns, offset))
        topics = {
            connection.id: (connection.topic, connection.msgtype.replace("/msg/", "/"))
            for connection in reader.connections
        }
        seen: set[int] = set()
        # Position, first and last log time, message counts of each chunk: found, and by the index.
        infos: list[tuple[int, int, int, dict[int, int]]] = []
        indexed_infos: list[tuple[int, int, int, dict[int, int]]] = []
        for info in reader.chunk_infos:
            chunk = chunks[info.pos]
            where = f"{self._where} chunk at byte {info.pos}"
            compression = chunk.header.get("compression", b"").decode("ascii", "replace")
            if compression != "none":
                raise DamageError("a chunk without compression, as mlbatch writes it", compression)
            with library_errors("a chunk with its size"):
                size = chunk.header.get_uint32("size")
                log.equal("container", f"{where} size", chunk.size, size)
            file.seek(chunk.at)
            data = file.read(chunk.size)
            found: Index = {}
            for offset, number, message in self._in_chunk(data, topics, seen):
                found.setdefault(number, []).append((message.log_ns, offset))
                yield message
            # `rosbags` sorts entries by time.
            found = {number: sorted(entries) for number, entries in found.items()}
            index = {number: sorted(own) for number, own in indexes.pop(info.pos, {}).items()}
            name = f"{self._where} index of the chunk at byte {info.pos}"
            log.equal("container", name, found, index)
            times_ns = [time_ns for entries in found.values() for time_ns, _ in entries]
            counts = {number: len(entries) for number, entries in found.items()}
            first_ns = min(times_ns, default=2**63 - 1)
            infos.append((info.pos, first_ns, max(times_ns, default=-1), counts))
            # The library adds 1 to the end.
            last_ns = info.end_time - 1
            indexed_counts = dict(info.connection_counts)
            indexed_infos.append((info.pos, info.start_time, last_ns, indexed_counts))
        log.equal("container", f"{self._where} chunks in the index", infos, indexed_infos)
        log.equal("container", f"{self._where} connections in the index", set(topics), seen)

    def _in_chunk(
        self, data: bytes, topics: dict[int, tuple[str, str]], seen: set[int]
    ) -> Iterator[tuple[int, int, Message]]:
        """Offset, connection and message of each message of a chunk; `seen` gets connections."""
        view = memoryview(data)
        stream = WholeReads(data)
        while (offset := stream.tell()) < len(data):
            with library_errors(f"a record at offset {offset} of a chunk"):
                header = Header.read(stream)
                kind = header.get_uint8("op")
                number = header.get_uint32("conn")
                size = read_uint32(stream)
                begin = stream.tell()
                content = view[begin : begin + size]
                if len(content) != size:
                    raise DamageError(f"{size} bytes at offset {begin}", f"{len(content)}")
                stream.seek(size, SEEK_CUR)
                topic, msgtype = topics.get(number, ("", ""))
                if kind == RecordType.CONNECTION:
                    # The data are another header.
                    about = Header.read(WholeReads(struct.pack("<I", size) + content))
                    said = (header.get_string("topic"), about.get_string("type"))
                    if said != (topic, msgtype):
                        raise DamageError(f"{topic!r} of {msgtype!r}", str(said))
                    seen.add(number)
                    continue
                if kind != RecordType.MSGDATA or number not in seen:
                    raise DamageError("a connection or a message of one", f"type {kind}")
                log_ns = header.get_time("time")
            where = f"{self._where} {topic} message {self._counts[topic]}"
            self._counts[topic] += 1
            yield offset, number, Message(where, topic, msgtype, "ros1", log_ns, log_ns, content)
