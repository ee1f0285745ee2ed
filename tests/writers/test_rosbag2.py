"""ROS 2 bags: read back by rosbags and the MCAP reference reader; metadata.yaml by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from mlbatch.errors import ExportError
from mlbatch.types import Summary, Topic
from mlbatch.writers import WriterOptions, extras, open_writer
from tests.builders.scans import (
    PERIOD_NS,
    START_NS,
    SUMMARY,
    dense_scan,
    imu_samples,
    organized_scan,
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


def test_rosbags_reads_every_message(tmp_path: Path) -> None:
    found = read_back(written("rosbag2", tmp_path / "out", SCANS, MESSAGES))
    assert found[0].topic == "/tf_static"
    assert [(r.topic, r.log_ns - START_NS) for r in found[1:]] == [
        ("/note", -7),
        ("/left/imu", -5),
        ("/points", 0),
        ("/odd", 3),
        ("/left/imu", 10_000_000 - 5),
        ("/right/imu", PERIOD_NS // 2),
        ("/points", PERIOD_NS),
        ("/note", 3 * PERIOD_NS),
    ]
    assert found[0].log_ns == START_NS - 7
    assert found[0].value.transforms[1].child_frame_id == "right"
    clouds = [r.value for r in found if r.topic == "/points"]
    for cloud, scan in zip(clouds, SCANS, strict=True):
        points = np.asarray(cloud.data).view("<f4").reshape(-1, 6)
        np.testing.assert_array_equal(points[:, :3], scan.xyz)
    assert [r.raw for r in found if r.topic in ("/note", "/odd")] == [m.data for m in MESSAGES]
    assert [r.value.data for r in found if r.topic == "/note"] == ["first", "last"]
    [strange] = [r for r in found if r.topic == "/odd"]
    assert (strange.type, [part.x for part in strange.value.parts]) == ("my_msgs/msg/Odd", [1, -2])


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
    for name, [profile] in qos.items():
        latched = name in ("/tf_static", "/note")
        assert profile["history"] == 1
        assert profile["depth"] == (1 if latched else 10)
        assert profile["reliability"] == 1
        assert profile["durability"] == (1 if latched else 2)
        assert profile["liveliness"] == 1
        assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
        assert profile["avoid_ros_namespace_conventions"] is False
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
            *("mlbatch.grid", "mlbatch.report")
        }
        assert [attached.name for attached in reader.iter_attachments()] == ["scans.csv"]
    assert found[0][1].topic == "/tf_static"
    texts = {schema.name: schema.data.decode() for schema, _, _ in found if schema is not None}
    assert texts["std_msgs/msg/String"] == "string data\n"
    assert texts["my_msgs/msg/Odd"] == ODD_TEXT


def test_a_definition_that_was_not_stored_is_ours(tmp_path: Path) -> None:
    """Bags of Humble hold no definitions."""
    topic = Topic("/imu", "sensor_msgs/Imu", "cdr")
    source = read_back(written("rosbag2", tmp_path / "first", SCANS[:1], []))
    [raw, _] = [r.raw for r in source if r.topic == "/left/imu"]
    message = replace(note(ROS2_NOTE, "", 5), topic=topic, data=raw)
    found = read_back(written("rosbag2", tmp_path / "out", SCANS[:1], [message]))
    [imu] = [r.value for r in found if r.topic == "/imu"]
    assert imu.linear_acceleration.z == 3.0


def test_messages_of_ros_1_are_refused_by_name(tmp_path: Path) -> None:
    writer = open_writer("rosbag2", tmp_path / "out", run_info(), WriterOptions())
    run_job(writer.write(dense_scan()))
    with pytest.raises(ExportError, match=r"^/note: wanted messages of ROS 2 \(cdr\).*\.mcap"):
        writer.write_message(note(ROS1_NOTE, "x", 0))
    writer.abandon()


@pytest.mark.parametrize("name", ["mcap", "rosbag1", "rosbag2"])
@pytest.mark.parametrize("topic", ["/points", "/left/imu", "/tf_static"])
def test_topics_of_the_scans_are_not_shared(name: str, topic: str, tmp_path: Path) -> None:
    writer = open_writer(name, tmp_path / "out", run_info(), WriterOptions())
    with pytest.raises(ExportError, match=f"got a recorded {topic} as well; leave it out"):
        writer.write_message(note(replace(ROS2_NOTE, name=topic), "x", 0))
    writer.abandon()


def test_an_mcap_holds_both_kinds(tmp_path: Path) -> None:
    messages = [note(ROS1_NOTE, "one", 1), note(replace(ROS2_NOTE, name="/two"), "two", 2)]
    path = written("mcap", tmp_path / "out.mcap", SCANS[:1], messages)
    with path.open("rb") as file:
        found = list(make_reader(file, validate_crcs=True).iter_messages(["/note", "/two"]))
    assert [(s.name, s.encoding, c.message_encoding) for s, c, _ in found if s is not None] == [
        ("std_msgs/String", "ros1msg", "ros1"),
        ("std_msgs/msg/String", "ros2msg", "cdr"),
    ]
    assert found[0][1].metadata == {"latching": "1"}
    assert [m.data for _, _, m in found] == [m.data for m in messages]


def test_messages_that_fill_the_memory_do_not_wait(tmp_path: Path) -> None:
    writer = open_writer("rosbag2", tmp_path / "out", run_info(), WriterOptions())
    for number in range(20):
        writer.write_message(note(ROS2_NOTE, "x" * 1_000_000, number))
    run_job(writer.write(dense_scan()))
    writer.finish(SUMMARY)
    found = [(r.topic, r.log_ns - START_NS) for r in read_back(tmp_path / "out")]
    assert found[0] == ("/tf_static", 0)
    notes = [log_ns for topic, log_ns in found if topic == "/note"]
    assert notes == list(range(20))


def test_organized_clouds_and_runs_without_scans(tmp_path: Path) -> None:
    found = read_back(written("rosbag2", tmp_path / "out", [organized_scan(5)], []))
    [cloud] = [r for r in found if r.topic == "/points"]
    assert (cloud.value.height, cloud.value.width) == (4, 5)
    writer = open_writer("rosbag2", tmp_path / "none", run_info(), WriterOptions())
    writer.write_imu(imu_samples(count=0))
    writer.finish(Summary(None, "{}", "index\n"))
    assert [r.topic for r in read_back(tmp_path / "none")] == ["/tf_static"]


def test_what_the_formats_have_a_place_for() -> None:
    for name, encodings in (("mcap", {"cdr", "ros1"}), ("rosbag1", {"ros1"}), ("rosbag2", {"cdr"})):
        assert extras(name, WriterOptions()) == {"imu", *encodings}
        assert extras(name, WriterOptions("ouster")) == {
            *("imu", "range_m", "reflectivity", *encodings)
        }
    for name in ("npz", "ply"):
        assert not extras(name, WriterOptions()) & {"imu", "cdr", "ros1"}


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    for place in ("a", "b"):
        (tmp_path / place).mkdir()
        written("rosbag2", tmp_path / place / "out", SCANS, MESSAGES)
    for name in ("out_0.mcap", "metadata.yaml"):
        files = [(tmp_path / place / "out" / name).read_bytes() for place in ("a", "b")]
        assert files[0] == files[1]
