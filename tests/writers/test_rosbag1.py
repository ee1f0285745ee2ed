"""ROS 1 bags: one message by hand, connections, forwarded messages."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from mlbatch.errors import ExportError
from mlbatch.types import Message
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.rosbag1 import definition_of
from tests.builders.scans import (
    PERIOD_NS,
    START_NS,
    SUMMARY,
    dense_scan,
    point_scan,
    run_info,
    run_job,
)
from tests.builders.written_bags import (
    ODD_TEXT,
    ROS1_NOTE,
    ROS1_ODD,
    ROS2_NOTE,
    note,
    odd,
    written,
)

SCANS = [dense_scan(0), dense_scan(1, 30)]
MESSAGES = [
    note(ROS1_NOTE, "first", -7),
    odd(ROS1_ODD, 1, -2, after_ns=3),
    note(ROS1_NOTE, "last", 3 * PERIOD_NS),
]
# From the message pages of docs.ros.org (noetic).
MD5 = {
    "/points": "1158d486dd51d683ce2f1be655c3c181",
    "/left/imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "/right/imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "/tf_static": "94810edda583a504dfda3829e70d7eec",
    "/note": "992ce8a1687cec8c8bd883ec73ca41d1",
}


def test_one_message_by_hand(tmp_path: Path) -> None:
    found = read_raw(written("rosbag1", tmp_path / "out.bag", [point_scan()]))
    [data] = [data for topic, data in found if topic == "/points"]

    def field(name: str, offset: int, code: int) -> bytes:
        text = name.encode()
        return struct.pack("<I", len(text)) + text + struct.pack("<IBI", offset, code, 1)

    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7)]
    fields += [("ring", 20, 4), ("return_type", 22, 2), ("lidar_id", 23, 2)]
    expected = struct.pack("<III", 0, 1_700_000_000, 100_000_000)
    expected += struct.pack("<I9s", 9, b"base_link") + struct.pack("<III", 1, 1, 8)
    expected += b"".join(field(*row) for row in fields)
    expected += struct.pack("<BIII", 0, 24, 24, 24)
    expected += struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1) + b"\1"
    assert data == expected


def read_raw(path: Path) -> list[tuple[str, bytes]]:
    """Topic and bytes of every message, by log time."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    with rosbag1.Reader(path) as reader:
        return [(connection.topic, bytes(raw)) for connection, _, raw in reader.messages()]


def test_connections_are_what_ros_1_expects(tmp_path: Path) -> None:
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    path = written("rosbag1", tmp_path / "out.bag", SCANS, MESSAGES)
    assert path.read_bytes().startswith(b"#ROSBAG V2.0\n")
    with rosbag1.Reader(path) as reader:
        connections = {c.topic: c for c in reader.connections}
        assert reader.message_count == 9
    assert {t: c.digest for t, c in connections.items() if t in MD5} == MD5
    latched = {t for t, c in connections.items() if c.ext.latching}
    assert latched == {"/tf_static", "/note"}
    assert definition_of(connections["/points"]).count("=" * 80) == 2
    assert definition_of(connections["/odd"]) == ODD_TEXT
    assert b"type=sensor_msgs/PointCloud2" in path.read_bytes()


def test_a_type_without_fields(tmp_path: Path) -> None:
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    topic = ROS1_NOTE._replace(type="std_msgs/Empty", definition="")
    message = Message(topic, START_NS, b"")
    path = written("rosbag1", tmp_path / "out.bag", SCANS[:1], [message])
    with rosbag1.Reader(path) as reader:
        [connection] = [c for c in reader.connections if c.topic == "/note"]
    # MD5 of no text at all.
    assert connection.digest == "d41d8cd98f00b204e9800998ecf8427e"


def test_the_table_of_scans_is_next_to_the_bag(tmp_path: Path) -> None:
    written("rosbag1", tmp_path / "out.bag", SCANS[:1])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.bag", "out.bag.scans.csv"]
    assert (tmp_path / "out.bag.scans.csv").read_text() == SUMMARY.scans_csv


def test_messages_of_ros_2_are_refused_by_name(tmp_path: Path) -> None:
    writer = open_writer("rosbag1", tmp_path / "out.bag", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    with pytest.raises(ExportError, match=r"^/note: expected messages of ROS 1 .* found 'cdr'"):
        writer.write_message(note(ROS2_NOTE, "x", 0))
    writer.abandon()


def test_a_definition_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    writer = open_writer("rosbag1", tmp_path / "out.bag", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    for text in ("what ever this is !!", "other_msgs/Missing x\n"):
        topic = ROS1_NOTE._replace(definition=text, type="my_msgs/Lost")
        with pytest.raises(ExportError, match=r"^/note: expected a definition of my_msgs/Lost"):
            writer.write_message(note(topic, "x", 0))
    writer.abandon()
