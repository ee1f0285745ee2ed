"""A static wall seen from a turning, driving platform, as `convert --deskew` writes it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.arrays import F64Array
from tests.builders.sessions import Shell
from tests.builders.simulated import record, scenario_text

WALL = 200
MOTION = """\
motion:
  standstill_s: 1.5
  waypoints:
    - [0, 0, 0, 1.0, 0]
    - [1, 2.0, 0.3, 1.0, 35]
    - [2, 3.6, 1.4, 1.0, 75]
    - [3, 4.0, 3.2, 1.0, 120]
    - [4, 3.0, 4.8, 1.0, 165]
  sway:
    - {coordinate: roll, amplitude: 2, frequency_hz: 1.1}
    - {coordinate: pitch, amplitude: 1.5, frequency_hz: 1.7, phase_deg: 40}
"""
SCENE = f"""\
scene:
  rectangles:
    - {{corner_m: [9, -15, -2], along_m: [0, 35, 0], across_m: [0, 0, 8], reflectivity: {WALL}}}
    - {{corner_m: [-20, -20, 0], along_m: [40, 0, 0], across_m: [0, 40, 0], reflectivity: 30}}
"""
SENSORS = """\
  - name: lidar
    model: OS1-32
    columns: 512
    noise_m: 0
    extrinsics: {translation_m: [0.2, -0.1, 0.6], rotation_rpy_deg: [1, -2, 30]}
"""
IMU = (
    "imu: {rate_hz: 200, gyro_noise: 0.002, accel_noise: 0.02, gyro_bias: [0.01, -0.02, 0.015], "
    "accel_bias: [0.05, -0.03, 0.04], "
    "extrinsics: {translation_m: [0.3, 0.2, -0.1], rotation_rpy_deg: [0, 3, -90]}}\n"
)
# Scans of 0.1 s, the first from 0.1 s on, that begin after the standstill of 1.5 s.
MOVING = 15
OWN_IMU = (
    "    imu: {gyro_noise: 0.002, accel_noise: 0.02, gyro_bias: [0.01, -0.02, 0.015], "
    "accel_bias: [0.05, -0.03, 0.04]}\n"
)


def bend_m(folder: Path) -> F64Array:
    """The largest distance of the wall's points from their best plane, of each whole scan."""
    found = []
    for scan in mlbatch.read(folder):
        level = scan.intensity if scan.reflectivity is None else scan.reflectivity
        wall = np.abs(level.astype(np.float64) - WALL) < 1
        points = scan.xyz[wall].astype(np.float64)
        if scan.complete and len(points) > 200:
            centred = points - points.mean(axis=0)
            normal = np.linalg.svd(centred, full_matrices=False)[2][2]
            found.append(np.abs(centred @ normal).max())
    return np.array(found)


@pytest.mark.parametrize(
    ("model", "suffix"),
    [
        ("OS1-32", "pcap"),
        ("OS1-32", "mcap"),
        ("VLP-16", "db3"),
        ("PandarXT-32", "mcap"),
        ("Helios 32", "mcap"),
    ],
)
def test_the_wall_is_flat(shell: Shell, tmp_path: Path, model: str, suffix: str) -> None:
    sensors = SENSORS.replace("OS1-32", model)
    is_ouster = model.startswith("OS")
    if is_ouster and suffix == "pcap":
        sensors += OWN_IMU
    elif not is_ouster:
        sensors = sensors.replace("    columns: 512\n", "")
    text = scenario_text(sensors, scene=SCENE, motion=MOTION, duration=4.5, more=IMU)
    drive = record(tmp_path, text, suffix)
    words = f"convert {drive.path} --rig {drive.rig} -q"
    assert shell(f"{words} -o bent").code == 0
    # The platform turns by 4 degrees and drives 0.2 m in a scan.
    assert bend_m(Path("bent")).max() > 0.2
    for to in ("start", "end") if is_ouster else ("middle",):
        assert shell(f"{words} -o {to} --deskew {drive.truth} --deskew-to {to}").code == 0
        flat_m = bend_m(Path(to))
        assert len(flat_m) > 35
        assert flat_m[MOVING:].max() < 3e-3
        # At rest nothing is moved: Helios counts 2.5 mm and 0.01 degrees, 22 m away and at 66
        # degrees to the wall 2.3 mm from it, which also tilts the plane of 5652 points.
        assert flat_m[:MOVING].max() < 3.5e-3
    # With noise and biases of a small IMU: of the lidar, or recorded.
    assert shell(f"{words} -o imu --deskew imu").code == 0
    flat_m = bend_m(Path("imu"))
    assert len(flat_m) > 35
    assert flat_m.max() < 15e-3
    assert shell("verify imu").code == 0


def test_the_end_of_a_selection_needs_later_samples_of_the_imu(
    shell: Shell, tmp_path: Path
) -> None:
    """Windows of the first second have poses when it is complete, also with --end before that."""
    text = scenario_text(SENSORS, scene=SCENE, motion=MOTION, duration=3.0, more=IMU)
    drive = record(tmp_path, text, "mcap")
    words = f"convert {drive.path} --rig {drive.rig} -q --deskew imu"
    assert shell(f"{words} -o whole").code == 0
    for end, count in (("+0.5", 5), ("+1.5", 15)):
        assert shell(f"{words} -o part --overwrite --end {end}").code == 0
        files = sorted(Path("part").glob("*.npz"))
        assert len(files) == count
        for file in files:
            assert file.read_bytes() == (Path("whole") / file.name).read_bytes()
        assert shell("verify part").code == 0


def test_an_imu_integrated_for_long_is_a_warning(shell: Shell, tmp_path: Path) -> None:
    """Its velocity is that of an accelerometer with a bias."""
    motion = MOTION.replace("  sway:", "    - [12, 1.0, 3.0, 1.0, 200]\n  sway:")
    text = scenario_text(SENSORS, scene=SCENE, motion=motion, duration=12.5, more=IMU)
    drive = record(tmp_path, text, "mcap")
    done = shell(f"convert {drive.path} --rig {drive.rig} -o out --deskew imu")
    assert done.code == 0
    assert "deskew_drift: the IMU /imu/data was integrated for 11 s" in done.err
    assert report_has_bias(Path("out/report.json"))


def report_has_bias(path: Path) -> bool:
    """Whether the gyroscope's bias at rest is in the report: 0.01, -0.02, 0.015 rad/s."""
    bias = json.loads(path.read_text())["deskew"]["gyro_bias_rad_s"]
    return bool(np.allclose(bias, [0.01, -0.02, 0.015], atol=1e-3))
