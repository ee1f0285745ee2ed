"""Poses of lidars against the gravity that their own IMUs measure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from mlbatch.simulate.ouster.encode import imu_packet
from tests.builders.captures import udp_frame
from tests.builders.sessions import NS_PER_MS, Shell, Unit, report_of, write_session

G = 9.80665
UNIT = Unit(turns=25)
LEVEL = (0.0, 0.0, G)
HANGING = (0.0, 0.0, -G)
STILL = (0.0, 0.0, 0.0)

# rotation_rpy_deg of the rig, its body frame, specific force in the sensor, m/s2, rates, rad/s, and
# the angle in the warning.
Triple = Sequence[float]
CASES: dict[str, tuple[Triple, str, Triple, Triple, int | None]] = {
    "level": ([0, 0, 90], "base_link", LEVEL, STILL, None),
    "upside down, as the rig says": ([180, 0, 0], "base_link", HANGING, STILL, None),
    "a slope": ([0, 29, 0], "base_link", LEVEL, STILL, None),
    "a body of an aircraft": ([180, 0, 0], "base_link_frd", LEVEL, STILL, None),
    "a body of a ship": ([0, 0, 0], "imu_ned", HANGING, STILL, None),
    # The rotor turns about the camera's y axis, which points down: z of the lidar is -y.
    "a camera": ([90, 0, 0], "camera_optical", LEVEL, STILL, None),
    "an IMU that is shaken": ([180, 0, 0], "base_link", (0.0, 0.0, 1.06 * G), STILL, None),
    "an IMU that turns": ([180, 0, 0], "base_link", LEVEL, (0.0, 0.0, 0.3), None),
    "upside down, where the rig says upright": ([0, 0, 30], "base_link", HANGING, STILL, 180),
    "upright, with the rig of a hanging lidar": ([180, 0, 0], "base_link", LEVEL, STILL, 180),
    "on its side": ([90, 0, 0], "base_link", LEVEL, STILL, 90),
    "too steep": ([0, 31, 0], "base_link", LEVEL, STILL, 31),
    "an upright body of an aircraft": ([0, 0, 0], "base_link_frd", LEVEL, STILL, 180),
}


def _run(
    shell: Shell, folder: Path, rpy_deg: Triple, body: str, force: Triple, rate: Triple
) -> str:
    """Convert 2.5 s; returns what `inspect` prints of it."""
    records = []
    for number in range(240):
        stamp_ns = UNIT.begin_ns + number * 10 * NS_PER_MS
        payload = imu_packet(UNIT.spec, np.array([stamp_ns]), np.array([force]), np.array([rate]))
        records.append((stamp_ns + UNIT.host_ns, udp_frame(payload, UNIT.ip, dport=7503)[0]))
    drive = write_session(folder / "in", UNIT, more=records)
    rig = folder / "rig.yaml"
    rig.write_text(
        f"body_frame: {body}\n"
        "sensors:\n"
        "- name: top\n"
        "  metadata: in/111.json\n"
        f"  extrinsics: {{translation_m: [0, 0, 1], rotation_rpy_deg: {list(rpy_deg)}}}\n"
    )
    done = shell("convert", drive, "--rig", rig, "-o", folder / "out", "--quiet")
    assert done.code == 0, done.err
    return shell("inspect", drive, "--rig", rig).out


@pytest.mark.parametrize("name", CASES)
def test_poses_that_the_imu_contradicts_have_a_warning(
    shell: Shell, tmp_path: Path, name: str
) -> None:
    rpy_deg, body, force, rate, angle_deg = CASES[name]
    printed = _run(shell, tmp_path, rpy_deg, body, force, rate)
    warnings = report_of(str(tmp_path / "out/report.json"))["warnings"]
    if angle_deg is None:
        assert "gravity" not in printed
        assert warnings == []
        return
    [warning] = warnings
    assert (warning["code"], warning["sensor"]) == ("pose_gravity", "top")
    assert f"upward by the gravity of its IMU, {angle_deg} degrees" in warning["message"]
    assert "its pose (rig) is of another mount or vehicle, or another axis of" in printed


def test_a_sensor_without_a_pose_is_not_checked(shell: Shell, tmp_path: Path) -> None:
    _run(shell, tmp_path, [0, 0, 90], "base_link", LEVEL, STILL)
    done = shell("convert", tmp_path / "in/drive.pcap", "-o", tmp_path / "bare", "--strict")
    assert done.code == 0, done.err
