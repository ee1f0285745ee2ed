"""ROS 1 bags from messages, by rosbags; and cut as a crash leaves them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

from tests.builders.bags import Recorded, definition

CHUNK = 5


def definition_of(connection: Connection) -> str:
    """Definition of a type: a text before rosbags 0.10, an object with a text since."""
    text: object = connection.msgdef
    return str(getattr(text, "data", text))


def write_rosbag1(
    path: Path,
    messages: Sequence[Recorded],
    compression: str = "none",
    *,
    chunk_bytes: int = 100_000,
    callers: int = 1,
) -> Path:
    """A bag; callers: publishers that alternate on every topic."""
    writer = Writer(path)
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk_bytes
    connections = {}
    written: dict[str, int] = {}
    with writer:
        for message in messages:
            number = written[message.topic] = written.get(message.topic, -1) + 1
            key = message.topic, number % callers
            if key not in connections:
                package, name = message.type.split("/")
                connections[key] = writer.add_connection(
                    message.topic,
                    f"{package}/msg/{name}",
                    msgdef=definition(message.type, "ros1"),
                    md5sum="0" * 32,
                    callerid=f"/node{key[1]}",
                    latching=1 if message.latched else None,
                )
            writer.write(connections[key], message.log_ns, message.data)
    return path


def without_index(bag: bytes) -> bytes:
    """The bag as it was before it was closed: no index at its end, none named in its header."""
    at = bag.index(b"index_pos=") + len(b"index_pos=")
    (place,) = struct.unpack_from("<Q", bag, at)
    return bag[:at] + bytes(8) + bag[at + 8 : place]


def open_chunk(bag: bytes) -> bytes:
    """As `without_index`, and the last chunk's size was never filled in."""
    bag = without_index(bag)
    at = last_chunk(bag)
    head = struct.unpack_from("<I", bag, at)[0]
    size_at = at + 4 + head
    (size,) = struct.unpack_from("<I", bag, size_at)
    return bag[:size_at] + bytes(4) + bag[size_at + 4 : size_at + 4 + size]


def last_chunk(bag: bytes) -> int:
    """Where the record of the last chunk begins."""
    at = len(b"#ROSBAG V2.0\n")
    found = 0
    while at < len(bag):
        head = struct.unpack_from("<I", bag, at)[0]
        fields = bag[at + 4 : at + 4 + head]
        if b"op=" + bytes([CHUNK]) in fields:
            found = at
        at += 8 + head + struct.unpack_from("<I", bag, at + 4 + head)[0]
    return found
