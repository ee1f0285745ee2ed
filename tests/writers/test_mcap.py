"""MCAP: read back by the reference reader, by rosbags and by mcap-ros2-support."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from mlbatch.types import Scan, Summary
from mlbatch.writers import WriterOptions, open_writer
from tests.builders.scans import (
    PERIOD_NS,
    START_NS,
    SUMMARY,
    dense_scan,
    imu_samples,
    organized_scan,
    point_scan,
    run_info,
    run_job,
)


def written(folder: Path, *scans: Scan, layout: str = "standard", split: bool = False) -> Path:
    """Write IMU samples of sensor 0 and scans, by sensor 0, 1, ... if `split`."""
    target = folder / "out.mcap"
    writer = open_writer("mcap", target, scans[0].info, WriterOptions(layout, split=split))
    writer.write_imu(imu_samples())
    for number, scan in enumerate(scans):
        run_job(writer.write(scan, number if split else None))
    writer.write_imu(imu_samples(1, START_NS + PERIOD_NS // 2, 1))
    writer.finish(SUMMARY)
    return target


def messages(path: Path, in_order: bool = True) -> list[tuple[Schema | None, Channel, Message]]:
    """All messages, by log time or as they lie in the file."""
    with path.open("rb") as file:
        return list(make_reader(file, validate_crcs=True).iter_messages(log_time_order=in_order))


def decoded(path: Path, topic: str) -> list[Any]:
    """Messages of a topic as mcap-ros2-support decodes them."""
    decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder])
        return [found.decoded_message for found in reader.iter_decoded_messages(topics=[topic])]


def test_one_message_by_hand(tmp_path: Path) -> None:
    path = written(tmp_path, point_scan(), layout="standard")
    [data] = [message.data for _, channel, message in messages(path) if channel.topic == "/points"]

    def field(name: str, offset: int, code: int) -> bytes:
        text = name.encode() + b"\0"
        # Strings end anywhere; the next number starts at a multiple of 4.
        text += b"\0" * (-len(text) % 4)
        return struct.pack("<I", len(name) + 1) + text + struct.pack("<IB3xI", offset, code, 1)

    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("time", 16, 7)]
    fields += [("ring", 20, 4), ("return_type", 22, 2), ("lidar_id", 23, 2)]
    wanted = b"\0\1\0\0" + struct.pack("<iI", 1_700_000_000, 100_000_000)
    wanted += struct.pack("<I12s", 10, b"base_link") + struct.pack("<III", 1, 1, 8)
    wanted += b"".join(field(*row) for row in fields)
    wanted += struct.pack("<B3xIII", 0, 24, 24, 24)
    wanted += struct.pack("<fffffHBB", 1.0, 2.0, 3.0, 7.0, 0.0625, 258, 2, 1) + b"\1"
    assert data == wanted


@pytest.mark.parametrize(
    ("layout", "form", "values"),
    [
        ("velodyne", "<ffffHf", (1, 2, 3, 7, 258, 0.0625)),
        (
            "ouster",
            "<fff4xfIHHH2xI12x",
            (1, 2, 3, 7, 62_500_000, 300, 258, 0, 1500),
        ),
        ("hesai", "<ffffHd", (1, 2, 3, 7, 258, 1_700_000_000.1625)),
        ("kiss-icp", "<ffff", (1, 2, 3, 0.0625)),
        ("minimal", "<fff", (1, 2, 3)),
    ],
)
def test_presets_by_hand(tmp_path: Path, layout: str, form: str, values: tuple[float, ...]) -> None:
    path = written(tmp_path, point_scan(), layout=layout)
    [cloud] = decoded(path, "/points")
    assert cloud.point_step == struct.calcsize(form)
    assert bytes(cloud.data) == struct.pack(form, *values)


def test_autoware_angles_are_seen_from_the_sensor(tmp_path: Path) -> None:
    # The sensor stands at (1, 0, 2) and looks along body y: from it, the point (1, 3, 6) lies
    # 3 m ahead and 4 m up.
    scan = replace(point_scan(), xyz=np.array([[1, 3, 6]], np.float32))
    scan = replace(scan, intensity=np.array([999], np.float32), ring=np.array([6], np.uint16))
    [cloud] = decoded(written(tmp_path, scan, layout="autoware"), "/points")
    x, y, z, intensity, kind, channel, azimuth, elevation, distance, time = struct.unpack(
        "<fffBBHfffI", bytes(cloud.data)
    )
    assert (x, y, z, intensity, kind, channel, time) == (1, 3, 6, 255, 2, 2, 62_500_000)
    assert azimuth == pytest.approx(0, abs=1e-6)
    assert elevation == pytest.approx(math.atan2(4, 3))
    assert distance == pytest.approx(5)
    assert [field.name for field in cloud.fields] == [
        *("x", "y", "z", "intensity", "return_type", "channel"),
        *("azimuth", "elevation", "distance", "time_stamp"),
    ]


def test_float32_times_never_exceed_the_true_time(tmp_path: Path) -> None:
    # The float32 nearest to 99 999 999 ns is 0.1 s, above the truth; one step (2^-27 s) down lies
    # 0.0999999940395355224609375 s. Those of 500 000 000 ns and 0 are exact.
    time_ns = np.array([0, 1, 99_999_999, 500_000_000, 4_000_000_001], np.uint32)
    scan = dense_scan(points=len(time_ns))
    [cloud] = decoded(written(tmp_path, replace(scan, time_ns=time_ns)), "/points")
    found = np.frombuffer(cloud.data, "<f4").reshape(-1, 6)[:, 4]
    assert found[2] == 0.0999999940395355224609375
    assert found[[0, 3, 4]].tolist() == [0.0, 0.5, 4.0]
    for value, truth_ns in zip(found, time_ns.tolist(), strict=True):
        # Exact rationals: m / 2^k <= ns / 10^9 < next(m / 2^k).
        above = np.nextafter(value, np.float32(5))
        numerator, denominator = float(value).as_integer_ratio()
        assert numerator * 10**9 <= truth_ns * denominator
        numerator, denominator = float(above).as_integer_ratio()
        assert numerator * 10**9 > truth_ns * denominator


def test_clouds_hold_the_scans(tmp_path: Path) -> None:
    # More points than a block of the packing, and not a multiple of it.
    scans = [dense_scan(0, 20_001), dense_scan(1, 30), dense_scan(2, 0)]
    clouds = decoded(written(tmp_path, *scans), "/points")
    kind = np.dtype("<f4,<f4,<f4,<f4,<f4,<u2,u1,u1")
    for cloud, scan in zip(clouds, scans, strict=True):
        assert (cloud.height, cloud.width, cloud.row_step) == (1, scan.points, 24 * scan.points)
        assert cloud.is_dense
        assert not cloud.is_bigendian
        points = np.frombuffer(cloud.data, kind)
        for axis in range(3):
            np.testing.assert_array_equal(points[f"f{axis}"], scan.xyz[:, axis])
        for name, wanted in (("f3", scan.intensity), ("f5", scan.ring), ("f6", scan.return_type)):
            np.testing.assert_array_equal(points[name], wanted)
        np.testing.assert_array_equal(points["f7"], scan.lidar_id)


def test_organized_clouds_are_images_of_slots_by_columns(tmp_path: Path) -> None:
    scan = organized_scan(columns=5)
    [cloud] = decoded(written(tmp_path, scan), "/points")
    assert (cloud.height, cloud.width, cloud.row_step, cloud.is_dense) == (4, 5, 120, False)
    floats = np.frombuffer(cloud.data, "<f4").reshape(4, 5, 6)
    assert np.isnan(floats[0, :, :4]).all()
    for slot in range(4):
        for column in range(5):
            np.testing.assert_array_equal(floats[slot, column, :3], scan.xyz[column, slot])
    rings = np.frombuffer(cloud.data, "<u2").reshape(4, 5, 12)[..., 10]
    np.testing.assert_array_equal(rings, scan.ring.T)


def test_profile_topics_and_times(tmp_path: Path) -> None:
    path = written(tmp_path, dense_scan(0), dense_scan(1))
    found = messages(path, in_order=False)
    assert [(channel.topic, message.log_time - START_NS) for _, channel, message in found] == [
        ("/tf_static", -5),
        ("/left/imu", -5),
        ("/left/imu", 10_000_000 - 5),
        ("/points", 0),
        ("/points", PERIOD_NS),
        ("/right/imu", PERIOD_NS // 2),
    ]
    assert all(message.log_time == message.publish_time for _, _, message in found)
    assert [m.sequence for _, channel, m in found if channel.topic == "/points"] == [0, 1]
    ordered = [message.log_time for _, _, message in messages(path)]
    assert ordered == sorted(ordered)
    assert {channel.message_encoding for _, channel, _ in found} == {"cdr"}
    kinds = {(schema.name, schema.encoding) for schema, _, _ in found if schema is not None}
    names = ("sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage")
    assert kinds == {(name, "ros2msg") for name in names}


def test_qos_is_a_list_of_integers(tmp_path: Path) -> None:
    found = messages(written(tmp_path, dense_scan()))
    forever = {"sec": 9223372036, "nsec": 854775807}
    for _, channel, _ in found:
        latched = channel.topic == "/tf_static"
        assert yaml.safe_load(channel.metadata["offered_qos_profiles"]) == [
            {
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
        ]


def test_static_transforms_are_the_poses(tmp_path: Path) -> None:
    [message] = decoded(written(tmp_path, dense_scan()), "/tf_static")
    frames = [(item.header.frame_id, item.child_frame_id) for item in message.transforms]
    assert frames == [("base_link", "left"), ("base_link", "right")]
    right = message.transforms[1].transform
    assert (right.translation.x, right.translation.y, right.translation.z) == (1.0, 0.0, 2.0)
    turn = (right.rotation.x, right.rotation.y, right.rotation.z, right.rotation.w)
    # A quarter turn about z.
    assert turn == pytest.approx((0, 0, math.sqrt(0.5), math.sqrt(0.5)))


def test_imu_messages_hold_the_samples(tmp_path: Path) -> None:
    first, second = decoded(written(tmp_path, dense_scan()), "/left/imu")
    assert first.header.frame_id == "left_imu"
    assert first.header.stamp.sec == 1_700_000_000
    assert first.header.stamp.nanosec == 99_999_995
    assert first.orientation_covariance[0] == -1.0
    acceleration = second.linear_acceleration
    assert (acceleration.x, acceleration.y, acceleration.z) == (11.0, 12.0, 13.0)
    turn = second.angular_velocity
    assert (turn.x, turn.y, turn.z) == (14.0, 15.0, 16.0)


def test_metadata_and_table_of_scans(tmp_path: Path) -> None:
    path = written(tmp_path, dense_scan())
    with path.open("rb") as file:
        reader = make_reader(file)
        header = reader.get_header()
        assert (header.profile, header.library) == ("ros2", "mlbatch 0.1.0")
        notes = {note.name: note.metadata for note in reader.iter_metadata()}
        [attachment] = reader.iter_attachments()
    assert notes["mlbatch.report"] == {"json": SUMMARY.report_json}
    grid = notes["mlbatch.grid"]
    assert json.loads(grid.pop("sensors")) == ["left", "right"]
    assert grid == {
        "rate_hz": "10",
        "t_init_ns": str(START_NS),
        "slices": "1",
        "timescale": "utc",
        "frame_id": "base_link",
    }
    assert (attachment.name, attachment.data.decode()) == ("scans.csv", SUMMARY.scans_csv)
    assert (tmp_path / "out.mcap.scans.csv").read_text() == SUMMARY.scans_csv


def test_files_are_chunked_and_indexed(tmp_path: Path) -> None:
    # 24 bytes a point: three scans of 1.92 MB end a chunk each, ten of 0.48 MB collect in chunks
    # that end above 4 MiB, after the ninth; the last holds the tenth and an IMU sample.
    large = [dense_scan(index, 80_000) for index in range(3)]
    small = [dense_scan(index, 20_000) for index in range(3, 13)]
    path = written(tmp_path, *large, *small)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [(channel.topic, message) for _, channel, message in reader.iter_messages()]
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    assert statistics.message_count == len(found) == 1 + 3 + 13
    assert statistics.message_start_time == START_NS - 5
    assert statistics.message_end_time == START_NS + 12 * PERIOD_NS
    assert statistics.chunk_count == len(summary.chunk_indexes) == 3 + 2
    clouds = [message.data for topic, message in found if topic == "/points"]
    for data, scan in zip(clouds, [*large, *small], strict=True):
        last = struct.unpack("<fff", data[-25:-13])
        assert last == tuple(scan.xyz[-1].tolist())


def test_records_follow_each_other_without_gaps(tmp_path: Path) -> None:
    path = written(tmp_path, dense_scan(0, 80_000), dense_scan(1, 100))
    with path.open("rb") as file:
        records = list(StreamReader(file, validate_crcs=True).records)
    assert type(records[0]).__name__ == "Header"
    assert type(records[-1]).__name__ == "Footer"
    assert sum(isinstance(record, Message) for record in records) == 6


def test_rosbags_reads_every_message(tmp_path: Path) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel")
    scan = dense_scan()
    with highlevel.AnyReader([written(tmp_path, scan)]) as reader:
        found = {
            connection.topic: reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
        }
    assert set(found) == {"/tf_static", "/points", "/left/imu", "/right/imu"}
    points = np.asarray(found["/points"].data).view("<f4").reshape(-1, 6)
    np.testing.assert_array_equal(points[:, :3], scan.xyz)
    assert found["/tf_static"].transforms[1].child_frame_id == "right"
    assert found["/right/imu"].angular_velocity.z == 6.0


def test_definitions_are_those_of_ros_2(tmp_path: Path) -> None:
    typesys = pytest.importorskip("rosbags.typesys")
    known = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    schemas = [schema for schema, _, _ in messages(written(tmp_path, dense_scan()))]
    texts = {schema.name: schema.data.decode() for schema in schemas if schema is not None}
    assert len(texts) == 3
    for name, text in texts.items():
        parsed = typesys.get_types_from_msg(text, name)
        for part, fields in parsed.items():
            assert fields == known.fielddefs[part], part
        assert text.count("=" * 80) == len(parsed) - 1


def test_split_gives_a_topic_a_sensor(tmp_path: Path) -> None:
    path = written(tmp_path, dense_scan(0), dense_scan(0), split=True)
    topics = {channel.topic for _, channel, _ in messages(path)}
    assert {"/left/points", "/right/points"} < topics
    assert "/points" not in topics


def test_a_run_without_scans_is_a_valid_file(tmp_path: Path) -> None:
    writer = open_writer("mcap", tmp_path / "out.mcap", run_info(), WriterOptions())
    writer.finish(Summary(None, "{}", "index\n"))
    [(_, channel, message)] = messages(tmp_path / "out.mcap")
    assert (channel.topic, message.log_time) == ("/tf_static", 0)


def test_equal_runs_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    files = [written(tmp_path / name, dense_scan(), dense_scan(1)) for name in ("a", "b")]
    assert files[0].read_bytes() == files[1].read_bytes()
