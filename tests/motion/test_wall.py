"""A static wall seen from a turning, driving platform, with and without motion correction.

The scans are those of `convert` from a simulated recording; each point is moved by the transform of
its column. Measured: the largest distance of the wall's points from their best plane, per scan.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.imu import integrated
from mlbatch.motion.track import PoseTrack
from mlbatch.motion.tum import read_tum
from mlbatch.outputs.scan import Scan
from mlbatch.types import instant_ns
from tests.builders.simulated import Recorded, record, scenario_text
from tests.reference.motion import column_motion

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


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recorded, list[Scan]]:
    text = scenario_text(SENSORS, scene=SCENE, motion=MOTION, duration=4.5, more=IMU)
    recorded = record(tmp_path_factory.mktemp("wall"), text)
    scans = [scan for scan in recorded.scans() if scan.complete]
    assert len(scans) > 40
    return recorded, scans


def deviations(scans: list[Scan], moved: Callable[[Scan], F64Array]) -> F64Array:
    """The largest distance from the best plane in each scan, m."""
    found = []
    for scan in scans:
        assert scan.reflectivity is not None
        points = moved(scan)[scan.reflectivity == WALL]
        if len(points) > 200:
            centred = points - points.mean(axis=0)
            normal = np.linalg.svd(centred, full_matrices=False)[2][2]
            found.append(np.abs(centred @ normal).max())
    return np.array(found)


def corrected(track: PoseTrack, word: str) -> Callable[[Scan], F64Array]:
    def move(scan: Scan) -> F64Array:
        assert scan.column is not None
        to_ns = instant_ns(word, scan.start_ns, scan.end_ns)
        motion = column_motion(track, scan.column_stamp_ns, to_ns)
        assert not motion.no_pose.any()
        turn = motion.rotation[scan.column]
        points = np.einsum("nij,nj->ni", turn, scan.xyz.astype(np.float64))
        moved: F64Array = np.add(points, motion.translation_m[scan.column])
        return moved

    return move


def samples_of(path: Path) -> tuple[F64Array, ...]:
    lines = [line.split(",") for line in path.read_text().splitlines()[1:]]
    stamps = np.array([int(line[0]) for line in lines])
    values = np.array([[float(word) for word in line[1:]] for line in lines])
    return stamps, values[:, 3:], values[:, :3]


def test_without_correction_the_wall_is_bent(drive: tuple[Recorded, list[Scan]]) -> None:
    """By decimetres: the platform turns by 4 degrees and drives 0.2 m in a scan."""
    found = deviations(drive[1], lambda scan: scan.xyz.astype(np.float64))
    assert len(found) > 25
    assert 0.1 < found.max() < 2.0


@pytest.mark.parametrize("word", ["start", "middle", "end"])
def test_with_true_poses_it_is_flat_within_3_mm(
    word: str, drive: tuple[Recorded, list[Scan]]
) -> None:
    track = read_tum(drive[0].truth)
    # The last window ends after the truth.
    found = deviations(drive[1][:-1], corrected(track, word))
    assert len(found) > 25
    assert found.max() < 3e-3


def test_with_an_imu_it_is_flat_within_15_mm(drive: tuple[Recorded, list[Scan]]) -> None:
    """Three seconds after the standstill, with noise and biases of a small IMU."""
    recorded, scans = drive
    stamps, force, rate = samples_of(recorded.path.with_name("drive.imu.csv"))
    assert recorded.scenario.imu is not None
    track = integrated(stamps.astype(np.int64), force, rate, recorded.scenario.imu.body_from_imu)
    found = deviations(scans[:-1], corrected(track, "start"))
    assert len(found) > 25
    assert found.max() < 15e-3
