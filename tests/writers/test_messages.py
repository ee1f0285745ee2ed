"""Messages of all containers: topics, order, contents; read back by other libraries."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags import rosbag1

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Wire
from mlbatch.types import IMU, PACKED_ROOM, Message, PackedPoints, Topic
from mlbatch.writers import extras, open_writer, plugin, report_paths
from mlbatch.writers.base import WriterOptions
from mlbatch.writers.formats import format_names
from mlbatch.writers.message_writer import CloudMessage, static_edges
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS
from tests.builders.bags import Body
from tests.builders.rosbag1 import definition_of
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
    ROS2_ODD,
    note,
    odd,
    read_back,
    written,
)

OUTPUTS = {
    name: f"out{plugin(name).SUFFIX or ''}"
    for name in format_names()
    if IMU in extras(name, WriterOptions())
}
each_container = pytest.mark.parametrize("name", OUTPUTS)
# The first one has more points than a block of the packing, and not a multiple of it.
SCANS = [dense_scan(0, 20_001), dense_scan(1, 30)]
POINT = np.dtype("<f4,<f4,<f4,<f4,<f4,<u2,u1,u1")
HALF = 0.5**0.5


def recorded(name: str) -> list[Message]:
    """Return messages that a container can forward."""
    topic, other = (ROS1_NOTE, ROS1_ODD) if name == "rosbag1" else (ROS2_NOTE, ROS2_ODD)
    return [
        note(topic, "first", -7),
        odd(other, 1, -2, after_ns=3),
        note(topic, "last", 3 * PERIOD_NS),
    ]


@each_container
def test_one_message_by_hand(name: str, tmp_path: Path) -> None:
    encoding = "ros1" if name == "rosbag1" else "cdr"
    found = read_back(written(name, tmp_path / OUTPUTS[name], [point_scan()]))
    [data] = [message.raw for message in found if message.topic == "/points"]
    body = Body(encoding)
    if encoding == "ros1":
        body.put("I", 0)
    body.time(START_NS).text("base_link").put("I", 1, 1, 8)
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7)]
    fields += [("ring", 20, 4), ("return_type", 22, 2), ("lidar_id", 23, 2)]
    for field, offset, code in fields:
        body.text(field).put("I", offset).put("B", code).put("I", 1)
    body.put("B", 0).put("I", 24, 24)
    body.blob(struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1)).put("B", 1)
    assert data == body.done()


@each_container
def test_other_libraries_read_every_message(name: str, tmp_path: Path) -> None:
    messages = recorded(name)
    target = written(name, tmp_path / OUTPUTS[name], SCANS, messages)
    assert report_paths(target, name).scans_csv.read_text() == SUMMARY.scans_csv
    found = read_back(target)
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
    for cloud, scan in zip([r.value for r in found if r.topic == "/points"], SCANS, strict=True):
        assert (cloud.height, cloud.width, cloud.row_step) == (1, scan.points, 24 * scan.points)
        assert (cloud.is_dense, cloud.is_bigendian) == (True, False)
        points = np.frombuffer(cloud.data, POINT)
        x, y, z = scan.xyz.T
        fields = {"f0": x, "f1": y, "f2": z, "f3": scan.intensity, "f5": scan.ring}
        fields |= {"f6": scan.return_type, "f7": scan.lidar_id}
        for field, values in fields.items():
            np.testing.assert_array_equal(points[field], values)
        assert cloud.header.frame_id == "base_link"
        assert cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == scan.start_ns
    assert [r.raw for r in found if r.topic in ("/note", "/odd")] == [m.data for m in messages]
    assert [r.value.data for r in found if r.topic == "/note"] == ["first", "last"]
    [strange] = [r for r in found if r.topic == "/odd"]
    assert (strange.type, [part.x for part in strange.value.parts]) == ("my_msgs/msg/Odd", [1, -2])


@each_container
def test_static_transforms_are_the_poses(name: str, tmp_path: Path) -> None:
    [message] = [
        r.value
        for r in read_back(written(name, tmp_path / OUTPUTS[name], SCANS))
        if r.topic == "/tf_static"
    ]
    frames = [(item.header.frame_id, item.child_frame_id) for item in message.transforms]
    assert frames == [("base_link", "left"), ("base_link", "right")]
    right = message.transforms[1].transform
    assert (right.translation.x, right.translation.y, right.translation.z) == (1.0, 0.0, 2.0)
    found = (right.rotation.x, right.rotation.y, right.rotation.z, right.rotation.w)
    # 90 degrees about z.
    assert found == pytest.approx((0, 0, HALF, HALF))


def test_two_frames_of_one_name_are_refused(tmp_path: Path) -> None:
    info = run_info()
    left, right = info.sensors
    same = info._replace(
        sensors=(replace(left, sensor_from_imu=np.eye(4)), replace(right, name="left_imu"))
    )
    with pytest.raises(ExportError, match="found left_imu for a sensor and for an IMU"):
        open_writer("mcap", tmp_path / "scans.mcap", same, WriterOptions("standard"))
    assert list(tmp_path.iterdir()) == []
    # A frame of the recording does not replace an own one.
    recorded = info._replace(frames=(("gps", np.eye(4)), ("left", np.eye(4))))
    children = [child for _, child, _ in static_edges(recorded)]
    assert children == ["left", "right", "gps"]


@each_container
def test_imu_messages_have_the_samples(name: str, tmp_path: Path) -> None:
    found = read_back(written(name, tmp_path / OUTPUTS[name], SCANS))
    first, second = (r.value for r in found if r.topic == "/left/imu")
    assert first.header.frame_id == "left_imu"
    stamp = first.header.stamp
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 99_999_995)
    assert first.orientation_covariance[0] == -1.0
    acceleration = second.linear_acceleration
    assert (acceleration.x, acceleration.y, acceleration.z) == (11.0, 12.0, 13.0)
    velocity = second.angular_velocity
    assert (velocity.x, velocity.y, velocity.z) == (14.0, 15.0, 16.0)
    [right] = [r.value for r in found if r.topic == "/right/imu"]
    assert (right.angular_velocity.z, right.linear_acceleration.x) == (6.0, 1.0)


@each_container
def test_organized_clouds(name: str, tmp_path: Path) -> None:
    scan = organized_scan(5)
    found = read_back(written(name, tmp_path / OUTPUTS[name], [scan]))
    [cloud] = [r.value for r in found if r.topic == "/points"]
    assert (cloud.height, cloud.width, cloud.row_step, cloud.is_dense) == (4, 5, 120, False)
    floats = np.frombuffer(cloud.data, "<f4").reshape(4, 5, 6)
    shorts = np.frombuffer(cloud.data, "<u2").reshape(4, 5, 12)
    assert np.isnan(floats[0, :, :4]).all()
    np.testing.assert_array_equal(floats[..., :3], scan.xyz.transpose(1, 0, 2))
    np.testing.assert_array_equal(shorts[..., 10], scan.ring.T)


LOST = ROS1_NOTE._replace(type="my_msgs/Lost")
REFUSED = [
    ("rosbag1", ROS2_NOTE, "^/note: expected messages of ROS 1 .* found 'cdr'"),
    ("rosbag2", ROS1_NOTE, r"^/note: expected messages of ROS 2 \(cdr\).*\.mcap"),
    *(
        ("rosbag1", LOST._replace(definition=text), "^/note: expected a definition of my_msgs/Lost")
        for text in ("what ever this is !!", "other_msgs/Missing x\n")
    ),
    *(
        (name, ROS2_NOTE._replace(name=topic), f"those of the scans, found {topic}; do not pass")
        for name in OUTPUTS
        for topic in ("/points", "/left/imu", "/tf_static")
    ),
]


@pytest.mark.parametrize(("name", "topic", "message"), REFUSED)
def test_messages_that_are_refused(name: str, topic: Topic, message: str, tmp_path: Path) -> None:
    info = run_info()
    # Both lidars have an IMU, whose samples are messages of the scans.
    sensors = tuple(replace(one, sensor_from_imu=np.eye(4)) for one in info.sensors)
    writer = open_writer(
        name, tmp_path / OUTPUTS[name], info._replace(sensors=sensors), WriterOptions()
    )
    run_job(writer.write(dense_scan()))
    with pytest.raises(ExportError, match=message):
        writer.write_message(note(topic, "x", 0))
    writer.abandon()


@each_container
def test_messages_that_fill_the_memory_do_not_wait(name: str, tmp_path: Path) -> None:
    topic = ROS1_NOTE if name == "rosbag1" else ROS2_NOTE
    writer = open_writer(name, tmp_path / OUTPUTS[name], run_info(), WriterOptions())
    for number in range(20):
        writer.write_message(note(topic, "x" * 1_000_000, number))
    run_job(writer.flush())
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.*") if path.is_file()) > 10_000_000
    run_job(writer.write(dense_scan()))
    writer.finish(SUMMARY)
    found = [(r.topic, r.log_ns - START_NS) for r in read_back(tmp_path / OUTPUTS[name])]
    assert found[0] == ("/tf_static", 0)
    notes = [log_ns for topic, log_ns in found if topic == "/note"]
    assert notes == list(range(20))


@pytest.mark.parametrize("frame", ["base_link", "f" * 2 * PACKED_ROOM])
def test_packed_points_become_the_message_of_arrays(frame: str) -> None:
    scan = dense_scan()
    layout = CLOUD_LAYOUTS["standard"]
    end = PACKED_ROOM + scan.points * layout.step
    buffer = np.zeros(end + 1, np.uint8)
    layout.pack(scan, buffer[PACKED_ROOM:end].view(layout.dtype))
    packed = PackedPoints(buffer, PACKED_ROOM, end, (scan.points,))
    cloud = CloudMessage(layout, frame, Wire)
    from_arrays = cloud.message(scan, 5, True).tobytes()
    assert cloud.message(replace(scan, packed=packed), 5, True).tobytes() == from_arrays


# -- one container ------------------------------------------------------------------------------


def test_messages_of_ros_1_and_ros_2(tmp_path: Path) -> None:
    messages = [note(ROS1_NOTE, "one", 1), note(ROS2_NOTE._replace(name="/two"), "two", 2)]
    path = written("mcap", tmp_path / "out.mcap", [dense_scan()], messages)
    with path.open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages(["/note", "/two"]))
    assert [(s.name, s.encoding, c.message_encoding) for s, c, _ in found if s is not None] == [
        ("std_msgs/String", "ros1msg", "ros1"),
        ("std_msgs/msg/String", "ros2msg", "cdr"),
    ]
    assert found[0][1].metadata == {"latching": "1"}
    assert [m.data for _, _, m in found] == [m.data for m in messages]


# From the message pages of docs.ros.org (noetic).
MD5 = {
    "/points": "1158d486dd51d683ce2f1be655c3c181",
    "/left/imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "/right/imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "/tf_static": "94810edda583a504dfda3829e70d7eec",
    "/note": "992ce8a1687cec8c8bd883ec73ca41d1",
}


def test_connections_are_what_ros_1_expects(tmp_path: Path) -> None:
    path = written("rosbag1", tmp_path / "out.bag", SCANS, recorded("rosbag1"))
    assert path.read_bytes().startswith(b"#ROSBAG V2.0\n")
    with rosbag1.Reader(path) as reader:
        connections = {c.topic: c for c in reader.connections}
        assert reader.message_count == 9
    assert {t: c.digest for t, c in connections.items() if t in MD5} == MD5
    latched = {t for t, c in connections.items() if getattr(c.ext, "latching", 0)}
    assert latched == {"/tf_static", "/note"}
    assert definition_of(connections["/points"]).count("=" * 80) == 2
    assert definition_of(connections["/odd"]) == ODD_TEXT
    assert b"type=sensor_msgs/PointCloud2" in path.read_bytes()


def test_a_type_without_fields(tmp_path: Path) -> None:
    topic = ROS1_NOTE._replace(type="std_msgs/Empty", definition="")
    message = Message(topic, START_NS, b"")
    path = written("rosbag1", tmp_path / "out.bag", SCANS[:1], [message])
    with rosbag1.Reader(path) as reader:
        [connection] = [c for c in reader.connections if c.topic == "/note"]
    # MD5 of no text at all.
    assert connection.digest == "d41d8cd98f00b204e9800998ecf8427e"


def test_qos_is_in_numbers(tmp_path: Path) -> None:
    """Also where the recording has words: Humble reads none."""
    folder = written("rosbag2", tmp_path / "out", SCANS[:1], recorded("rosbag2"))
    info = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    qos = {
        t["topic_metadata"]["name"]: yaml.safe_load(t["topic_metadata"]["offered_qos_profiles"])
        for t in info["topics_with_message_count"]
    }
    forever = {"sec": 9223372036, "nsec": 854775807}
    for name, [profile] in qos.items():
        latched = name in ("/tf_static", "/note")
        assert profile == {
            "history": 1,
            "depth": 1 if latched else 10,
            "reliability": 1,
            "durability": 1 if latched else 2,
            "deadline": forever,
            "lifespan": forever,
            "liveliness": 1,
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }
    with (folder / "out_0.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channels = summary.channels.values()
    inside = {c.topic: yaml.safe_load(c.metadata["offered_qos_profiles"]) for c in channels}
    assert inside == qos


def test_a_definition_that_was_not_stored_is_ours(tmp_path: Path) -> None:
    """Bags of Humble contain no definitions."""
    topic = Topic("/imu", "sensor_msgs/Imu", "cdr")
    source = read_back(written("rosbag2", tmp_path / "first", SCANS[:1]))
    [raw, _] = [r.raw for r in source if r.topic == "/left/imu"]
    message = note(ROS2_NOTE, "", 5)._replace(topic=topic, data=raw)
    found = read_back(written("rosbag2", tmp_path / "out", SCANS[:1], [message]))
    [imu] = [r.value for r in found if r.topic == "/imu"]
    assert imu.linear_acceleration.z == 3.0
