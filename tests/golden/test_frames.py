"""The tree of frames in /tf_static: sensors, their IMUs, and what forwarded messages name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from mlbatch.ros.messages import decode_transforms
from mlbatch.types import Topic
from mlbatch.verification import Verdict, verify
from tests.builders.bags import Body, Recorded, fixture_messages, transforms_message
from tests.builders.mcaps import write_mcap
from tests.builders.rewritten_outputs import Sent, mcap, only
from tests.builders.run import TWO_LIDARS, command
from tests.builders.sessions import SMALL, Shell, Unit, write_session
from tests.builders.written_bags import Read, read_back

OUTPUTS = {"mcap": "scans.mcap", "rosbag1": "scans.bag", "rosbag2": "scans"}
CAPTURE = TWO_LIDARS / "two_lidars.pcap"
NO_TURN = (0.0, 0.0, 0.0, 1.0)
# An antenna 0.5 m behind and 1.5 m above an IMU that is 0.1 m above the body origin.
TREE = [
    ("base_link", "imu", (0.0, 0.0, 0.1), NO_TURN),
    ("imu", "gps", (-0.5, 0.0, 1.5), NO_TURN),
    ("elsewhere", "arm", (1.0, 0.0, 0.0), NO_TURN),
]


def _transforms(messages: list[Read]) -> dict[tuple[str, str], list[float]]:
    """Translation and quaternion by parent and child."""
    (message,) = [one.value for one in messages if one.topic == "/tf_static"]
    found = {}
    for one in message.transforms:
        move, turn = one.transform.translation, one.transform.rotation
        values = [move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w]
        found[one.header.frame_id, one.child_frame_id] = values
    return found


def _limit(verdict: Verdict, name: str) -> str:
    (check,) = [check for check in verdict.checks if check.name == name]
    return check.limit


@pytest.mark.parametrize("name", OUTPUTS)
def test_imus_are_below_their_sensors(name: str, tmp_path: Path) -> None:
    target = tmp_path / OUTPUTS[name]
    rig = TWO_LIDARS / "rig.yaml"
    words = ("convert", CAPTURE, "--rig", rig, "-o", target, "--format", name)
    assert command(*words).code == 0
    messages = read_back(target)
    found = _transforms(messages)
    assert [child for _, child in found] == ["left", "right", "left_imu", "right_imu"]
    for sensor in ("left", "right"):
        # Of the metadata: 16 numbers row by row, mm.
        metadata: dict[str, Any] = json.loads((TWO_LIDARS / f"{sensor}.json").read_text())
        stated = metadata["imu_intrinsics"]["imu_to_sensor_transform"]
        pose = np.reshape(stated, (4, 4))
        assert np.array_equal(pose[:3, :3], np.eye(3))
        expected = [*(pose[:3, 3] / 1000).tolist(), *NO_TURN]
        assert found[sensor, f"{sensor}_imu"] == pytest.approx(expected, abs=1e-12)
    named = {one.value.header.frame_id for one in messages if one.topic != "/tf_static"}
    assert named == {"base_link", "left_imu", "right_imu"}
    verdict = verify(target)
    assert verdict.ok, verdict.violations
    assert (_limit(verdict, "frames"), _limit(verdict, "tf_static")) == ("", "")


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_lidar_in_its_own_frame_is_the_root(name: str, shell: Shell, tmp_path: Path) -> None:
    unit = Unit()
    capture = write_session(tmp_path, unit, more=unit.imu_records(20))
    target = tmp_path / OUTPUTS[name]
    assert shell("convert", capture, "-o", target, "--format", name).code == 0
    assert list(_transforms(read_back(target))) == [("ouster_111", "ouster_111_imu")]
    verdict = verify(target)
    assert verdict.ok, verdict.violations


def test_the_rotation_of_an_imu_maps_it_into_the_sensor(shell: Shell, tmp_path: Path) -> None:
    rows = [[0.0, -1.0, 0.0, 6.253], [1.0, 0.0, 0.0, -11.775], [0.0, 0.0, 1.0, 7.645]]
    pose_mm = [*rows[0], *rows[1], *rows[2], 0.0, 0.0, 0.0, 1.0]
    capture = write_session(tmp_path, Unit(spec=replace(SMALL, imu_to_sensor_mm=pose_mm)))
    target = tmp_path / "scans.mcap"
    assert shell("convert", capture, "-o", target).code == 0
    found = _transforms(read_back(target))
    # x of the IMU is y of the sensor: a positive turn by 90 degrees about z.
    half = 0.5**0.5
    expected = [0.006253, -0.011775, 0.007645, 0.0, 0.0, half, half]
    assert found["ouster_111", "ouster_111_imu"] == pytest.approx(expected, abs=1e-12)


def _bag(folder: Path, *more: Recorded) -> Path:
    messages = sorted([*fixture_messages("cdr"), *more], key=lambda one: one.log_ns)
    return write_mcap(folder / "drive.mcap", messages)


def _fix(stamp_ns: int) -> Recorded:
    """A sensor_msgs/NavSatFix."""
    body = Body("cdr").header(stamp_ns, "gps").put("b", 0).put("H", 1)
    body.put("d", 60.0, 24.0, 30.0, *[0.0] * 9).put("B", 0)
    return Recorded("/gps/fix", "sensor_msgs/NavSatFix", stamp_ns, body.done())


def test_frames_of_forwarded_messages_are_those_of_the_recording(tmp_path: Path) -> None:
    first_ns = fixture_messages("cdr")[0].log_ns
    tree = Recorded(
        "/tf_static", "tf2_msgs/TFMessage", first_ns, transforms_message("cdr", TREE), latched=True
    )
    fix = _fix(first_ns + 300_000_000)
    target = tmp_path / "scans.mcap"
    bag = _bag(tmp_path, tree, fix)
    done = command("convert", bag, "-o", target, "--pass", "/gps/*")
    assert (done.code, done.err) == (0, "")
    with target.open("rb") as file:
        data = [m.data for _, c, m in make_reader(file).iter_messages(["/tf_static"])]
    assert len(data) == 1
    edges = decode_transforms(Topic("/tf_static", "tf2_msgs/TFMessage", "cdr"), data[0])
    places = {child: list(xyz) for parent, child, xyz, _ in edges if parent == "base_link"}
    assert places["imu"] == pytest.approx([0.0, 0.0, 0.1])
    assert places["gps"] == pytest.approx([-0.5, 0.0, 1.6])
    assert "left/os_sensor" in places
    # Nothing connects it with the body.
    assert "arm" not in places
    verdict = verify(target)
    assert verdict.ok, verdict.violations
    assert _limit(verdict, "frames") == ""
    # Without forwarded messages no frame of the recording is needed.
    npz = command("convert", bag, "-o", tmp_path / "scans")
    assert (npz.code, npz.err) == (0, "")


def test_frames_that_the_recording_does_not_place_are_a_note(tmp_path: Path) -> None:
    fix = _fix(fixture_messages("cdr")[0].log_ns + 300_000_000)
    target = tmp_path / "scans.mcap"
    done = command("convert", _bag(tmp_path, fix), "-o", target, "--pass", "/gps/*")
    assert (done.code, done.err) == (0, "")
    verdict = verify(target)
    assert verdict.ok, verdict.violations
    text = "recorded messages name frames that are not there: gps of /gps/fix, imu of /imu/data"
    assert _limit(verdict, "frames") == text


def test_verify_finds_a_circle_of_frames(tmp_path: Path) -> None:
    target = tmp_path / "scans.mcap"
    rig = TWO_LIDARS / "rig.yaml"
    assert command("convert", CAPTURE, "--rig", rig, "-o", target).code == 0

    def circle(sent: Sent) -> list[Sent]:
        edges = transforms_message(
            "cdr",
            [
                ("base_link", "left", (0.0, 0.0, 0.0), NO_TURN),
                ("a", "b", (0.0, 0.0, 0.0), NO_TURN),
                ("b", "a", (0.0, 0.0, 0.0), NO_TURN),
            ],
        )
        return [replace(sent, data=edges)]

    mcap(only("/tf_static", 0, circle))(target)
    found = [one.where for one in verify(target).violations if one.check == "tf_static"]
    assert any("frames without a root" in where for where in found)
