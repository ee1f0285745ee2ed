"""Recordings under construction: pcap, MCAP, SQLite bags of ROS 2, ROS 1 bags.

Layouts: draft-ietf-opsawg-pcap; MCAP specification; db schema 3 of rosbag2
(docs/sources/messages.md, section 5); wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import errno
import ipaddress
import struct
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from dpkt import in_cksum
from dpkt.ethernet import ETH_TYPE_IP, ETH_TYPE_IP6, Ethernet
from dpkt.ip import IP, IP_PROTO_UDP
from dpkt.ip6 import IP6
from dpkt.udp import UDP

import mlbatch
from mlbatch.arrays import I64Array, U8Array
from mlbatch.native.capture import CaptureLoops
from mlbatch.ros.definitions import qos, qos_in_numbers
from mlbatch.types import Message, PacketBatch, Topic
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    import sqlite3

PCAP = ".pcap"
MCAP = ".mcap"
SQLITE = ".db3"
ROSBAG1 = ".bag"
# Encodings of messages that a container stores; a capture stores none.
ENCODINGS = {PCAP: (), MCAP: ("cdr", "ros1"), SQLITE: ("cdr",), ROSBAG1: ("ros1",)}
# Of one datagram in a frame: the length of an IP packet has 16 bits.
MOST_UDP_BYTES = 65535 - IP.__hdr_len__ - UDP.__hdr_len__
# Seconds of a record have 32 bits.
MOST_HOST_NS = 2**32 * NS_PER_S

# Destinations, which are not known.
_RECEIVERS = {4: ipaddress.IPv4Address("10.5.5.1").packed, 6: ipaddress.IPv6Address("::1").packed}
_FILE_HEADER = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 1)
_RECORD = np.dtype([(name, "<u4") for name in ("second", "rest_ns", "captured", "original")])
# Rows are committed after so many.
_COMMIT_ROWS = 5000


@lru_cache(maxsize=4096)
def frame_head(address: str, port: int, size: int) -> bytes:
    """Return the headers of the frame of a datagram of `size` bytes, of this source and port.

    Ethernet, IP and UDP without checksum, by dpkt. IPv4: not to be fragmented, so that its
    identification may be 0 (RFC 6864). Source and destination have the same port.
    """
    source = ipaddress.ip_address(address)
    length = size + UDP.__hdr_len__
    udp: bytes = UDP(sport=port, dport=port, ulen=length).pack_hdr()
    ends = {"src": source.packed, "dst": _RECEIVERS[source.version]}
    if source.version == 4:
        # As bytes, since a datagram of dpkt would get a checksum.
        packet = IP(**ends, df=1, p=IP_PROTO_UDP, len=IP.__hdr_len__ + length)
        packet.sum = in_cksum(packet.pack_hdr())
        kind = ETH_TYPE_IP
    else:
        packet = IP6(**ends, nxt=IP_PROTO_UDP, plen=length, hlim=64)
        kind = ETH_TYPE_IP6
    ethernet: bytes = Ethernet(src=bytes(6), dst=bytes(6), type=kind).pack_hdr()
    return ethernet + bytes(packet.pack_hdr()) + udp


class PcapFile:
    """A capture with times in ns; a datagram is one frame of any length."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        self._file = path.open("wb")
        self._file.write(_FILE_HEADER)

    def packet(self, host_ns: int, address: str, port: int, payload: bytes) -> None:
        """Append a datagram."""
        data = np.frombuffer(payload, np.uint8)
        row = np.zeros(1, np.int64)
        batch = PacketBatch(data, row, row + len(payload), row, row + host_ns)
        self.packets(batch, [frame_head(address, port, len(payload))], row)

    def packets(self, batch: PacketBatch, heads: list[bytes], head: I64Array) -> None:
        """Append datagrams in their order; head: (n,) index of the headers of each."""
        lengths = np.array([len(one) for one in heads])[head]
        record = np.zeros(len(batch), _RECORD)
        record["second"], record["rest_ns"] = np.divmod(batch.host_ns, NS_PER_S)
        record["captured"] = record["original"] = lengths + batch.size
        end = np.cumsum(_RECORD.itemsize + lengths + batch.size)
        payload = end - batch.size
        begin = payload - lengths - _RECORD.itemsize
        out: U8Array = np.empty(int(end[-1]) if len(end) else 0, np.uint8)
        out[begin[:, None] + np.arange(_RECORD.itemsize)] = record.view(np.uint8).reshape(
            -1, _RECORD.itemsize
        )
        CaptureLoops().copy_runs(batch.data, batch.start, batch.size, out, payload)
        for number, content in enumerate(heads):
            rows = np.flatnonzero(head == number)
            at = begin[rows, None] + _RECORD.itemsize + np.arange(len(content))
            out[at] = np.frombuffer(content, np.uint8)
            if len(content) > _IPV4_HEAD_BYTES:
                _add_checksums(out, payload[rows], batch.size[rows])
        self._file.write(out.data)

    def close(self) -> None:
        """Complete the file."""
        self._file.close()


_IPV4_HEAD_BYTES = Ethernet.__hdr_len__ + IP.__hdr_len__ + UDP.__hdr_len__
_ADDRESSES_BYTES = 32
_CHECKSUM_AT = 6


def _add_checksums(out: U8Array, payload: I64Array, size: I64Array) -> None:
    """Fill in the UDP checksums of IPv6, where they are not optional (RFC 8200 section 8.1)."""
    for begin, count in zip(payload.tolist(), size.tolist(), strict=True):
        udp = begin - UDP.__hdr_len__
        length = UDP.__hdr_len__ + count
        pseudo = out[udp - _ADDRESSES_BYTES : udp].tobytes() + struct.pack(
            ">II", length, IP_PROTO_UDP
        )
        checksum = in_cksum(pseudo + out[udp : begin + count].tobytes()) or 0xFFFF
        out[udp + _CHECKSUM_AT : begin] = np.frombuffer(struct.pack(">H", checksum), np.uint8)


class Bag(Protocol):
    """A container of messages."""

    def forward(self, message: Message) -> None:
        """Append a message; the first one creates its topic."""
        ...

    def close(self) -> None:
        """Complete the file."""
        ...


def new_bag(path: Path, suffix: str) -> Bag:
    """Create a container of messages; suffix: of its final name."""
    if suffix == ROSBAG1:
        # Not loaded for other containers.
        from mlbatch.writers.rosbag1_container import Rosbag1Container

        return Rosbag1Container(path)
    return McapFile(path) if suffix == MCAP else SqliteFile(path)


class McapFile:
    """An MCAP file, chunks without compression."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        # Not loaded for captures.
        from mlbatch.writers.mcap_container import McapContainer

        self._container = McapContainer(path, library=f"mlbatch extract {mlbatch.__version__}")

    def forward(self, message: Message) -> None:
        """Append a message; the first one creates its topic."""
        self._container.forward(message)
        for chunk in self._container.take_chunks():
            chunk.compress()
            chunk.write()

    def close(self) -> None:
        """Complete the file."""
        self._container.close()


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
        self._topics: dict[Topic, int] = {}
        self._rows = 0

    def forward(self, message: Message) -> None:
        """Append a message; the first one creates its topic."""
        topic = message.topic
        if topic not in self._topics:
            self._topics[topic] = len(self._topics) + 1
            kind = topic.type.replace("/", "/msg/")
            profiles = qos_in_numbers(topic.qos) or qos(topic.latched)
            row = (self._topics[topic], topic.name, kind, topic.encoding, profiles)
            self._do("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
        self._do(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
            (self._topics[topic], message.host_ns, message.data),
        )
        self._rows += 1
        if self._rows % _COMMIT_ROWS == 0:
            self._do("COMMIT")

    def close(self) -> None:
        """Complete the file."""
        if self._base.in_transaction:
            self._do("COMMIT")
        self._base.close()

    def _do(self, statement: str, values: tuple[object, ...] = ()) -> None:
        """Execute a statement; OSError where the file cannot be written."""
        import sqlite3

        try:
            self._base.execute(statement, values)
        except sqlite3.OperationalError as err:
            raise OSError(errno.EIO, str(err)) from err
