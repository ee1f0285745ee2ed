"""A standard recording in other containers, and the CPU time of reading any of them.

    python -m tests.bench.containers write FOLDER/capture.pcap FOLDER/capture.mcap
    python -m tests.bench.containers read FOLDER/capture.mcap

The forms are the defaults of recording tools: MCAP in chunks without compression, db3 with schema 3
(docs/sources/messages.md section 5).
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from mcap.writer import CompressionType, Writer

from mlbatch.readers import open_recording
from mlbatch.types import StreamTable

TYPE: Final = "ouster_sensor_msgs/msg/PacketMsg"
CHUNK_BYTES: Final = 786_432
CDR_HEADER: Final = b"\x00\x01\x00\x00"
Messages = Iterator[tuple[str, int, bytes]]


def messages(pcap: Path) -> Messages:
    """(topic, log time in ns, message) of every packet."""
    table = StreamTable()
    for batch in open_recording(pcap, table).packets():
        columns = (batch.start, batch.size, batch.stream, batch.host_ns)
        for start, size, number, host_ns in zip(*(c.tolist() for c in columns), strict=True):
            topic = f"/port_{table.streams[number].port}/lidar_packets"
            payload = batch.data[start : start + size].tobytes()
            yield topic, host_ns, CDR_HEADER + size.to_bytes(4, "little") + payload


def write_mcap(path: Path, sent: Messages) -> None:
    """Write chunks without compression."""
    with path.open("wb") as file:
        writer = Writer(file, CHUNK_BYTES, compression=CompressionType.NONE, enable_crcs=False)
        writer.start("ros2")
        schema = writer.register_schema(TYPE, "ros2msg", b"uint8[] buf\n")
        channels: dict[str, int] = {}
        for topic, log_ns, data in sent:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], log_ns, data, log_ns)
        finish: Callable[[], None] = writer.finish
        finish()


def write_db3(path: Path, sent: Messages) -> None:
    """Write the tables of schema 3."""
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = OFF")
        connection.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
            "serialization_format TEXT, offered_qos_profiles TEXT)"
        )
        connection.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
            "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        connection.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
        numbers: dict[str, int] = {}
        for topic, log_ns, data in sent:
            if topic not in numbers:
                numbers[topic] = len(numbers) + 1
                row = (numbers[topic], topic, TYPE)
                connection.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", row)
            connection.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                (numbers[topic], log_ns, data),
            )
    connection.close()


WRITERS: Final[Mapping[str, Callable[[Path, Messages], None]]] = {
    ".mcap": write_mcap,
    ".db3": write_db3,
}


def write(pcap: Path, target: Path) -> None:
    """Write the packets to a container chosen by the suffix; it appears when complete."""
    partial = target.with_name(target.name + ".partial")
    partial.unlink(missing_ok=True)
    WRITERS[target.suffix](partial, messages(pcap))
    partial.replace(target)


def read(path: Path) -> dict[str, float]:
    """Number of packets, their bytes, and the CPU time of one pass over them, after opening."""
    recording = open_recording(path, StreamTable())
    began_s = time.process_time()
    packets = 0
    size = 0
    for batch in recording.packets():
        packets += len(batch)
        size += int(batch.size.sum())
    return {"packets": packets, "bytes": size, "cpu_s": time.process_time() - began_s}


def main() -> None:
    """Write or read."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.containers")
    parser.add_argument("work", choices=("write", "read"))
    parser.add_argument("paths", type=Path, nargs="+")
    options = parser.parse_args()
    if options.work == "write":
        write(*options.paths)
    else:
        print(json.dumps(read(*options.paths)))


if __name__ == "__main__":
    main()
