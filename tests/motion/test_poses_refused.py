"""`--deskew` with poses that do not belong to the recording: refused, or counted as none."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from tests.builders.rewritten_outputs import Sent, mcap
from tests.builders.sessions import Shell, arrays, names, report_of
from tests.builders.simulated import Recorded, read_tum, record, scenario_text
from tests.motion.test_constant_velocity import BOXES
from tests.motion.test_wall import MOTION, SCENE, SENSORS

MS = 1_000_000
S = 1000 * MS
# An IMU so quiet that its noise and its biases in degrees/s pass for a standstill.
QUIET = (
    "imu: {rate_hz: 200, gyro_noise: 0.0003, accel_noise: 0.02, gyro_bias: [0.001, -0.002, 0.001], "
    "accel_bias: [0.05, -0.03, 0.04], extrinsics: {translation_m: [0.3, 0.2, -0.1]}}\n"
)
# The doubles at the end of a sensor_msgs/Imu: orientation, covariance, angular velocity,
# covariance, acceleration, covariance.
TAIL = 37 * 8
RATE, FORCE = slice(13, 16), slice(25, 28)
DRIVE_S = 6.5
# About z by 90 degrees, seen by all samples.
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
Change = Callable[[int, F64Array], int | None]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    motion = MOTION.replace("  sway:", "    - [5.5, 0.5, 4.5, 1.0, 200]\n  sway:")
    sensors = SENSORS.replace("noise_m: 0", "noise_m: 0.01")
    text = scenario_text(sensors, scene=SCENE + BOXES, motion=motion, duration=DRIVE_S, more=QUIET)
    return record(tmp_path_factory.mktemp("poses"), text, "mcap")


def changed(drive: Recorded, change: Change) -> str:
    """A copy; change: takes the time of a sample (ns since the start) and its 37 values, changes
    these, and returns by how much to change its stamp (ns), or None to leave it out.
    """
    shutil.copy(drive.path, "drive.mcap")
    first_ns: list[int] = []

    def of_sample(sent: Sent) -> list[Sent]:
        if sent.topic != "/imu/data":
            return [sent]
        words = np.frombuffer(sent.data, "<u4", 2, 4)
        stamp_ns = int(words[0]) * S + int(words[1])
        first_ns.append(stamp_ns)
        values = np.frombuffer(sent.data[-TAIL:], "<f8").copy()
        shift_ns = change(stamp_ns - first_ns[0], values)
        if shift_ns is None:
            return []
        head = np.array(divmod(stamp_ns + shift_ns, S), "<u4").tobytes()
        data = sent.data[:4] + head + sent.data[12:-TAIL] + values.astype("<f8").tobytes()
        return [replace(sent, data=data)]

    mcap(of_sample)(Path("drive.mcap"))
    return f"convert drive.mcap --rig {drive.rig}"


def scaled(_: int, values: F64Array) -> int:
    values[RATE] *= 180 / math.pi
    return 0


def swapped(_: int, values: F64Array) -> int:
    values[RATE] = values[RATE][[1, 0, 2]]
    return 0


def turned(_: int, values: F64Array) -> int:
    values[RATE], values[FORCE] = TURNED @ values[RATE], TURNED @ values[FORCE]
    return 0


def lying(_: int, values: F64Array) -> int:
    """As mounted on its side."""
    for part in (RATE, FORCE):
        x, y, z = values[part]
        values[part] = x, -z, y
    return 0


def falling(_: int, values: F64Array) -> int:
    """The sign of an accelerometer that measures gravity instead of specific force."""
    values[FORCE] = -values[FORCE]
    return 0


def late(shift_ms: float) -> Change:
    return lambda _, values: round(shift_ms * MS)


IMU = "the IMU /imu/data: expected "
TURNS = IMU + "poses that turn as the points of 40 windows do, found "


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (scaled, TURNS + "57.* times their rotation (scale)"),
        (swapped, TURNS + "axes turned by "),
        (turned, TURNS + "axes turned by "),
        (lying, IMU + "+9.81 m/s2 within 30 degrees of the body's z axis at rest, found "),
        (falling, IMU + "+9.81 m/s2 within 30 degrees of the body's z axis at rest, found "),
        (late(20), TURNS + "them * ms late (delay)"),
        (late(-20), TURNS + "them * ms early (delay)"),
        (late(100), TURNS + "them * ms late (delay)"),
        (late(-100), TURNS + "them * ms early (delay)"),
        (late(400), TURNS + "them * ms late (delay)"),
        # What is not forwarded does not move points.
        (late(1500), "--deskew imu: /imu/data: expected the clock of its header and that of the"),
        (late(-1500), "--deskew imu: /imu/data: expected the clock of its header and that of the"),
    ],
)
def test_an_imu_that_does_not_fit_is_refused(
    shell: Shell, drive: Recorded, change: Change, message: str
) -> None:
    done = shell(f"{changed(drive, change)} -o out.mcap --deskew imu -q")
    assert done.code == 1
    lines = [line for line in done.err.splitlines() if "error:" in line]
    assert len(lines) == 1, done.err
    position = 0
    for part in message.split("*"):
        assert part in lines[0][position:], lines[0]
        position = lines[0].index(part, position) + len(part)
    assert not Path("out.mcap").exists()


def test_the_imu_of_the_recording_agrees(shell: Shell, drive: Recorded) -> None:
    """Its figures are in the report; small delays are those of any interface."""
    for shift_ms in (0, 5, -5):
        words = changed(drive, late(shift_ms))
        done = shell(f"{words} -o out --overwrite --deskew imu")
        assert done.code == 0, done.err
        assert "rotation as that of the points in 40 windows" in done.out
        found = report_of("out/report.json")["deskew"]["rotation_check"]
        assert found["outcome"] == "agrees"
        assert found["windows"] == 40
        assert found["scale"] == pytest.approx(1.0, abs=0.03)
        assert found["turned_deg"] < 3
        assert found["delay_ms"] == pytest.approx(shift_ms, abs=6)
        assert found["delay_deviation_ms"] < 3


def test_a_gap_of_the_imu_ends_its_poses(shell: Shell, drive: Recorded) -> None:
    """0.1 s are missing from 3 s on: scans before are moved as without the gap, others left out."""
    words = changed(drive, late(0))
    assert shell(f"{words} -o whole --deskew imu -q").code == 0

    def gap(since_ns: int, values: F64Array) -> int | None:
        return None if 3 * S <= since_ns < 3 * S + 100 * MS else 0

    done = shell(f"{changed(drive, gap)} -o part --deskew imu")
    assert done.code == 0
    assert "no_pose: the IMU /imu/data has no poses of" in done.err
    assert "(none after a gap of its samples of 105 ms)" in done.err
    kept = names("part")
    first_ns = int(arrays("whole/000000.npz")["start_ns"])
    for name in kept:
        assert Path("part", name).read_bytes() == Path("whole", name).read_bytes()
        assert int(arrays(f"part/{name}")["end_ns"]) <= first_ns + 3 * S
    assert 27 <= len(kept) <= 30
    motion = report_of("part/report.json")["deskew"]
    assert motion["windows_without_poses"] == len(names("whole")) - len(kept)
    assert motion["columns"] == motion["moved"] + motion["no_pose"]
    assert shell("verify part").code == 0


def test_lost_samples_are_no_gap(shell: Shell, drive: Recorded) -> None:
    """Three of 200 Hz: 20 ms from one to the next."""

    def lost(since_ns: int, values: F64Array) -> int | None:
        return None if 3 * S <= since_ns < 3 * S + 15 * MS else 0

    assert shell(f"{changed(drive, lost)} -o out --deskew imu -q").code == 0
    assert report_of("out/report.json")["deskew"]["no_pose"] == 0


def written(drive: Recorded, change: Callable[[int, F64Array], tuple[int, F64Array]]) -> None:
    """The true poses, changed; takes and returns time in ns and x, y, z, qx, qy, qz, qw."""
    lines = []
    for stamp_ns, row in zip(*read_tum(drive.truth), strict=True):
        changed_ns, values = change(int(stamp_ns), row)
        numbers = " ".join(f"{value:.9f}" for value in values)
        lines.append(f"{changed_ns // S}.{changed_ns % S:09d} {numbers}")
    Path("poses.tum").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda ns, row: (ns + 300 * MS, row), "found them * ms late (delay)"),
        (lambda ns, row: (ns - 50 * MS, row), "found them * ms early (delay)"),
        # From the body to the world, where that from the world to the body is expected.
        (lambda ns, row: (ns, row * [1, 1, 1, -1, -1, -1, 1]), "found axes turned by 1"),
        # w first: refused where the file is read.
        (lambda ns, row: (ns, row[[0, 1, 2, 6, 3, 4, 5]]), "tilted by more than 45 degrees"),
    ],
)
def test_a_trajectory_that_does_not_fit_is_refused(
    shell: Shell,
    drive: Recorded,
    change: Callable[[int, F64Array], tuple[int, F64Array]],
    message: str,
) -> None:
    written(drive, lambda ns, row: (ns, row))
    words = f"convert {drive.path} --rig {drive.rig} -q -o out.mcap --deskew poses.tum --overwrite"
    assert shell(words).code == 0
    Path("out.mcap").unlink()
    written(drive, change)
    done = shell(words)
    assert done.code == 1
    first, *rest = message.split("*")
    assert first in done.err
    assert all(part in done.err for part in rest)
    assert not Path("out.mcap").exists()
