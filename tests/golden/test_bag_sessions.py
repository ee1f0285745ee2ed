"""Whole sessions in bags: everything that a conversion needs is in the recording."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.builders.mcaps import write_mcap
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import Form, write_folder, write_rosbag2
from tests.builders.run import TWO_LIDARS, command, load, scan_files
from tests.builders.sessions import NS_PER_MS, NS_PER_S, SMALL, Shell, Unit, twin
from tests.builders.sessions_of_bags import session_of, split_at, unit_messages
from tests.builders.transcripts import transcripts

CASES = transcripts("bag_sessions")
# SOURCE.md of the fixture: 512 columns of each lidar in each whole window.
COLUMNS = 1024


def write_all(folder: Path) -> None:
    """The same session in every container, and as a capture; two lidars without serial numbers."""
    write_mcap(folder / "drive.mcap", session_of())
    write_rosbag2(folder / "typed.db3", session_of(), Form(schema=4))
    write_rosbag2(folder / "plain.db3", session_of())
    write_folder(folder / "split", split_at(session_of(), 3))
    write_rosbag1(folder / "drive.bag", session_of("ros1"), "lz4")
    for number, part in enumerate(split_at(session_of(), 3)):
        write_rosbag2(folder / f"{number}.db3", part)
    others = [one for one in session_of() if "packets" not in one.topic]
    write_rosbag2(folder / "knows.db3", others)
    shutil.copy(TWO_LIDARS / "two_lidars.pcap", folder / "drive.pcap")
    old = replace(Unit(), spec=replace(SMALL, profile="LEGACY"))
    other = replace(twin(old, 222), range_mm=6000)
    messages = [*unit_messages(old, "front"), *unit_messages(other, "rear")]
    write_mcap(folder / "legacy.mcap", sorted(messages, key=lambda one: one.log_ns))
    late = replace(Unit(), host_ns=3 * NS_PER_S)
    write_rosbag2(folder / "late.db3", unit_messages(late, "roof"))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all of them, and the conversion of the first."""
    folder = tmp_path_factory.mktemp("bags")
    write_all(folder)
    assert command("convert", folder / "drive.mcap", "-o", folder / "whole", "-q").code == 0
    return folder


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(place, shell, tmp_path)


def test_scans_are_those_of_the_capture_with_its_rig(place: Path, tmp_path: Path) -> None:
    rig = (TWO_LIDARS / "rig.yaml").read_text(encoding="utf-8")
    for name in ("left.json", "right.json"):
        shutil.copy(TWO_LIDARS / name, tmp_path)
    (tmp_path / "rig.yaml").write_text(rig[: rig.index("# The machine's")], encoding="utf-8")
    words = (place / "drive.pcap", "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "scans")
    assert command("convert", *words).code == 0
    files = zip(scan_files(place / "whole"), scan_files(tmp_path / "scans"), strict=True)
    for one, other in files:
        left, right = load(one), load(other)
        assert left["column_stamp_ns"].shape == (COLUMNS,)
        for key in left.keys() - {"xyz"}:
            assert np.array_equal(left[key], right[key]), key
        # Quaternions round the rotation differently: by less than a step of float32 at 20 m.
        xyz_m, expected_m = (np.asarray(scan["xyz"], np.float64) for scan in (left, right))
        assert np.abs(xyz_m - expected_m).max() < 2e-6


def test_imu_messages_are_written_at_their_own_stamps(place: Path, tmp_path: Path) -> None:
    path = tmp_path / "scans.mcap"
    assert command("convert", place / "drive.mcap", "-o", path).code == 0
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(["/imu/data"])
        messages = [(message.log_time, message.data) for _, _, message in found]
    # Stamp and log time are the same there.
    sent = [one for one in session_of() if one.topic == "/imu/data"]
    assert messages == [(one.log_ns, one.data) for one in sent]


def test_arrival_times_of_single_packets_are_their_log_times(place: Path, tmp_path: Path) -> None:
    words = (place / "late.db3", "-o", tmp_path, "--clock", "host", "--keep-partial")
    assert command("convert", *words, "--overwrite").code == 0
    stamps = np.concatenate([load(path)["column_stamp_ns"] for path in scan_files(tmp_path)])
    # A packet's last column has the packet's arrival; a turn of 0.1 s has 512 columns.
    arrivals = [host_ns for host_ns, _ in replace(Unit(), host_ns=3 * NS_PER_S).payloads]
    assert set(arrivals) <= set(stamps.tolist())
    assert stamps.max() == arrivals[-1]
    assert stamps.min() > arrivals[0] - 4 * NS_PER_MS


def test_ranges_of_lidars_without_serial_numbers(place: Path, tmp_path: Path) -> None:
    """4 m and 6 m, by the topics of their packets."""
    rig = tmp_path / "rig.yaml"
    assert command("inspect", place / "legacy.mcap", "--write-rig", rig).code == 0
    words = ("--rig", rig, "--identity-extrinsics", "-o", tmp_path / "scans")
    assert command("convert", place / "legacy.mcap", *words).code == 0
    scan = load(scan_files(tmp_path / "scans")[0])
    for lidar_id, range_m in enumerate((4.0, 6.0)):
        assert set(scan["range_m"][scan["lidar_id"] == lidar_id].tolist()) == {range_m}
