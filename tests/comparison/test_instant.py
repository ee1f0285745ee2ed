"""The instant that a page of `compare` shows: a car that two lidars see, worked out by hand.

Lidars look ahead and back, the one at the rear by half a turn later, so that both look into the
same direction at the same time. Sweeps of `front` begin on the grid, those of `rear` 50 ms after.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.arrays import F32Array, F64Array, U8Array
from mlbatch.comparison.compare import WINDOWS, Comparison, compare
from mlbatch.comparison.instant import apart, cells, difference
from mlbatch.discovery.discover import SensorSelection
from mlbatch.page.clouds import CloudPoints
from mlbatch.page.instant import InstantSet, SharedInstant
from mlbatch.pipeline.job import Job
from tests.builders.simulated import Recorded, record, scenario_text

CAR_X_M, CAR_Y_M, CAR_MPS = -12.0, -7.0, 10.0
NOISE_M = 0.01
SCENE = f"""\
scene:
  rectangles:
    - {{corner_m: [-60, -60, 0], along_m: [120, 0, 0], across_m: [0, 120, 0], reflectivity: 30}}
  boxes:
    - {{centre_m: [4, -18, 3], size_m: [60, 4, 6], reflectivity: 80}}
    - centre_m: [{CAR_X_M}, {CAR_Y_M}, 0.75]
      size_m: [4.4, 1.8, 1.5]
      velocity_mps: [{CAR_MPS}, 0, 0]
      reflectivity: 120
"""
LIDAR = (
    "  - {name: %s, model: OS1-32, columns: 512, noise_m: 0.01, phase_deg: %d, extrinsics: %s}\n"
)
FRONT = "{translation_m: [1, 0, 1.8], rotation_rpy_deg: [0, 0, 0]}"
REAR = "{translation_m: [-1, 0, 1.8], rotation_rpy_deg: [0, 0, 180]}"
# A column of 100 ms / 512.
COLUMN_MS = 100 / 512


def _recorded(folder: Path, rear_deg: int) -> Recorded:
    sensors = LIDAR % ("front", 0, FRONT) + LIDAR % ("rear", rear_deg, REAR)
    return record(folder, scenario_text(sensors, scene=SCENE, motion="", duration=2.4))


def _compared(recorded: Recorded, rig: Path | None) -> Comparison:
    job = Job((recorded.path,), SensorSelection(rig=rig))
    return compare(job, finds_instant=True)


@pytest.fixture(scope="module")
def opposed(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return _recorded(tmp_path_factory.mktemp("opposed"), 180)


@pytest.fixture(scope="module")
def instant(opposed: Recorded) -> SharedInstant:
    found = _compared(opposed, opposed.rig).instant
    assert found is not None
    return found


def _named(instant: SharedInstant, name: str) -> InstantSet:
    return next(one for one in instant.sets if name in one.name)


def test_ages_of_sets_are_those_of_the_rotors(instant: SharedInstant) -> None:
    fused, window = _named(instant, "latest"), _named(instant, WINDOWS)
    front, rear = fused.ages_ms
    assert front == pytest.approx((100, COLUMN_MS), abs=1e-3)
    assert rear == pytest.approx((150, 50 + COLUMN_MS), abs=1e-3)
    assert window.ages_ms == (front, front)
    # Every fifth of the windows that end 0.4 s before the last one, and the first, whose sets are
    # longer than none.
    assert instant.looked == 4
    # All policies give the same sets.
    assert len(instant.sets) == 2


def test_the_car_is_found_where_it_stands_twice(instant: SharedInstant) -> None:
    fused, window = _named(instant, "latest"), _named(instant, WINDOWS)
    spot = instant.spot
    assert spot is not None
    assert spot.unmatched > 0
    # Centre of the car at the instant, and up to 150 ms before; the side to the lidars.
    car_m = CAR_X_M + CAR_MPS * instant.at_s
    assert car_m - 1.5 - 2.2 <= spot.centre_m[0] <= car_m + 2.2
    assert abs(spot.centre_m[1] - CAR_Y_M) < 1
    # Half of the directions are a period apart; the lidars, 2 m apart, look at a car at 7 m in
    # directions that differ by less than 17 deg: 5 ms.
    assert fused.spot_ms == pytest.approx(100, abs=5)
    assert window.spot_ms == pytest.approx(0, abs=5)
    assert float(fused.row(5)[3]) == pytest.approx(0.5, abs=0.03)


def test_points_of_the_car_are_where_it_was_at_their_age(instant: SharedInstant) -> None:
    """So one lidar shows it 1 m before the other in the fused set, and not in the window."""
    ends_m = {}
    for one in instant.sets:
        xyz, lidar, age_s = _arrays(one)
        car = (np.abs(xyz[:, 1] - CAR_Y_M) < 1.2) & (xyz[:, 2] > 0.1) & (xyz[:, 2] < 1.6)
        centre_m = CAR_X_M + CAR_MPS * (instant.at_s - age_s[car])
        off_m = np.abs(xyz[car, 0] - centre_m) - 2.2
        assert car.sum() > 100
        # Five standard deviations of the noise.
        assert off_m.max() < 5 * NOISE_M
        ends = [xyz[car & (lidar == number), 0].min() for number in range(2)]
        ends_m[one.name] = ends[0] - ends[1]
    fused_m, window_m = (ends_m[one.name] for one in instant.sets)
    # Spacing of the points along the car: 0.7 deg at up to 10 m, slanted.
    assert fused_m == pytest.approx(1.0, abs=0.3)
    assert window_m == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("rear_deg", [180, 252])
def test_clouds_are_those_of_convert(rear_deg: int, opposed: Recorded, tmp_path: Path) -> None:
    recorded = opposed if rear_deg == 180 else _recorded(tmp_path, rear_deg)
    instant = _compared(recorded, recorded.rig).instant
    assert instant is not None
    # Rear's sweeps begin 50 ms after those of front, as the nearest before; or 30 ms after them.
    assert len(instant.sets) == (2 if rear_deg == 180 else 3)
    start_ns = recorded.scenario.start_ns
    for words, name in (
        ("window", WINDOWS),
        ("latest", "latest sweeps"),
        ("approximate", "approximate time"),
        ("collate", "timeout collate"),
    ):
        one = _named(instant, name)
        assert abs(one.range_ms[1]) <= 50
        xyz, lidar, age_s = _arrays(one)
        oldest_ms, _ = one.range_ms
        first_ns = start_ns + round((instant.at_s * 1e3 - oldest_ms) * 1e6)
        scans = mlbatch.scans(recorded.path, rig=recorded.rig, batching=words)
        scan = next(scan for scan in scans if abs(scan.start_ns - first_ns) < 1000)
        np.testing.assert_array_equal(xyz, scan.xyz)
        np.testing.assert_array_equal(lidar, scan.lidar_id)
        time_s = (scan.start_ns - start_ns + scan.time_ns.astype(np.int64)) / 1e9
        np.testing.assert_allclose(instant.at_s - age_s, time_s, atol=1e-8)


def test_without_extrinsics_ages_are_left(opposed: Recorded, instant: SharedInstant) -> None:
    found = _compared(opposed, None).instant
    assert found is not None
    assert [one.ages_ms for one in found.sets] == [one.ages_ms for one in instant.sets]
    assert found.clouds() == []
    assert "without extrinsics" in found.why


def _arrays(one: InstantSet) -> tuple[F32Array, U8Array, F64Array]:
    points = one.points
    assert points is not None
    return points.xyz, points.lidar, np.divide(points.time_ns, -1e9)


# -- places, by hand --------------------------------------------------------------------------


def _wall(x_m: float, time_ms: float, lidar: int, *, shift_m: float = 0.0) -> CloudPoints:
    """A wall of 1.6 m by 2 m at x, y 10.2 m, points 0.1 m and 0.08 m apart."""
    along, up = np.meshgrid(np.arange(0.2, 1.8, 0.1), np.arange(0, 2, 0.08))
    xyz = np.stack([x_m + along.ravel(), np.full(along.size, 10.2 + shift_m), up.ravel()], 1)
    count = len(xyz)
    return CloudPoints(
        xyz.astype(np.float32),
        np.full(count, lidar, np.uint8),
        np.full(count, round(time_ms * 1e6), np.int64),
        np.zeros(count, np.uint16),
        np.zeros(count, np.float32),
    )


def _all(*parts: CloudPoints) -> CloudPoints:
    return CloudPoints(*map(np.concatenate, zip(*parts, strict=True)))


PERIOD_NS = 100_000_000


def test_times_between_lidars_by_place() -> None:
    points = _all(_wall(0, -60, 0), _wall(0, -20, 1), _wall(4, -10, 0))
    found = apart(points, cells(points), PERIOD_NS)
    assert found.apart_ns.tolist() == [40e6, 0]
    assert found.lidars.tolist() == [2, 1]
    assert found.shared_ms() == (40, 40)
    # A place that a lidar saw at the start and the end of a revolution has no time of its own.
    seam = _all(points, _wall(0, -95, 0))
    assert apart(seam, cells(seam), PERIOD_NS).lidars.tolist() == [1]


def test_what_moves_is_found_before_what_is_stale() -> None:
    window = _all(*(_wall(x, -50, number) for x in (0, 8) for number in range(2)))
    still = _all(_wall(0, -50, 0), _wall(0, -150, 1), _wall(8, -50, 0), _wall(8, -110, 1))
    found = difference(still, window, PERIOD_NS)
    assert found is not None
    assert (found.gain_ns, found.unmatched) == (100e6, 0)
    assert found.centre_m[0] == pytest.approx(0.95, abs=0.01)
    moved = _all(
        _wall(0, -50, 0), _wall(0, -150, 1), _wall(8, -50, 0), _wall(8, -110, 1, shift_m=1)
    )
    found = difference(moved, window, PERIOD_NS)
    assert found is not None
    # 16 columns of points; of 25 in each 21 are above 0.3 m.
    assert (found.gain_ns, found.unmatched, found.points) == (60e6, 16 * 21, 2 * 16 * 21)
    assert found.centre_m[:2] == pytest.approx((8.95, 11.2), abs=0.01)
    assert difference(window, window, PERIOD_NS) is None
    # The window is no worse if its lidars are farther apart.
    assert difference(window, still, PERIOD_NS) is None
