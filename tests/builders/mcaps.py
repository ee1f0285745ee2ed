"""MCAP files from values, by the reference library: ROS 2 and ROS 1, chunks of every kind.

Source: MCAP specification (mcap.dev/spec); message types of docs/sources/messages.md, section 1.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from mcap.writer import CompressionType, IndexType, Writer

from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.make_fixtures import FOLDER

NONE = CompressionType.NONE
LZ4 = CompressionType.LZ4
ZSTD = CompressionType.ZSTD
OUSTER = "ouster_sensor_msgs/PacketMsg"
OUSTER_ROS1 = "ouster_ros/PacketMsg"
DEFINITIONS = {
    OUSTER: "uint8[] buf\n",
    OUSTER_ROS1: "uint8[] buf\n",
    "std_msgs/String": "string data\n",
    "sensor_msgs/Image": "uint8[] data\n",
}
CDR_HEAD = b"\x00\x01\x00\x00"
# Topics of the fixture's datagrams, by the sender's last number and the port.
NAMES = {"10.5.5.87": "left", "10.5.5.88": "right"}
TAILS = {7502: "lidar_packets", 7503: "imu_packets"}


@dataclass(frozen=True, slots=True)
class Sent:
    """A message as it was recorded; type: package/Type."""

    topic: str
    type: str
    log_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Form:
    """How a file is made; ros: 1 or 2; summary: False omits all sections after the data.

    repeat: schemas and channels that the summary names as well.
    """

    compression: CompressionType = NONE
    chunked: bool = True
    ros: int = 2
    chunk_bytes: int = 200_000
    summary: bool = True
    repeat: bool = True
    index: IndexType = IndexType.ALL
    qos: dict[str, str] = field(default_factory=dict)


FORMS = {
    "none": Form(),
    "lz4": Form(LZ4),
    "zstd": Form(ZSTD),
    "unchunked": Form(chunked=False),
    "no summary": Form(summary=False),
    "no summary, zstd": Form(ZSTD, summary=False),
    "no index": Form(index=IndexType.NONE, repeat=False),
    "ROS 1": Form(ros=1),
    "ROS 1, lz4": Form(LZ4, ros=1),
}


def packet_message(payload: bytes, ros: int = 2) -> bytes:
    """The message of an Ouster driver around a packet."""
    body = struct.pack("<I", len(payload)) + payload
    return body if ros == 1 else CDR_HEAD + body


def text_message(text: str, ros: int = 2) -> bytes:
    """A std_msgs/String."""
    data = text.encode()
    if ros == 1:
        return struct.pack("<I", len(data)) + data
    return CDR_HEAD + struct.pack("<I", len(data) + 1) + data + b"\0"


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet of the fixture with two lidars; topic: where a driver would publish it."""

    topic: str
    host_ns: int
    payload: bytes


@lru_cache(maxsize=1)
def fixture_packets() -> tuple[Packet, ...]:
    """Lidar and IMU packets of the fixture's pcap, in the order of their receive times."""
    streams = StreamTable()
    found = []
    for batch in open_recording(FOLDER / "two_lidars.pcap", streams).packets():
        for at in range(len(batch)):
            stream = streams.streams[int(batch.stream[at])]
            begin = int(batch.start[at])
            size = int(batch.size[at])
            if stream.source_ip in NAMES:
                topic = f"/{NAMES[stream.source_ip]}/{TAILS[stream.port]}"
                payload = batch.data[begin : begin + size].tobytes()
                found.append(Packet(topic, int(batch.host_ns[at]), payload))
    return tuple(found)


def packet_messages(packets: Iterable[Packet], ros: int = 2) -> list[Sent]:
    """Packets as an Ouster driver publishes them."""
    kind = OUSTER if ros == 2 else OUSTER_ROS1
    return [Sent(p.topic, kind, p.host_ns, packet_message(p.payload, ros)) for p in packets]


def write_mcap(path: Path, sent: Sequence[Sent], form: Form | None = None) -> Path:
    """Write messages in the order given."""
    form = form or Form()
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=form.chunk_bytes,
            compression=form.compression,
            use_chunking=form.chunked,
            index_types=form.index,
            repeat_channels=form.repeat,
            repeat_schemas=form.repeat,
        )
        writer.start(f"ros{form.ros}")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for number, message in enumerate(sent):
            if message.type not in schemas:
                schemas[message.type] = _schema(writer, message.type, form.ros)
            if message.topic not in channels:
                channels[message.topic] = writer.register_channel(
                    message.topic,
                    "cdr" if form.ros == 2 else "ros1",
                    schemas[message.type],
                    form.qos,
                )
            writer.add_message(
                channels[message.topic], message.log_ns, message.data, message.log_ns, number
            )
        end: Callable[[], None] = writer.finish
        end()
    if not form.summary:
        os.truncate(path, _data_end(path.read_bytes()))
    return path


def _data_end(data: bytes) -> int:
    """Where the last record before the end of the data ends."""
    at = 8
    while data[at] != 0x0F:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


def _schema(writer: Writer, kind: str, ros: int) -> int:
    name = kind.replace("/", "/msg/") if ros == 2 else kind
    number: int = writer.register_schema(name, f"ros{ros}msg", DEFINITIONS[kind].encode())
    return number
