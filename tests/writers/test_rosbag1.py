"""ROS 1 bags: read back by rosbags; MD5 numbers are those that ROS 1 publishes."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import ExportError
from mlbatch.types import Message
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import (
    PERIOD_NS,
    START_NS,
    SUMMARY,
    dense_scan,
    organized_scan,
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
    read_back,
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
    found = read_raw(written("rosbag1", tmp_path / "out.bag", [point_scan()], []))
    [data] = [data for topic, data in found if topic == "/points"]

    def field(name: str, offset: int, code: int) -> bytes:
        text = name.encode()
        return struct.pack("<I", len(text)) + text + struct.pack("<IBI", offset, code, 1)

    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7)]
    fields += [("ring", 20, 4), ("return_type", 22, 2), ("lidar_id", 23, 2)]
    wanted = struct.pack("<III", 0, 1_700_000_000, 100_000_000)
    wanted += struct.pack("<I9s", 9, b"base_link") + struct.pack("<III", 1, 1, 8)
    wanted += b"".join(field(*row) for row in fields)
    wanted += struct.pack("<BIII", 0, 24, 24, 24)
    wanted += struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1) + b"\1"
    assert data == wanted


def read_raw(path: Path) -> list[tuple[str, bytes]]:
    """Topic and bytes of every message, by log time."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    with rosbag1.Reader(path) as reader:
        return [(connection.topic, bytes(raw)) for connection, _, raw in reader.messages()]


def test_rosbags_reads_every_message(tmp_path: Path) -> None:
    found = read_back(written("rosbag1", tmp_path / "out.bag", SCANS, MESSAGES))
    assert found[0].topic == "/tf_static"
    assert [(r.topic, r.log_ns - START_NS) for r in found] == [
        ("/tf_static", -7),
        ("/note", -7),
        ("/left/imu", -5),
        ("/points", 0),
        ("/odd", 3),
        ("/left/imu", 10_000_000 - 5),
        ("/right/imu", PERIOD_NS // 2),
        ("/points", PERIOD_NS),
        ("/note", 3 * PERIOD_NS),
    ]
    transforms = found[0].value.transforms
    assert [t.child_frame_id for t in transforms] == ["left", "right"]
    assert transforms[1].transform.translation.z == 2.0
    clouds = [r.value for r in found if r.topic == "/points"]
    for cloud, scan in zip(clouds, SCANS, strict=True):
        points = np.asarray(cloud.data).view("<f4").reshape(-1, 6)
        np.testing.assert_array_equal(points[:, :3], scan.xyz)
        assert cloud.header.frame_id == "base_link"
        assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == scan.start_ns
    imu = next(r.value for r in found if r.topic == "/right/imu")
    assert imu.angular_velocity.z == 6.0
    assert imu.linear_acceleration.x == 1.0
    assert imu.orientation_covariance[0] == -1.0
    assert [r.raw for r in found if r.topic in ("/note", "/odd")] == [m.data for m in MESSAGES]
    assert [r.value.data for r in found if r.topic == "/note"] == ["first", "last"]


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
    assert connections["/points"].msgdef.data.count("=" * 80) == 2
    assert connections["/odd"].msgdef.data == ODD_TEXT
    assert b"type=sensor_msgs/PointCloud2" in path.read_bytes()


def test_a_type_without_fields(tmp_path: Path) -> None:
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    topic = replace(ROS1_NOTE, type="std_msgs/Empty", definition="")
    message = Message(topic, START_NS, b"")
    path = written("rosbag1", tmp_path / "out.bag", SCANS[:1], [message])
    with rosbag1.Reader(path) as reader:
        [connection] = [c for c in reader.connections if c.topic == "/note"]
    # MD5 of no text at all.
    assert connection.digest == "d41d8cd98f00b204e9800998ecf8427e"


def test_organized_clouds(tmp_path: Path) -> None:
    found = read_back(written("rosbag1", tmp_path / "out.bag", [organized_scan(5)], []))
    [cloud] = [r.value for r in found if r.topic == "/points"]
    assert (cloud.height, cloud.width, cloud.row_step, cloud.is_dense) == (4, 5, 120, False)


def test_the_table_of_scans_lies_beside(tmp_path: Path) -> None:
    written("rosbag1", tmp_path / "out.bag", SCANS[:1], [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.bag", "out.bag.scans.csv"]
    assert (tmp_path / "out.bag.scans.csv").read_text() == SUMMARY.scans_csv


def test_messages_of_ros_2_are_refused_by_name(tmp_path: Path) -> None:
    writer = open_writer("rosbag1", tmp_path / "out.bag", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    with pytest.raises(ExportError, match=r"^/note: wanted messages of ROS 1 .* got 'cdr'"):
        writer.write_message(note(ROS2_NOTE, "x", 0))
    writer.abandon()


def test_a_definition_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    writer = open_writer("rosbag1", tmp_path / "out.bag", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    for text in ("what ever this is !!", "other_msgs/Missing x\n"):
        topic = replace(ROS1_NOTE, definition=text, type="my_msgs/Lost")
        with pytest.raises(ExportError, match=r"^/note: wanted the definition of my_msgs/Lost"):
            writer.write_message(note(topic, "x", 0))
    writer.abandon()


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    files = []
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        path = written("rosbag1", tmp_path / place / "out.bag", SCANS, MESSAGES)
        files.append(path.read_bytes())
    assert files[0] == files[1]
