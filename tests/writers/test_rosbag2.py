"""ROS 2 bags: metadata.yaml by hand, QoS, the MCAP file inside, forwarded messages."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader

from mlbatch.errors import ExportError
from mlbatch.types import Topic
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import (
    PERIOD_NS,
    START_NS,
    SUMMARY,
    dense_scan,
    run_info,
    run_job,
)
from tests.builders.written_bags import (
    ODD_TEXT,
    ROS1_NOTE,
    ROS2_NOTE,
    ROS2_ODD,
    note,
    odd,
    read_back,
    written,
)

SCANS = [dense_scan(0), dense_scan(1, 30)]
MESSAGES = [
    note(ROS2_NOTE, "first", -7),
    odd(ROS2_ODD, 1, -2, after_ns=3),
    note(ROS2_NOTE, "last", 3 * PERIOD_NS),
]


def test_metadata_by_hand(tmp_path: Path) -> None:
    folder = written("rosbag2", tmp_path / "drive é", SCANS, MESSAGES)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["drive é_0.mcap", "metadata.yaml", "scans.csv"]
    assert (folder / "scans.csv").read_text() == SUMMARY.scans_csv
    text = (folder / "metadata.yaml").read_text(encoding="utf-8")
    info = yaml.safe_load(text)["rosbag2_bagfile_information"]
    span = {"nanoseconds": 3 * PERIOD_NS + 7}
    start = {"nanoseconds_since_epoch": START_NS - 7}
    topics = info.pop("topics_with_message_count")
    assert info == {
        "version": 5,
        "storage_identifier": "mcap",
        "duration": span,
        "starting_time": start,
        "message_count": 9,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["drive é_0.mcap"],
        "files": [
            {
                "path": "drive é_0.mcap",
                "starting_time": start,
                "duration": span,
                "message_count": 9,
            }
        ],
    }
    counts = {
        (t["topic_metadata"]["name"], t["topic_metadata"]["type"]): t["message_count"]
        for t in topics
    }
    assert counts == {
        ("/tf_static", "tf2_msgs/msg/TFMessage"): 1,
        ("/points", "sensor_msgs/msg/PointCloud2"): 2,
        ("/left/imu", "sensor_msgs/msg/Imu"): 2,
        ("/right/imu", "sensor_msgs/msg/Imu"): 1,
        ("/note", "std_msgs/msg/String"): 2,
        ("/odd", "my_msgs/msg/Odd"): 1,
    }
    assert {t["topic_metadata"]["serialization_format"] for t in topics} == {"cdr"}


def test_qos_is_in_numbers(tmp_path: Path) -> None:
    """Also where the recording has words: Humble reads none."""
    folder = written("rosbag2", tmp_path / "out", SCANS[:1], MESSAGES)
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


def test_the_file_inside_is_a_whole_mcap(tmp_path: Path) -> None:
    folder = written("rosbag2", tmp_path / "out", SCANS, MESSAGES)
    with (folder / "out_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages(log_time_order=False))
        assert {record.name for record in reader.iter_metadata()} == {
            *("mlbatch.grid", "mlbatch.fill", "mlbatch.report")
        }
        assert [attached.name for attached in reader.iter_attachments()] == ["scans.csv"]
    assert found[0][1].topic == "/tf_static"
    texts = {schema.name: schema.data.decode() for schema, _, _ in found if schema is not None}
    assert texts["std_msgs/msg/String"] == "string data\n"
    assert texts["my_msgs/msg/Odd"] == ODD_TEXT


def test_a_definition_that_was_not_stored_is_ours(tmp_path: Path) -> None:
    """Bags of Humble contain no definitions."""
    topic = Topic("/imu", "sensor_msgs/Imu", "cdr")
    source = read_back(written("rosbag2", tmp_path / "first", SCANS[:1]))
    [raw, _] = [r.raw for r in source if r.topic == "/left/imu"]
    message = note(ROS2_NOTE, "", 5)._replace(topic=topic, data=raw)
    found = read_back(written("rosbag2", tmp_path / "out", SCANS[:1], [message]))
    [imu] = [r.value for r in found if r.topic == "/imu"]
    assert imu.linear_acceleration.z == 3.0


def test_messages_of_ros_1_are_refused_by_name(tmp_path: Path) -> None:
    writer = open_writer("rosbag2", tmp_path / "out", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    with pytest.raises(ExportError, match=r"^/note: expected messages of ROS 2 \(cdr\).*\.mcap"):
        writer.write_message(note(ROS1_NOTE, "x", 0))
    writer.abandon()
