"""Simulated recordings: shipped scenarios, files, messages as other readers see them, laws."""

from __future__ import annotations

import csv
import json
import sqlite3
from pathlib import Path
from typing import Any

import mcap_ros2.reader
import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

import mlbatch
from mlbatch.errors import ExportError, UsageError
from mlbatch.simulate.recording import write_recording
from mlbatch.simulate.scenario import SHIPPED, read_scenario, shipped
from mlbatch.units import STANDARD_GRAVITY
from tests.builders.simulated import (
    Recorded,
    at_true_poses,
    distance_to_scene,
    read_tum,
    record,
    residuals,
    scenario_text,
)

TWO = """\
  - name: left
    model: OS1-16
    columns: 512
    profile: RNG15_RFL8_NIR8
    imu: {gyro_bias: [0.01, -0.02, 0.03], accel_bias: [0.1, 0, -0.2]}
    extrinsics: {translation_m: [0.2, 0.4, 0.3], rotation_rpy_deg: [0, 10, 80]}
  - name: rear
    model: VLP-16
    phase_deg: 100
    extrinsics: {translation_m: [-0.3, 0, 0.4], rotation_rpy_deg: [0, 0, 180]}
"""
IMU = "imu: {rate_hz: 200, topic: /imu/data, gyro_noise: 0.001, gyro_bias: [0.02, 0, -0.01]}\n"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Recorded]:
    """The same drive in each container."""
    text = scenario_text(TWO, more=IMU, duration=0.5)
    folders = {suffix: tmp_path_factory.mktemp(suffix) for suffix in ("pcap", "mcap", "db3")}
    return {suffix: record(folder, text, suffix) for suffix, folder in folders.items()}


@pytest.mark.parametrize("name", ["forest-easy", "forest-hard", "room", "street"])
def test_points_of_shipped_scenarios_lie_on_the_scene(name: str, tmp_path: Path) -> None:
    """Without their standstill; the noise has its six standard deviations."""
    assert name in shipped()
    text = (SHIPPED / f"{name}.yaml").read_text(encoding="utf-8")
    text = text.replace("standstill_s: 2", "standstill_s: 0")
    assert "truth: {topic" not in text or "truth: {topic: /odom}" in text
    text = text.replace("truth: {topic: /odom}\n", "") + "truth: {rate_hz: 1000}\n"
    path = tmp_path / "moving.yaml"
    path.write_text(text, encoding="utf-8")
    scenario = read_scenario(str(path), duration_s=0.35)
    target = tmp_path / "drive.pcap"
    write_recording(scenario, target)
    recorded = Recorded(scenario, target)
    noise_m = max(plan.noise_m for plan in scenario.lidars)
    distances = residuals(recorded, recorded.scans())
    assert len(distances) > 50_000
    assert distances.max() < 5e-3 + 6 * noise_m
    assert np.median(distances) < noise_m


def test_points_of_the_harvester_lie_on_the_scene_or_in_its_leaves(tmp_path: Path) -> None:
    """Beams without a width; without the machine itself, whose box covers its swinging boom."""
    text = (SHIPPED / "harvester-hard.yaml").read_text(encoding="utf-8")
    text = text.replace("standstill_s: 2", "standstill_s: 0").replace("OS0-128", "OS0-32")
    text = text.replace("divergence_deg: 0.35", "divergence_deg: 0") + "truth: {rate_hz: 1000}\n"
    # Fewer plants and points: a minute otherwise.
    for old, new in (("2000", "400"), ("3000", "600"), ("duration_s: 115", "duration_s: 0.4")):
        text = text.replace(old, new)
    recorded = record(tmp_path, text.replace("OS0-32", "OS0-32\n    columns: 512"))
    foliage = recorded.scenario.scene.foliage
    assert foliage is not None
    leaves = points = 0
    for scan in recorded.scans():
        own = scan.xyz.astype(np.float64)
        machine = ((own > [-4, -2.5, 0]) & (own < [8.5, 2.5, 5])).all(axis=1)
        time_ns = np.add(scan.time_ns, scan.start_ns, dtype=np.int64)[~machine]
        world = at_true_poses(own[~machine], time_ns, recorded.truth)
        time_s = (time_ns - recorded.scenario.start_ns) / 1e9
        away = distance_to_scene(recorded.scenario.scene, world, time_s)
        in_air = world[away > 5e-3 + 6 * 0.01]
        # In the ellipsoid of a crown, wherever the wind has moved it, and 6 cm of noise around.
        offset = in_air[:, None] - foliage.centre_m
        wide = foliage.radius_m + foliage.wind_m + 0.06
        share = (offset[..., :2] ** 2).sum(axis=2) / wide**2
        share += (offset[..., 2] / (foliage.half_height_m + 0.06)) ** 2
        assert (share <= 1.0).any(axis=1).all()
        leaves += len(in_air)
        points += len(world)
    assert points > 5_000
    assert 0.1 < leaves / points < 0.9


NAMES = ["forest-easy", "forest-hard", "harvester-easy", "harvester-hard", "room", "street"]


def test_all_shipped_scenarios_are_tested() -> None:
    assert list(shipped()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_shipped_scenarios_last_over_a_minute(name: str) -> None:
    assert read_scenario(name, duration_s=60.0).duration_s == 60.0


def test_every_container_gives_the_same_scans(bags: dict[str, Recorded]) -> None:
    first, *others = (recorded.scans() for recorded in bags.values())
    assert len(first) >= 4
    for scans in others:
        assert [scan.start_ns for scan in scans] == [scan.start_ns for scan in first]
        for one, other in zip(scans, first, strict=True):
            np.testing.assert_array_equal(one.xyz, other.xyz)
            np.testing.assert_array_equal(one.time_ns, other.time_ns)


def test_files_have_their_names(bags: dict[str, Recorded]) -> None:
    names = {path.name for path in bags["mcap"].path.parent.iterdir()} - {"scenario.yaml"}
    sides = {"drive.rig.yaml", "drive.truth.tum", "drive.imu.csv", "drive.left.json"}
    assert names == {"drive.mcap", *sides}


def test_truth_covers_the_drive(bags: dict[str, Recorded]) -> None:
    recorded = bags["pcap"]
    stamps, rows = read_tum(recorded.truth)
    assert stamps[0] == recorded.scenario.start_ns
    assert stamps[-1] - stamps[0] == 500_000_000
    assert (np.diff(stamps) == 1_000_000).all()
    np.testing.assert_allclose(np.linalg.norm(rows[:, 3:], axis=1), 1.0, atol=1e-8)
    # The first waypoint: place, and 10 degrees of yaw with no roll or pitch yet.
    np.testing.assert_allclose(rows[0, :3], [-1.0, -0.5, 1.2], atol=1e-9)
    half = np.radians(5.0)
    np.testing.assert_allclose(rows[0, 3:], [0, 0, np.sin(half), np.cos(half)], atol=1e-6)


def test_messages_as_another_reader_sees_them(bags: dict[str, Recorded]) -> None:
    recorded = bags["mcap"]
    counts: dict[str, int] = {}
    transforms = []
    samples = []
    logged = []
    for message in mcap_ros2.reader.read_ros2_messages(str(recorded.path)):
        topic = message.channel.topic
        counts[topic] = counts.get(topic, 0) + 1
        logged.append(message.log_time_ns)
        if topic == "/tf":
            (one,) = message.ros_msg.transforms
            assert (one.header.frame_id, one.child_frame_id) == ("world", "base_link")
            move, turn = one.transform.translation, one.transform.rotation
            transforms.append([move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w])
        elif topic == "/imu/data":
            rate = message.ros_msg.angular_velocity
            samples.append([rate.x, rate.y, rate.z])
    assert logged == sorted(logged)
    # 0.5 s: 10 revolutions a second of 32 packets, 100 samples of the lidar's IMU a second.
    assert counts["/left/lidar_packets"] == 160
    assert counts["/left/imu_packets"] == 50
    assert counts["/left/metadata"] == 1
    assert counts["/imu/data"] == 100
    # The place of that IMU.
    assert counts["/tf_static"] == 1
    # 754 packets a second, in messages of a tenth of a second.
    assert counts["/rear/velodyne_packets"] == 5
    _, rows = read_tum(recorded.truth)
    np.testing.assert_allclose(transforms, rows, atol=1e-8)
    # Bias and noise: the same samples are in the table.
    with recorded.path.with_name("drive.imu.csv").open() as file:
        table = [[float(value) for value in row[1:4]] for row in list(csv.reader(file))[1:]]
    np.testing.assert_allclose(samples, table, atol=1e-7)


def test_a_database_as_another_reader_sees_it(bags: dict[str, Recorded]) -> None:
    recorded = bags["db3"]
    store = get_typestore(Stores.ROS2_HUMBLE)
    with sqlite3.connect(recorded.path) as base:
        topics = {row[0]: row[1:] for row in base.execute("SELECT id, name, type FROM topics")}
        rows = base.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
    base.close()
    assert set(topics.values()) == {
        ("/left/metadata", "std_msgs/msg/String"),
        ("/left/lidar_packets", "ouster_sensor_msgs/msg/PacketMsg"),
        ("/left/imu_packets", "ouster_sensor_msgs/msg/PacketMsg"),
        ("/rear/velodyne_packets", "velodyne_msgs/msg/VelodyneScan"),
        ("/imu/data", "sensor_msgs/msg/Imu"),
        ("/tf", "tf2_msgs/msg/TFMessage"),
        ("/tf_static", "tf2_msgs/msg/TFMessage"),
    }
    times = [row[1] for row in rows]
    assert times == sorted(times)
    poses = []
    for number, _, data in rows:
        if topics[number][0] == "/tf":
            message: Any = store.deserialize_cdr(data, topics[number][1])
            (one,) = message.transforms
            poses.append([one.transform.translation.x, one.transform.rotation.z])
    _, expected = read_tum(recorded.truth)
    np.testing.assert_allclose(poses, expected[:, [0, 5]], atol=1e-8)


def test_odometry_is_another_form_of_the_truth(tmp_path: Path) -> None:
    text = scenario_text(TWO).replace("rate_hz: 1000", "rate_hz: 50, topic: /odom, frame: map")
    recorded = record(tmp_path, text, "mcap")
    rows, twists = [], []
    for message in mcap_ros2.reader.read_ros2_messages(str(recorded.path), topics=["/odom"]):
        one = message.ros_msg
        assert (one.header.frame_id, one.child_frame_id) == ("map", "base_link")
        place, turn = one.pose.pose.position, one.pose.pose.orientation
        rows.append([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
        linear = one.twist.twist.linear
        twists.append([linear.x, linear.y, linear.z])
    _, expected = read_tum(recorded.truth)
    np.testing.assert_allclose(rows, expected, atol=1e-8)
    # Speeds are those of the positions, whatever the frame: 50 Hz differences.
    speed = np.linalg.norm((expected[2:, :3] - expected[:-2, :3]) * 25, axis=1)
    np.testing.assert_allclose(np.linalg.norm(twists[1:-1], axis=1), speed, rtol=0.01)


def test_an_imu_at_rest_has_bias_and_noise_of_the_scenario(tmp_path: Path) -> None:
    text = scenario_text(
        TWO,
        motion="",
        duration=20.0,
        more="imu: {rate_hz: 500, gyro_noise: 0.01, accel_noise: 0.1, "
        "gyro_bias: [0.02, 0, -0.01], accel_bias: [0.3, -0.2, 0]}\n",
    ).replace("rate_hz: 1000", "rate_hz: 10")
    # Lidars that send little.
    text = text.partition("sensors:\n")[0] + (
        "sensors:\n  - {name: one, model: OS1-16, columns: 512, rate_hz: 10, max_range_m: 1}\n"
    )
    recorded = record(tmp_path, text)
    table = np.loadtxt(recorded.path.with_name("drive.imu.csv"), delimiter=",", skiprows=1)
    assert len(table) == 10_000
    stamps = recorded.path.with_name("drive.imu.csv").read_text().splitlines()[1:]
    stamp_ns = [int(line.partition(",")[0]) for line in stamps]
    assert set(np.diff(stamp_ns)) == {2_000_000}
    expected = [0.02, 0, -0.01, 0.3, -0.2, STANDARD_GRAVITY]
    limits = np.array([0.01] * 3 + [0.1] * 3) * 4 / np.sqrt(len(table))
    assert (np.abs(table[:, 1:].mean(axis=0) - expected) < limits).all()
    np.testing.assert_allclose(table[:, 1:4].std(axis=0), 0.01, rtol=0.05)
    np.testing.assert_allclose(table[:, 4:].std(axis=0), 0.1, rtol=0.05)


def test_ouster_imu_packets_become_messages_in_the_frame_of_the_lidar(tmp_path: Path) -> None:
    """At rest with 10 degrees of pitch and yaw: gravity, bias, at the lidar's own clock."""
    text = scenario_text(TWO.replace("imu: {", "imu: {accel_noise: 0, gyro_noise: 0, "), motion="")
    recorded = record(tmp_path, text)
    target = tmp_path / "scans.mcap"
    mlbatch.convert(recorded.path, output=target, rig=recorded.rig)
    up = recorded.scenario.lidars[0].body_from_sensor[2, :3] * STANDARD_GRAVITY
    seen = 0
    for message in mcap_ros2.reader.read_ros2_messages(str(target), topics=["/left/imu"]):
        force, rate = message.ros_msg.linear_acceleration, message.ros_msg.angular_velocity
        np.testing.assert_allclose(
            [force.x, force.y, force.z], up + np.array([0.1, 0, -0.2]), atol=1e-5
        )
        np.testing.assert_allclose([rate.x, rate.y, rate.z], [0.01, -0.02, 0.03], atol=1e-6)
        seen += 1
    assert seen > 5


@pytest.mark.parametrize("suffix", ["pcap", "mcap", "db3"])
def test_the_same_seed_gives_the_same_bytes(suffix: str, tmp_path: Path) -> None:
    made = []
    for number, seed in enumerate((7, 7, 8)):
        folder = tmp_path / str(number)
        folder.mkdir()
        text = scenario_text(TWO, more=IMU).replace("seed: 7", f"seed: {seed}")
        made.append(record(folder, text, suffix).path.read_bytes())
    assert made[0] == made[1]
    assert made[0] != made[2]


def test_a_longer_recording_begins_like_a_shorter_one(tmp_path: Path) -> None:
    """Nothing depends on the end, so recordings of any length need the same memory."""
    text = scenario_text(TWO, duration=0.5)
    (tmp_path / "s").mkdir()
    (tmp_path / "l").mkdir()
    short = record(tmp_path / "s", text.replace("duration_s: 0.5", "duration_s: 0.25"))
    long = record(tmp_path / "l", text)
    # The last packets of the short one were under way when it ended.
    head = short.path.read_bytes()[:-60_000]
    assert len(head) > 200_000
    assert long.path.read_bytes().startswith(head)


def test_dropouts_and_losses_have_the_shares_of_the_scenario(tmp_path: Path) -> None:
    lines = "  - {name: one, model: VLP-16, dropout: 0.2, loss: 0.1}\n"
    source = tmp_path / "scenario.yaml"
    source.write_text(scenario_text(lines, duration=2.0), encoding="utf-8")
    (figures,) = write_recording(read_scenario(str(source)), tmp_path / "drive.pcap").lidars
    # In a closed room every shot returns.
    assert figures.returns / figures.shots == pytest.approx(0.8, abs=0.005)
    assert figures.lost / figures.packets == pytest.approx(0.1, abs=0.03)
    mlbatch.convert(
        tmp_path / "drive.pcap", output=tmp_path / "out", rig=tmp_path / "drive.rig.yaml"
    )
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert abs(report["sensors"][0]["packets"]["lost"] - figures.lost) <= 3


def test_verify_accepts_what_convert_makes(bags: dict[str, Recorded], tmp_path: Path) -> None:
    target = tmp_path / "scans.mcap"
    recorded = bags["mcap"]
    mlbatch.convert(recorded.path, output=target, rig=recorded.rig)
    assert mlbatch.verify(target).ok


def test_nothing_is_left_when_a_file_exists(tmp_path: Path) -> None:
    (tmp_path / "drive.truth.tum").write_text("mine")
    with pytest.raises(ExportError, match=r"drive\.truth\.tum: expected a new output"):
        record(tmp_path, scenario_text(TWO))
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"drive.truth.tum", "scenario.yaml"}
    assert (tmp_path / "drive.truth.tum").read_text() == "mine"


def test_an_unknown_container_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"-o: expected a name that ends with .pcap"):
        record(tmp_path, scenario_text(TWO), "bag")


def test_documented_scenario_is_one(tmp_path: Path) -> None:
    """The file in docs/simulate.md can be read as it is there."""
    page = (Path(__file__).parents[2] / "docs" / "simulate.md").read_text(encoding="utf-8")
    block = page.partition("```yaml\n")[2].partition("```")[0]
    assert yaml.safe_load(block)["schema"] == "mlbatch.scenario/1"
    path = tmp_path / "page.yaml"
    path.write_text(block, encoding="utf-8")
    assert len(read_scenario(str(path)).lidars) == 2
