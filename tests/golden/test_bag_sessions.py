"""Whole sessions in bags: everything that a conversion needs is in the recording."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from mlbatch.rig.rig import read_rig
from tests.builders.mcaps import write_mcap
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import Form, write_folder, write_rosbag2
from tests.builders.run import TWO_LIDARS, Outcome, command, load, scan_files
from tests.builders.sessions import NS_PER_MS, NS_PER_S, SMALL, Unit, twin
from tests.builders.sessions_of_bags import session_of, split_at, unit_messages
from tests.builders.two_lidars import LEFT, RIGHT, body_from_sensor

Write = Callable[[Path], Path]
# SOURCE.md of the fixture: seven whole windows, 512 columns of each lidar in each.
WHOLE_SCANS = 7
COLUMNS = 1024
SESSIONS: dict[str, Write] = {
    "MCAP": lambda folder: write_mcap(folder / "drive.mcap", session_of()),
    "db3 with types": lambda folder: write_rosbag2(
        folder / "drive.db3", session_of(), Form(schema=4)
    ),
    "db3 without types": lambda folder: write_rosbag2(folder / "drive.db3", session_of()),
    "split db3": lambda folder: write_folder(folder / "drive", split_at(session_of(), 3)),
    "ROS 1": lambda folder: write_rosbag1(folder / "drive.bag", session_of("ros1"), "lz4"),
}


@dataclass(frozen=True, slots=True)
class Made:
    """An output in a folder of npz files."""

    outcome: Outcome
    folder: Path

    @property
    def report(self) -> dict[str, Any]:
        """Its report."""
        found: dict[str, Any] = json.loads((self.folder / "report.json").read_text())
        return found

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """Codes and sensors of its warnings."""
        return [(one["code"], one["sensor"]) for one in self.report["warnings"]]

    @property
    def files(self) -> dict[str, bytes]:
        """All but the report, which holds timings and paths."""
        names = [p.name for p in self.folder.iterdir() if p.name != "report.json"]
        return {name: (self.folder / name).read_bytes() for name in sorted(names)}


def convert(output: Path, *words: str | Path) -> Made:
    """Convert to npz; must succeed."""
    done = command("convert", *words, "-o", output)
    assert done.code == 0, done.err
    return Made(done, output)


@pytest.fixture(scope="module")
def mcap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session as an MCAP file."""
    return SESSIONS["MCAP"](tmp_path_factory.mktemp("mcap"))


@pytest.fixture(scope="module")
def plain(mcap: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """What it gives without options."""
    return convert(tmp_path_factory.mktemp("plain") / "scans", mcap)


def test_two_lidars_need_no_options(plain: Made) -> None:
    assert plain.outcome.err == ""
    assert len(scan_files(plain.folder)) == WHOLE_SCANS
    for sensor, lidar in zip(plain.report["sensors"], (LEFT, RIGHT), strict=True):
        assert sensor["name"] == lidar.name
        assert sensor["stream"] == f"/{lidar.name}/ouster/lidar_packets"
        assert sensor["imu_packets"] == 85
        extrinsics = sensor["extrinsics"]
        assert extrinsics["source"] == f"tf_static: base_link -> {lidar.name}/os_sensor"
        # Quaternions of float64 in the bag.
        assert np.abs(extrinsics["body_from_sensor"] - body_from_sensor(lidar)).max() < 1e-12
    assert plain.report["messages"] == [
        {"topic": "/imu/data", "read": 85, "written": 0, "dropped": {"no_place": 85}}
    ]


def test_scans_are_those_of_the_capture_with_its_rig(plain: Made, tmp_path: Path) -> None:
    rig = (TWO_LIDARS / "rig.yaml").read_text(encoding="utf-8")
    for name in ("left.json", "right.json"):
        shutil.copy(TWO_LIDARS / name, tmp_path)
    (tmp_path / "rig.yaml").write_text(rig[: rig.index("# The machine's")], encoding="utf-8")
    pcap = TWO_LIDARS / "two_lidars.pcap"
    capture = convert(tmp_path / "scans", pcap, "--rig", tmp_path / "rig.yaml")
    for one, other in zip(scan_files(plain.folder), scan_files(capture.folder), strict=True):
        left, right = load(one), load(other)
        assert left["column_stamp_ns"].shape == (COLUMNS,)
        for key in left.keys() - {"xyz"}:
            assert np.array_equal(left[key], right[key]), key
        # Quaternions round the rotation differently: by less than a step of float32 at 20 m.
        xyz_m, expected_m = (np.asarray(scan["xyz"], np.float64) for scan in (left, right))
        assert np.abs(xyz_m - expected_m).max() < 2e-6


@pytest.mark.parametrize("name", [name for name in SESSIONS if name != "MCAP"])
def test_every_container_teaches_the_same(name: str, plain: Made, tmp_path: Path) -> None:
    made = convert(tmp_path / "scans", SESSIONS[name](tmp_path))
    assert made.outcome.err == ""
    assert made.files == plain.files


def test_split_files_may_be_given_one_by_one(plain: Made, tmp_path: Path) -> None:
    parts = [
        write_rosbag2(tmp_path / f"{number}.db3", part)
        for number, part in enumerate(split_at(session_of(), 3))
    ]
    # Times decide, not names or order.
    assert convert(tmp_path / "scans", *reversed(parts)).files == plain.files


def test_packets_in_a_capture_and_the_rest_in_a_bag(plain: Made, tmp_path: Path) -> None:
    shutil.copy(TWO_LIDARS / "two_lidars.pcap", tmp_path / "drive.pcap")
    others = [one for one in session_of() if "packets" not in one.topic]
    bag = write_rosbag2(tmp_path / "knows.db3", others)
    made = convert(tmp_path / "scans", tmp_path / "drive.pcap", bag)
    assert made.outcome.err == ""
    sources = [sensor["extrinsics"]["source"] for sensor in made.report["sensors"]]
    assert sources == [
        "tf_static: base_link -> left/os_sensor",
        "tf_static: base_link -> right/os_sensor",
    ]
    for one, other in zip(scan_files(made.folder), scan_files(plain.folder), strict=True):
        assert np.array_equal(load(one)["xyz"], load(other)["xyz"])


def imu_of(path: Path) -> list[tuple[int, bytes]]:
    """(log time, data) of the messages on /imu/data."""
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(["/imu/data"])
        return [(message.log_time, message.data) for _, _, message in found]


def test_imu_messages_are_written_at_their_own_stamps(mcap: Path, tmp_path: Path) -> None:
    done = command("convert", mcap, "-o", tmp_path / "scans.mcap")
    assert (done.code, done.err) == (0, "")
    sent = [one for one in session_of() if one.topic == "/imu/data"]
    # Stamp and log time are the same there.
    assert imu_of(tmp_path / "scans.mcap") == [(one.log_ns, one.data) for one in sent]


def test_arrival_times_of_single_packets_are_their_log_times(tmp_path: Path) -> None:
    unit = replace(Unit(), host_ns=3 * NS_PER_S)
    bag = write_rosbag2(tmp_path / "drive.db3", unit_messages(unit, "roof"))
    by_host = convert(tmp_path / "host", bag, "--clock", "host", "--keep-partial")
    stamps = np.concatenate([load(p)["column_stamp_ns"] for p in scan_files(by_host.folder)])
    # A packet's last column has the packet's arrival; a turn of 0.1 s has 512 columns.
    arrivals = [host_ns for host_ns, _ in unit.payloads]
    assert set(arrivals) <= set(stamps.tolist())
    assert stamps.max() == arrivals[-1]
    assert stamps.min() > arrivals[0] - 4 * NS_PER_MS


@pytest.mark.parametrize("name", ["MCAP", "split db3", "ROS 1"])
def test_the_rig_of_inspect_gives_the_same_scans(name: str, plain: Made, tmp_path: Path) -> None:
    bag = SESSIONS[name](tmp_path)
    rig = tmp_path / "rig.yaml"
    assert command("inspect", bag, "--write-rig", rig).code == 0
    assert "metadata:" not in rig.read_text(encoding="utf-8")
    made = convert(tmp_path / "scans", bag, "--rig", rig)
    assert made.outcome.err == ""
    assert made.files == plain.files


def test_packets_without_serial_number_go_by_their_topics(tmp_path: Path) -> None:
    old = replace(Unit(), spec=replace(SMALL, profile="LEGACY"))
    other = replace(twin(old, 222), range_mm=6000)
    messages = sorted(
        [*unit_messages(old, "front"), *unit_messages(other, "rear")], key=lambda one: one.log_ns
    )
    bag = write_mcap(tmp_path / "drive.mcap", messages)
    rig = tmp_path / "rig.yaml"
    assert command("inspect", bag, "--write-rig", rig).code == 0
    topics = [sensor.stream.topic for sensor in read_rig(rig).sensors if sensor.stream]
    assert topics == ["/front/ouster/lidar_packets", "/rear/ouster/lidar_packets"]
    made = convert(tmp_path / "scans", bag, "--rig", rig, "--identity-extrinsics")
    assert [sensor["name"] for sensor in made.report["sensors"]] == ["front", "rear"]
    scan = load(scan_files(made.folder)[0])
    for lidar_id, range_m in enumerate((4.0, 6.0)):
        assert set(scan["range_m"][scan["lidar_id"] == lidar_id].tolist()) == {range_m}
