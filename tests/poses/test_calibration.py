"""Poses from simulated recordings: as true as they claim, or refused with the reason.

The truth is the rig that the simulation writes; guesses are off by a known turn and shift.
"""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.arrays import F64Array
from mlbatch.errors import RecordingError, UsageError
from mlbatch.frames.transforms import compose, from_rpy_deg, inverse
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import log_rotation
from mlbatch.poses.calibration import (
    Calibration,
    LidarPose,
    by_motion,
    known_by_motion,
    motion_poses,
)
from mlbatch.poses.from_motion import MotionPose, MotionPoses
from mlbatch.poses.solve import State
from mlbatch.python.calibrate import calibrate_job, rig_text
from mlbatch.rig.rig import Rig, read_rig
from mlbatch.rig.write import write_rig
from tests.builders.simulated import MOTION, Recorded, record, scenario_text

_SENSOR = (
    "  - {{name: {0}, model: OS0-32, columns: 512, "
    "extrinsics: {{translation_m: [0.1, {1}, 0.2], rotation_rpy_deg: [0, 10, {2}]}}}}\n"
)
SENSORS = _SENSOR.format("left", 0.3, 60) + _SENSOR.format("right", -0.3, -60)
_NO_AXES = np.zeros((6, 0))
# Guesses of the right lidar: turns about fixed axes in degrees, shifts in m, both of the body.
GUESSES = {
    "20 degrees about z, 1 m": ([0.8, 0.6, 0.0], [0.0, 0.0, 20.0]),
    "12 degrees about x, 0.6 m": ([0.0, -0.36, 0.48], [12.0, 0.0, 0.0]),
}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A rig that turns in a room."""
    text = scenario_text(SENSORS, duration=1.5)
    return record(tmp_path_factory.mktemp("room"), text)


@pytest.fixture(scope="module")
def calibration(room: Recorded) -> Calibration:
    """Of the true rig."""
    return mlbatch.calibrate(room.path, room.rig)


def guessed(rig: Path, to: Path, shift_m: list[float], turn_deg: list[float]) -> Path:
    """The rig with all lidars but the first one off, as a file."""
    true = read_rig(rig)
    first, *others = true.sensors
    moved = []
    for sensor in others:
        assert isinstance(sensor.extrinsics, np.ndarray)
        pose = compose(from_rpy_deg([0, 0, 0], turn_deg), sensor.extrinsics)
        pose[:3, 3] = sensor.extrinsics[:3, 3] + shift_m
        moved.append(replace(sensor, extrinsics=pose))
    to.write_text(write_rig(replace(true, sensors=(first, *moved)), to.parent), encoding="utf-8")
    return to


def true_pose(rig: Rig, name: str) -> F64Array:
    (pose,) = (sensor.extrinsics for sensor in rig.sensors if sensor.name == name)
    assert isinstance(pose, np.ndarray)
    return pose


def off(lidar: LidarPose, true: F64Array) -> tuple[F64Array, F64Array]:
    """Errors of a pose: of the origin, mm, and of the rotation, degrees."""
    found = lidar.body_from_sensor
    turn = log_rotation(np.matmul(found[:3, :3], true[:3, :3].T)[None])[0]
    return 1000 * (found - true)[:3, 3], np.rad2deg(turn)


@pytest.mark.parametrize("name", GUESSES)
def test_a_guess_becomes_the_true_pose(
    room: Recorded, calibration: Calibration, tmp_path: Path, name: str
) -> None:
    guess = guessed(room.rig, tmp_path / "guess.yaml", *GUESSES[name])
    found = mlbatch.calibrate(room.path, guess)
    left, right = found.lidars
    true = read_rig(room.rig)
    assert left.is_fixed
    assert left.body_from_sensor.tobytes() == true_pose(true, "left").tobytes()
    error_mm, error_deg = off(right, true_pose(true, "right"))
    assert np.abs(error_mm).max() < 5
    assert np.abs(error_deg).max() < 0.05
    # A draw of a Gaussian beyond four standard deviations is one of 16,000.
    assert (np.abs(error_mm) < 4 * right.sigma_mm).all()
    assert (np.abs(error_deg) < 4 * right.sigma_deg).all()
    shift_m, turn_deg = GUESSES[name]
    assert right.moved_mm == pytest.approx(1000 * np.linalg.norm(shift_m), abs=10)
    assert right.turned_deg == pytest.approx(np.linalg.norm(turn_deg), abs=0.1)
    (pair,) = found.pairs
    assert pair.after.share > 0.95
    # As with the true poses.
    assert pair.after.apart_mm == pytest.approx(calibration.pairs[0].before.apart_mm, rel=0.05)
    assert pair.before.share < 0.7


def _scene(boxes: str) -> str:
    return f"scene:\n  boxes:\n{boxes}"


_CORRIDOR = _scene("    - {centre_m: [0, 0, 1], size_m: [400, 5, 4], reflectivity: 90}\n")
_PLANE = """\
scene:
  rectangles:
    - {corner_m: [-60, -60, 0], along_m: [120, 0, 0], across_m: [0, 120, 0], reflectivity: 60}
"""
_STRAIGHT = """\
motion:
  waypoints:
    - [0, -1.0, -0.5, 1.2, 0]
    - [3, 2.0, -0.5, 1.2, 0]
"""
# Each lidar in a room of its own.
_APART = _scene(
    "    - {centre_m: [0, 10, 2], size_m: [12, 8, 4], reflectivity: 90}\n"
    "    - {centre_m: [0, -10, 2], size_m: [12, 8, 4], reflectivity: 90}\n"
)
_FAR = _SENSOR.format("left", 10, 60) + _SENSOR.format("right", -10, -60)
UNDETERMINED = {
    "a corridor": (_CORRIDOR, SENSORS, "right: a shift along x of the body"),
    "a bare plane": (_PLANE, SENSORS, "right: a turn about z of the body"),
    "two rooms": (_APART, _FAR, "surfaces that right and left both see, found none"),
}


@pytest.mark.parametrize("name", UNDETERMINED)
def test_what_a_scene_does_not_fix_is_refused(tmp_path: Path, name: str) -> None:
    scene, sensors, reason = UNDETERMINED[name]
    text = scenario_text(sensors, scene=scene, motion=_STRAIGHT, duration=1.5)
    drive = record(tmp_path, text)
    guess = guessed(drive.rig, tmp_path / "guess.yaml", [0.1, 0.1, 0.1], [0, 0, 5])
    with pytest.raises(RecordingError, match="calibrate: expected ") as refused:
        mlbatch.calibrate(drive.path, guess, tmp_path / "rig.yaml")
    assert reason in str(refused.value)
    assert not (tmp_path / "rig.yaml").exists()


def test_a_guess_that_is_too_far_off_gives_no_pose(room: Recorded, tmp_path: Path) -> None:
    guess = guessed(room.rig, tmp_path / "guess.yaml", [2.5, 0, 0], [0, 0, 70])
    with pytest.raises(RecordingError, match="calibrate: expected "):
        mlbatch.calibrate(room.path, guess)


def test_one_lidar_has_nothing_to_compare(room: Recorded) -> None:
    with pytest.raises(UsageError, match="expected two lidars or more, found left alone"):
        mlbatch.calibrate(room.path, room.rig, only="left")


# -- the rig that is written ----------------------------------------------------------------------


def test_the_rig_reads_back_to_the_last_digit(
    room: Recorded, calibration: Calibration, tmp_path: Path
) -> None:
    guess = room.rig.with_name("guess.yaml")
    guess.write_text(
        room.rig.read_text(encoding="utf-8").replace("sensors:", "rate_hz: 20\nsensors:", 1)
        + "exclude_boxes_m: [[-1, -1, -1, 1, 1, 1]]\nconvert: {layout: organized}\n",
        encoding="utf-8",
    )
    job = calibrate_job(room.path, guess, {})
    text = rig_text(job, calibration, tmp_path, date(2026, 5, 4))
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    before, after = read_rig(guess), read_rig(tmp_path / "rig.yaml")
    for lidar in calibration.lidars:
        assert true_pose(after, lidar.name).tobytes() == lidar.body_from_sensor.tobytes()
    assert (after.rate, after.body_frame, after.options) == (
        before.rate,
        before.body_frame,
        before.options,
    )
    assert np.array_equal(after.exclude_boxes_m, before.exclude_boxes_m)
    assert [sensor.stream for sensor in after.sensors] == [one.stream for one in before.sensors]
    (comment,) = (line for line in text.splitlines() if "2026-05-04" in line)
    assert "extrinsics by mlbatch calibrate, 2026-05-04, from drive.pcap; standard" in comment


def test_delays_become_offsets_of_the_clock(
    room: Recorded, calibration: Calibration, tmp_path: Path
) -> None:
    left, right = calibration.lidars
    late = replace(calibration, lidars=(left, replace(right, delay_ms=-12.5)))
    text = rig_text(calibrate_job(room.path, room.rig, {}), late, tmp_path, date(2026, 5, 4))
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    assert [sensor.offset_ns for sensor in read_rig(tmp_path / "rig.yaml").sensors] == [
        0,
        -12_500_000,
    ]


# -- without a guess ------------------------------------------------------------------------------


def _unknown(rig: Path) -> Path:
    """The rig without poses."""
    text = re.sub("extrinsics: .*", "extrinsics: unknown", rig.read_text(encoding="utf-8"))
    found = rig.with_name("unknown.yaml")
    found.write_text(text, encoding="utf-8")
    return found


def test_motion_needs_no_guess(tmp_path: Path) -> None:
    """Poses are relative to the first lidar, whose frame is the body frame."""
    # Thirty windows of motion are needed.
    head, sway = MOTION.split("  sway:")
    motion = f"{head}    - [5, -0.8, 0.2, 1.2, 320]\n  sway:{sway}"
    sensors = SENSORS.replace("OS0-32", "OS0-32, imu: {gyro_bias: [0.01, -0.02, 0.03]}", 1)
    drive = record(tmp_path, scenario_text(sensors, motion=motion, duration=4.5))
    rig = tmp_path / "rig.yaml"
    found = mlbatch.calibrate(drive.path, _unknown(drive.rig), rig, from_motion=True)
    left, right = found.lidars
    true = read_rig(drive.rig)
    relative = compose(inverse(true_pose(true, "left")), true_pose(true, "right"))
    error_mm, error_deg = off(right, relative)
    assert np.abs(left.body_from_sensor - np.eye(4)).max() == 0
    assert np.abs(error_mm).max() < 5
    assert np.abs(error_deg).max() < 0.05
    assert true_pose(read_rig(rig), "right").tobytes() == right.body_from_sensor.tobytes()
    # The axes of the IMU of an Ouster are those of its sensor frame.
    (imu,) = found.imus
    imu_error_deg = np.rad2deg(log_rotation(imu.body_from_imu[None])[0])
    assert not imu.refusal
    assert (np.abs(imu_error_deg) < np.minimum(4 * imu.sigma_deg, 2.0)).all()
    assert "; the IMU of left: rotation_rpy_deg [" in rig.read_text(encoding="utf-8")


def test_a_clock_that_is_a_third_of_a_second_ahead(tmp_path: Path) -> None:
    """Far more than surfaces alone find; the turns of both lidars say it."""
    head, sway = MOTION.split("  sway:")
    more = "    - [5, -0.8, 0.2, 1.2, 320]\n"
    sensors = SENSORS.replace("{name: right", "{name: right, clock: {offset_s: 0.3}")
    text = scenario_text(sensors, motion=f"{head}{more}  sway:{sway}", duration=4.5)
    drive = record(tmp_path, text)
    guess = guessed(drive.rig, tmp_path / "guess.yaml", [0.1, 0.1, -0.05], [2, 1, 5])
    _, right = mlbatch.calibrate(drive.path, guess, time_offset=True).lidars
    error_mm, error_deg = off(right, true_pose(read_rig(drive.rig), "right"))
    assert right.delay_ms == pytest.approx(-300.0, abs=4 * right.delay_sigma_ms)
    assert np.abs(error_mm).max() < 5
    assert np.abs(error_deg).max() < 0.1


def test_too_little_motion_gives_no_pose(room: Recorded) -> None:
    with pytest.raises(RecordingError, match="calibrate: right: expected 30 windows"):
        mlbatch.calibrate(room.path, _unknown(room.rig), from_motion=True)


def test_deviations_of_motion_are_those_along_the_body() -> None:
    """The first lidar is turned by 90 degrees: its x axis is y of the body."""
    sigma = np.array([0.001, 0.002, 0.003, 0.01, 0.02, 0.03])
    own = MotionPose(Pose(np.eye(3), np.array([1.0, 0, 0])), np.diag(sigma**2), _NO_AXES, (), "")
    still = MotionPose(ORIGIN, np.zeros((6, 6)), _NO_AXES, (), "")
    motion = MotionPoses((still, own), (40, 38), np.zeros(40, np.int64), np.zeros((2, 40, 6)))
    poses = motion_poses(from_rpy_deg([0, 0, 2], [0, 0, 90]), motion)
    assert poses[1][:3, 3] == pytest.approx([0, 1, 2])
    found = by_motion(["left", "right"], poses, motion, 44)
    assert (found.steps, found.windows, found.pairs) == (38, 44, ())
    assert found.lidars[1].sigma_mm == pytest.approx([2, 1, 3])
    assert found.lidars[1].sigma_deg == pytest.approx(np.rad2deg([0.02, 0.01, 0.03]))


@pytest.mark.parametrize("late_s", [np.nan, 0.001, 0.05])
def test_what_motion_says_counts_in_the_body_frame(late_s: float) -> None:
    """A pose that is off by e costs e' C^-1 e, in the frame of the first lidar; C: by motion."""
    rng = np.random.default_rng(1)
    spread = rng.normal(size=(6, 6)) * 0.01
    covariance = spread @ spread.T + np.diag([1e-4] * 6)
    first = from_rpy_deg([0.4, -0.3, 2.0], [10, 20, 90])
    relative = from_rpy_deg([1.0, -0.5, 0.2], [5, -10, 120])
    own = MotionPose(
        *(Pose(relative[:3, :3], relative[:3, 3]), covariance, _NO_AXES, (), "", late_s, 0.002)
    )
    still = MotionPose(ORIGIN, np.zeros((6, 6)), _NO_AXES, (), "")
    motion = MotionPoses((still, own), (40, 38), np.zeros(40, np.int64), np.zeros((2, 40, 6)))
    moved = motion_poses(first, motion)
    known = known_by_motion(first, motion, moved, State.start(2, 0))
    change = from_rpy_deg([2e-4, -1e-4, 3e-4], [0.01, -0.02, 0.015])
    state = State.start(2, 0)
    state.corrections[1] = Pose(change[:3, :3], change[:3, 3])
    off = known.off(state)[0]
    cost = off[:6] @ known.information[0][:6, :6] @ off[:6]
    after = compose(inverse(first), compose(change, moved[1]))
    turn = log_rotation((after[:3, :3] @ relative[:3, :3].T)[None])[0]
    error = np.concatenate([after[:3, 3] - relative[:3, 3], turn])
    expected = error @ np.linalg.solve(covariance, error)
    # Of clocks that differ by 50 ms, poses by motion are not right.
    assert cost == pytest.approx(0.0 if late_s == 0.05 else expected, rel=0.01)
    assert known.information[0][6, 6] == pytest.approx(0.0 if np.isnan(late_s) else 0.002**-2)
