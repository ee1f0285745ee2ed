"""Mistakes with bags: one line, no traceback."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.simulate.ouster.encode import metadata_json
from tests.builders.bags import Body, Recorded, transforms_message
from tests.builders.mcaps import write_mcap
from tests.builders.points import XYZ, cloud_message
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_folder, write_rosbag2
from tests.builders.sessions import SMALL, Shell, Unit
from tests.builders.sessions_of_bags import (
    description,
    frame_message,
    session_of,
    split_at,
    unit_messages,
    urdf,
)
from tests.builders.transcripts import transcripts

BAG_MISTAKES = transcripts("bags")
STILL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs of all mistakes."""
    folder = tmp_path_factory.mktemp("bags")
    _write_sessions(folder)
    _write_rigs(folder)
    _write_wrong_files(folder)
    (folder / "old").mkdir()
    (folder / "old" / "metadata.yaml").touch()
    (folder / "old.bag").touch()
    return folder


def _write_sessions(folder: Path) -> None:
    one = unit_messages(Unit(), "roof")
    write_mcap(folder / "drive.mcap", session_of())
    write_folder(folder / "bag", split_at(session_of(), 2))
    write_rosbag1(folder / "drive.bag", session_of("ros1"))
    write_rosbag2(folder / "unmounted.db3", session_of(without="tf_static"))
    write_rosbag2(folder / "bare.db3", one[1:])
    write_rosbag2(folder / "stranger.db3", [_metadata(one[0], 999), *one[1:]])
    write_rosbag2(folder / "garbage.db3", [_text(one[0], "not json"), *one[1:]])
    whole = session_of()
    contrary = [description(urdf(0.35), whole[0].log_ns), *whole]
    write_mcap(folder / "contrary.mcap", contrary)
    write_mcap(folder / "moving.mcap", [*session_of(without="tf_static"), *_moving(whole)])
    frame = Recorded("/roof/ouster/frames", "hesai_ros_driver/UdpFrame", one[-1].log_ns, b"")
    frame = replace(frame, data=frame_message(Unit()))
    write_rosbag2(folder / "frames.db3", [one[0], frame])
    cloud = Recorded("/points", "sensor_msgs/PointCloud2", one[0].log_ns, bytes(64))
    write_rosbag2(folder / "clouds.db3", [cloud])
    timeless = replace(cloud, data=cloud_message(XYZ, [(1.0, 2.0, 3.0)]))
    write_rosbag2(folder / "timeless.db3", [timeless])


def _metadata(message: Recorded, serial: int) -> Recorded:
    return _text(message, json.dumps(metadata_json(replace(SMALL, serial=serial))))


def _text(message: Recorded, text: str) -> Recorded:
    return replace(message, data=Body("cdr").text(text).done())


def _moving(messages: list[Recorded]) -> list[Recorded]:
    """The left lidar on a mast that moves."""
    edges = [("base_link", "mast"), ("mast", "left/os_sensor"), ("base_link", "right/os_sensor")]
    return [
        replace(
            messages[0],
            topic="/tf",
            type="tf2_msgs/TFMessage",
            log_ns=messages[-1].log_ns + number,
            data=transforms_message(
                "cdr", [(a, b, (0.0, 0.0, float(number * (b == "mast"))), STILL) for a, b in edges]
            ),
            latched=False,
        )
        for number in range(2)
    ]


def _write_rigs(folder: Path) -> None:
    rigs = {
        "topic": "{name: left, stream: {topic: /left/ouster/lidar}}",
        "frame": "{name: left, stream: {topic: /left/ouster/lidar_packets}, "
        "extrinsics: {frame: os_lft}}",
        "host": "{name: roof, clock: {source: host}}",
        "one": "{name: left}",
        "both": "{name: left, stream: {topic: /left/ouster/lidar_packets, port: 7502}}",
        "points": "{name: imu, stream: {topic: /imu/data}}",
    }
    for name, text in rigs.items():
        (folder / f"{name}.yaml").write_text(f"sensors:\n- {text}\n", encoding="utf-8")


def _write_wrong_files(folder: Path) -> None:
    (folder / "papers").mkdir()
    (folder / "papers" / "notes.txt").write_text("hello\n", encoding="utf-8")
    (folder / "mixed").mkdir()
    write_mcap(folder / "mixed" / "a.mcap", session_of()[:9])
    write_rosbag2(folder / "mixed" / "a.db3", session_of()[:9])
    (folder / "text.db3").write_text("hello\n", encoding="utf-8")
    (folder / "empty.db3").touch()
    with sqlite3.connect(folder / "other.db3") as connection:
        connection.execute("CREATE TABLE birds(name TEXT)")
    connection.close()
    (folder / "head.mcap").write_bytes((folder / "drive.mcap").read_bytes()[:20])
    (folder / "head.bag").write_bytes((folder / "drive.bag").read_bytes()[:20])
    (folder / "head.db3").write_bytes((folder / "bare.db3").read_bytes()[:5000])


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, place: Path) -> Shell:
    return Shell(monkeypatch, place)


@pytest.mark.parametrize("name", BAG_MISTAKES)
def test_mistake_with_a_bag(shell: Shell, place: Path, name: str) -> None:
    BAG_MISTAKES[name].check(shell, place)
