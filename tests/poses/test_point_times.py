"""Times of simulated decoded clouds are read as they were measured, or the check says otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import rotations_of
from mlbatch.pipeline.cloud_times import TimeFinding
from mlbatch.pipeline.inspect import inspect
from mlbatch.poses.point_times import (
    DIFFERS,
    FITS,
    MOVED,
    OPEN,
    TimedLidar,
    fit_delay,
    fit_order,
    track,
)
from mlbatch.poses.solve import Cloud
from mlbatch.ros.point_packets import CloudError
from mlbatch.ros.point_times import CONVENTION, Zero, stamps
from tests.builders.simulated import at_true_poses, read_tum
from tests.builders.time_readings import (
    READINGS,
    SWEEP_NS,
    Drive,
    drive,
    scenario,
    write_clouds,
)

_SEED = 3
NAMES = {reading.name: reading for reading in READINGS}
AS_MEASURED = READINGS[0]


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """Three seconds of two lidars that cross a yard."""
    return drive(tmp_path_factory.mktemp("drive"), scenario(_SEED, duration_s=3.0), _SEED)


def _sweeps(moved: Drive, lidar: int, late_ns: int = 0, *, is_back: bool = False) -> list[Cloud]:
    """Sweeps in the body frame, with stamps that are late, or in the opposite order."""
    pose: F64Array = moved.poses[lidar]
    found = []
    for stamp_ns, points_m, start_ns in moved.sweeps[lidar]:
        read_ns = 2 * start_ns + SWEEP_NS - stamp_ns if is_back else stamp_ns
        body_m = np.matmul(points_m, pose[:3, :3].T) + pose[:3, 3]
        found.append(Cloud.of_sweep(body_m, read_ns + late_ns))
    return found


@pytest.mark.parametrize(("is_back", "late_ms"), [(False, 0), (True, 20), (False, -97)])
def test_readings(moved: Drive, is_back: bool, late_ms: int) -> None:
    left = _sweeps(moved, 0)
    right = _sweeps(moved, 1, late_ms * 1_000_000, is_back=is_back)
    motion = track(left)
    order = fit_order(right, track(right))
    assert order.verdict == (DIFFERS if is_back else FITS)
    found = fit_delay(TimedLidar(left, False), TimedLidar(right, is_back), motion, 0.1)
    assert found.verdict == (DIFFERS if late_ms else FITS)
    assert abs(found.late_s - late_ms / 1000) < min(0.005, 4 * found.sigma_s)
    if late_ms:
        assert found.residual_m[1] < 0.5 * found.residual_m[0]


def test_points_that_a_driver_moved_to_one_time_are_named(moved: Drive) -> None:
    stamps_ns, poses = read_tum(moved.truth)
    deskewed = []
    for sweep in _sweeps(moved, 0):
        stamp_ns = sweep.instant_ns + sweep.time_s * 1e9
        world_m = at_true_poses(sweep.points_m, stamp_ns, moved.truth)
        pose = poses[np.searchsorted(stamps_ns, sweep.instant_ns)]
        body_m = np.matmul(world_m - pose[:3], rotations_of(pose[None, 3:])[0])
        deskewed.append(replace(sweep, points_m=body_m))
    found = fit_order(deskewed, track(deskewed))
    assert found.verdict == MOVED
    assert found.residual_m[2] < found.residual_m[0]


def test_at_rest_nothing_is_decided(moved: Drive) -> None:
    first = _sweeps(moved, 0)[0]
    still = [replace(first, instant_ns=first.instant_ns + step * SWEEP_NS) for step in range(20)]
    motion = track(still)
    assert fit_order(still, motion).verdict == OPEN
    lidar = TimedLidar(still, is_back=False)
    assert fit_delay(lidar, lidar, motion, 0.1).verdict == OPEN


def test_without_common_surfaces_no_delay_is_named(moved: Drive) -> None:
    left = _sweeps(moved, 0)
    # Nothing that the other lidar sees within 80 m.
    far = [replace(sweep, points_m=sweep.points_m + 500.0) for sweep in _sweeps(moved, 1)]
    found = fit_delay(TimedLidar(left, False), TimedLidar(far, False), track(left), 0.1)
    assert found.verdict == OPEN
    assert "in common" in found.reason


def test_a_lidar_that_is_elsewhere_has_no_delay(moved: Drive) -> None:
    left = _sweeps(moved, 0)
    moved_away = [
        replace(sweep, points_m=sweep.points_m + np.array([0.0, 0.0, 0.3]))
        for sweep in _sweeps(moved, 1)
    ]
    found = fit_delay(TimedLidar(left, False), TimedLidar(moved_away, False), track(left), 0.1)
    assert found.verdict == OPEN


def _findings(folder: Path, moved: Drive, points: str) -> list[TimeFinding]:
    """Of a lidar as measured, and one whose times are ages."""
    ages = replace(NAMES["ages"], points=points)
    path, rig = write_clouds(folder, moved, (AS_MEASURED, ages))
    return list(inspect([path], (), rig=rig).point_times)


def test_inspect_names_the_key_by_which_the_times_fit(moved: Drive, tmp_path: Path) -> None:
    left, right = _findings(tmp_path, moved, "")
    assert (left.sensor, left.set) == ("left", {})
    # A delay of a sweep, 100 ms, may be one of the clock, too.
    clock = right.set.pop("right clock", "{offset_s: 0.1}")
    assert abs(abs(float(clock.removeprefix("{offset_s:").rstrip("}"))) - 0.1) < 0.005
    assert right.set == {"right points": "{from: back}"}
    left, right = _findings(tmp_path, moved, "{from: back}")
    assert (right.order, right.delay, right.set) == (FITS, FITS, {})
    assert right.describe().startswith("right: times of points within a sweep: the order fits")


def test_ages_are_before_the_header() -> None:
    zero = Zero("t (uint32)", 1_000_000_000_000_000_000, "the header's stamp")
    rule = replace(CONVENTION, origin="back")
    ages = np.array([99_000_000, 20_000_000, 0], np.uint32)
    found, meaning = stamps(ages, zero, rule, ages)
    assert (found - zero.base_ns).tolist() == [-99_000_000, -20_000_000, 0]
    assert meaning == "t (uint32), ns before the header's stamp"
    with pytest.raises(CloudError, match="from: back"):
        stamps(-ages.astype(np.int64), zero, rule, -ages.astype(np.int64))
