"""Outputs with messages for tests: recorded messages, written outputs, and their readers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from mlbatch.types import Message, Scan, Topic
from mlbatch.writers import open_writer
from mlbatch.writers.base import WriterOptions
from tests.builders.scans import PERIOD_NS, START_NS, SUMMARY, imu_samples, run_job

QOS_WORDS = """\
- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""
ROS2_NOTE = Topic(
    "/note", "std_msgs/String", "cdr", "string data\n", "ros2msg", QOS_WORDS, latched=True
)
ROS1_NOTE = Topic("/note", "std_msgs/String", "ros1", "string data\n", "ros1msg", latched=True)
# A type that is in no table, with a field of another such type.
ODD_TEXT = (
    "# Ours.\nuint8 FULL=3\nmy_msgs/Part[] parts\n" + "=" * 80 + "\nMSG: my_msgs/Part\nint8 x\n"
)
ROS1_ODD = Topic("/odd", "my_msgs/Odd", "ros1", ODD_TEXT, "ros1msg")
ROS2_ODD = Topic("/odd", "my_msgs/Odd", "cdr", ODD_TEXT, "ros2msg")


def note(topic: Topic, text: str, after_ns: int) -> Message:
    """Return a std_msgs/String in the encoding of its topic."""
    data = text.encode()
    if topic.encoding == "ros1":
        body = struct.pack("<I", len(data)) + data
    else:
        body = b"\0\1\0\0" + struct.pack("<I", len(data) + 1) + data + b"\0"
    return Message(topic, START_NS + after_ns, body)


def odd(topic: Topic, *values: int, after_ns: int) -> Message:
    """Return a message of the type that is in no table."""
    body = struct.pack(f"<I{len(values)}b", len(values), *values)
    return Message(
        topic, START_NS + after_ns, body if topic.encoding == "ros1" else b"\0\1\0\0" + body
    )


def written(
    name: str,
    target: Path,
    scans: Sequence[Scan],
    messages: Sequence[Message] = (),
    *,
    layout: str = "standard",
    split: bool = False,
) -> Path:
    """Write IMU samples, the first message, scans, the other messages and more samples.

    split: scans are of sensor 0, 1, ...
    """
    writer = open_writer(name, target, scans[0].info, WriterOptions(layout, split=split))
    writer.write_imu(imu_samples())
    for message in messages[:1]:
        writer.write_message(message)
    for number, scan in enumerate(scans):
        run_job(writer.write(scan, number if split else None))
    for message in messages[1:]:
        writer.write_message(message)
    writer.write_imu(imu_samples(1, START_NS + PERIOD_NS // 2, 1))
    writer.finish(SUMMARY)
    return target


@dataclass(frozen=True, slots=True)
class Read:
    """A message as a library decodes it."""

    topic: str
    type: str
    log_ns: int
    raw: bytes
    value: Any


def read_back(path: Path) -> list[Read]:
    """Return all messages by log time: bags by rosbags, MCAP by mcap and mcap-ros2-support."""
    if path.suffix == ".mcap":
        decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[decoder])
            return [
                Read(c.topic, schema.name, m.log_time, m.data, value)
                for schema, c, m, value in reader.iter_decoded_messages()
                if schema is not None
            ]
    highlevel = pytest.importorskip("rosbags.highlevel")
    with highlevel.AnyReader([path]) as reader:
        return [
            Read(c.topic, c.msgtype, log_ns, bytes(raw), reader.deserialize(raw, c.msgtype))
            for c, log_ns, raw in reader.messages()
        ]
