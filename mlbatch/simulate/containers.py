"""Containers of simulated recordings: pcap, MCAP, SQLite bags of ROS 2.

Layouts: draft-ietf-opsawg-pcap; MCAP specification; db schema 3 of rosbag2
(docs/sources/messages.md, section 5).
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from dpkt.ip import IP, IP_PROTO_UDP
from dpkt.udp import UDP

from mlbatch.ros.definitions import definition, qos
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    import sqlite3

PCAP = ".pcap"
MCAP = ".mcap"
SQLITE = ".db3"
SUFFIXES = (PCAP, MCAP, SQLITE)

_RECEIVER = ipaddress.IPv4Address("10.5.5.1").packed
_FILE_HEADER = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 1)
_RECORD = struct.Struct("<IIII")
_ETHERNET = bytes(12) + b"\x08\x00"
# Rows are committed after so many.
_COMMIT_ROWS = 5000


@cache
def _packed(address: str) -> bytes:
    return ipaddress.IPv4Address(address).packed


class PcapFile:
    """A capture with times in ns; a datagram is one frame of any length, without checksum."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        self._file = path.open("wb")
        self._file.write(_FILE_HEADER)
        self._number = 0

    def packet(self, host_ns: int, address: str, port: int, payload: bytes) -> None:
        """Append a datagram."""
        self._number = (self._number + 1) % 2**16
        size = len(payload) + UDP.__hdr_len__
        datagram = UDP(sport=port, dport=port, ulen=size).pack_hdr() + payload
        # As bytes, since a datagram of dpkt would get a checksum.
        packet = IP(
            src=_packed(address), dst=_RECEIVER, id=self._number, p=IP_PROTO_UDP, data=datagram
        )
        frame = _ETHERNET + bytes(packet)
        second, rest_ns = divmod(host_ns, NS_PER_S)
        self._file.write(_RECORD.pack(second, rest_ns, len(frame), len(frame)))
        self._file.write(frame)

    def close(self) -> None:
        """Complete the file."""
        self._file.close()


class Bag(Protocol):
    """A container of ROS 2 messages."""

    def message(
        self, topic: str, kind: str, host_ns: int, data: bytes, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type."""
        ...

    def close(self) -> None:
        """Complete the file."""
        ...


class McapFile:
    """An MCAP file by the reference library, chunks without compression."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        from mcap.writer import CompressionType, Writer

        self._file = path.open("wb")
        self._writer = Writer(self._file, compression=CompressionType.NONE)
        self._writer.start("ros2", "mlbatch simulate")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sent: dict[str, int] = {}

    def message(
        self, topic: str, kind: str, host_ns: int, data: bytes, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type."""
        if topic not in self._channels:
            if kind not in self._schemas:
                name = kind.replace("/", "/msg/")
                text = definition(kind).encode()
                self._schemas[kind] = self._writer.register_schema(name, "ros2msg", text)
            about = {"offered_qos_profiles": qos(latched)}
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[kind], about
            )
        number = self._sent.get(topic, 0)
        self._sent[topic] = number + 1
        self._writer.add_message(self._channels[topic], host_ns, data, host_ns, number)

    def close(self) -> None:
        """Complete the file."""
        finish: Callable[[], None] = self._writer.finish
        finish()
        self._file.close()


class SqliteFile:
    """One file of a ROS 2 bag, db schema 3."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        import sqlite3

        path.unlink(missing_ok=True)
        self._base: sqlite3.Connection = sqlite3.connect(path)
        for statement in (
            # A killed run leaves a file that is removed anyway.
            "PRAGMA journal_mode = OFF",
            "PRAGMA synchronous = OFF",
            "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)",
            "INSERT INTO schema VALUES (3, 'humble')",
            "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, "
            "metadata TEXT NOT NULL)",
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
            "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)",
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)",
            "CREATE INDEX timestamp_idx ON messages (timestamp ASC)",
        ):
            self._base.execute(statement)
        self._topics: dict[str, int] = {}
        self._rows = 0

    def message(
        self, topic: str, kind: str, host_ns: int, data: bytes, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type."""
        if topic not in self._topics:
            self._topics[topic] = len(self._topics) + 1
            row = (self._topics[topic], topic, kind.replace("/", "/msg/"), "cdr", qos(latched))
            self._base.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
        self._base.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
            (self._topics[topic], host_ns, data),
        )
        self._rows += 1
        if self._rows % _COMMIT_ROWS == 0:
            self._base.commit()

    def close(self) -> None:
        """Complete the file."""
        self._base.commit()
        self._base.close()
