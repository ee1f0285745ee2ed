"""The synthetic recording of two lidars, converted: against its scene, its table and itself."""

from __future__ import annotations

import csv
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import mlbatch
from mlbatch.arrays import F64Array, I64Array
from mlbatch.digests import compare, read_golden
from tests.builders.make_fixtures import END_NS, SECOND_NS, START_NS, TURNS
from tests.builders.run import FIXTURE, Cloud, load, scan_files, to_file
from tests.builders.scene import MACHINE_HIGH_M, MACHINE_LOW_M, hall
from tests.builders.two_lidars import (
    BEAMS,
    COLUMNS_PER_PACKET,
    LEFT,
    RIGHT,
    FixtureLidar,
    body_from_sensor,
    column_stamps,
)
from tests.golden.expected import FIXTURES, converted, expected

LIDARS = (LEFT, RIGHT)
PERIOD_NS = 100_000_000
# SOURCE.md, "What a conversion at 10 Hz must give".
T_INIT_NS = SECOND_NS + PERIOD_NS
COUNTS = {
    "head.npz": ((398, 400), 22440),
    **{f"{index:06d}.npz": ((512, 512), 27998) for index in range(7)},
    "000007.npz": ((354, 352), 18992),
}
IMU_PACKETS = 85

# Arrays of points, and what stands in empty places of organized scans.
POINT_KEYS = {
    "xyz": np.nan,
    "intensity": np.nan,
    "range_m": np.nan,
    "reflectivity": 0,
    "time_ns": 0,
    "ring": 0,
    "return_type": 0,
}

# docs/sources/outputs.md section 2.
POINT_CLOUD = np.dtype(
    [
        ("xyz", "<f4", 3),
        ("intensity", "<f4"),
        ("time_s", "<f4"),
        ("ring", "<u2"),
        ("return_type", "u1"),
        ("lidar_id", "u1"),
    ]
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fixture as npz."""
    target = tmp_path_factory.mktemp("fixture") / "scans"
    to_file(FIXTURE, target, "npz")
    return target


def stamps_sent(lidar: FixtureLidar) -> I64Array:
    """Stamps of all columns in the recording, as they were made."""
    stamps = column_stamps(lidar, SECOND_NS, TURNS).reshape(-1, COLUMNS_PER_PACKET)
    return stamps[(stamps[:, 0] >= START_NS) & (stamps[:, -1] < END_NS)].reshape(-1)


def same(one: Cloud, other: Cloud) -> None:
    """Equal to the bit."""
    for part in fields(Cloud):
        left, right = getattr(one, part.name), getattr(other, part.name)
        assert left.dtype == right.dtype, part.name
        assert left.shape == right.shape, part.name
        assert left.tobytes() == right.tobytes(), part.name


@pytest.mark.parametrize("fixture", FIXTURES)
def test_digests(fixture: str, tmp_path: Path) -> None:
    golden = read_golden(expected(fixture))
    result = compare(golden, mlbatch.digest(converted(fixture, tmp_path)))
    assert result.ok, list(map(str, result.differences[:9]))


def test_counts_are_those_of_the_scene(folder: Path) -> None:
    assert [path.name for path in scan_files(folder)] == list(COUNTS)
    for path in scan_files(folder):
        cloud = Cloud.of(path)
        columns = tuple(np.bincount(cloud.column_lidar_id, minlength=2).tolist())
        assert (columns, len(cloud.xyz)) == COUNTS[path.name]


def test_windows_lie_on_the_grid_and_hold_exactly_their_columns(folder: Path) -> None:
    for number, path in enumerate(scan_files(folder)):
        scan = load(path)
        cloud = Cloud.of(path)
        start_ns = T_INIT_NS + (number - 1) * PERIOD_NS
        assert int(scan["index"]) == number - 1
        assert (int(scan["start_ns"]), int(scan["end_ns"])) == (start_ns, start_ns + PERIOD_NS)
        assert bool(scan["complete"]) == (0 <= number - 1 < 7)
        assert (np.diff(cloud.column_stamp_ns) >= 0).all()
        for lidar_id, lidar in enumerate(LIDARS):
            sent = stamps_sent(lidar)
            inside = sent[(sent >= start_ns) & (sent < start_ns + PERIOD_NS)]
            own = cloud.column_stamp_ns[cloud.column_lidar_id == lidar_id]
            assert np.array_equal(own, inside)


def test_every_point_lies_on_a_surface_of_the_scene(folder: Path) -> None:
    cloud = Cloud.of_all(folder)
    for lidar_id, lidar in enumerate(LIDARS):
        xyz_m = cloud.of_sensor(lidar_id).xyz.astype(np.float64)
        # Half a step of the range, and float32 at 20 m.
        allowed_m = lidar.range_step_mm / 2000 + 1e-5
        assert hall().distance_to_surfaces(xyz_m).max() <= allowed_m
    # The rig's box is the machine with 0.1 m around.
    low = np.array(MACHINE_LOW_M) - 0.1
    high = np.array(MACHINE_HIGH_M) + 0.1
    assert not ((cloud.xyz > low) & (cloud.xyz < high)).all(axis=1).any()


def test_points_are_in_order_and_agree_with_their_columns(folder: Path) -> None:
    cloud = Cloud.of_all(folder)
    assert (np.diff(cloud.column.astype(np.int64)) >= 0).all()
    # All beams of these lidars fire together; rings count through both.
    step = cloud.column.astype(np.int64) * 2 * BEAMS + cloud.ring
    assert (np.diff(step) > 0).all()
    assert np.array_equal(cloud.at_ns, cloud.stamp_ns)
    assert np.array_equal(cloud.lidar_id, cloud.column_lidar_id[cloud.column])
    assert np.array_equal(cloud.lidar_id, cloud.ring // BEAMS)


def test_ranges_agree_with_positions(folder: Path) -> None:
    cloud = Cloud.of_all(folder)
    for lidar_id, lidar in enumerate(LIDARS):
        own = cloud.of_sensor(lidar_id)
        centre = body_from_sensor(lidar) @ (0.0, 0.0, lidar.lift_mm / 1000, 1.0)
        # A beam starts at its offset from the rotor's axis, but the range counts from the axis:
        # the straight distance differs by less than the offset in any direction.
        straight_m: F64Array = np.linalg.norm(own.xyz - centre[:3], axis=1)
        assert np.abs(straight_m - own.range_m).max() <= lidar.offset_mm / 1000
        steps = own.range_m.astype(np.float64) * 1000 / lidar.range_step_mm
        assert np.abs(steps - np.round(steps)).max() < 1e-2


@pytest.mark.parametrize("slices", [2, 3, 8])
def test_slices_sum_to_the_whole(slices: int, folder: Path, tmp_path: Path) -> None:
    to_file(replace(FIXTURE, slices=slices), tmp_path / "slices", "npz")
    same(Cloud.of_all(tmp_path / "slices"), Cloud.of_all(folder))
    for path in scan_files(tmp_path / "slices"):
        scan = load(path)
        stamps = Cloud.of(path).column_stamp_ns
        start_ns = T_INIT_NS + int(scan["index"]) * PERIOD_NS
        # Rounded up, see docs/batching.md.
        bounds = [start_ns - -part * PERIOD_NS // slices for part in range(slices + 1)]
        part = int(scan["slice"])
        assert [int(scan["start_ns"]), int(scan["end_ns"])] == bounds[part : part + 2]
        assert int(scan["slices"]) == slices
        assert bounds[part] <= stamps.min()
        assert stamps.max() < bounds[part + 1]


def test_split_is_the_merged_scan_cut_by_sensor(folder: Path, tmp_path: Path) -> None:
    to_file(replace(FIXTURE, split=True), tmp_path / "split", "npz")
    for lidar_id, lidar in enumerate(LIDARS):
        alone = tmp_path / "split" / lidar.name
        assert [path.name for path in scan_files(alone)] == [p.name for p in scan_files(folder)]
        for path in scan_files(folder):
            part = Cloud.of(alone / path.name)
            whole = Cloud.of(path).of_sensor(lidar_id)
            rank = np.flatnonzero(Cloud.of(path).column_lidar_id == lidar_id)
            column = np.searchsorted(rank, whole.column).astype(np.uint32)
            ring = whole.ring - np.uint16(BEAMS * lidar_id)
            same(part, replace(whole, column=column, ring=ring))
            for key in ("index", "start_ns", "end_ns", "complete", "slice", "frame_id", "sensors"):
                assert np.array_equal(load(alone / path.name)[key], load(path)[key]), key
    # All but the bytes of the files.
    rows_split, rows_merged = (
        [
            {name: cell for name, cell in row.items() if name != "checksum"}
            for row in csv.DictReader((path / "scans.csv").read_text().splitlines())
        ]
        for path in (tmp_path / "split", folder)
    )
    assert rows_split == rows_merged


def test_organized_holds_exactly_the_dense_points(folder: Path, tmp_path: Path) -> None:
    to_file(replace(FIXTURE, layout="organized"), tmp_path / "organized", "npz")
    for path in scan_files(folder):
        dense, grid = load(path), load(tmp_path / "organized" / path.name)
        assert set(dense) - set(grid) == {"column"}
        columns = len(dense["column_stamp_ns"])
        filled: npt.NDArray[np.bool_] = ~np.isnan(np.asarray(grid["range_m"], np.float32))
        assert filled.shape == (columns, BEAMS)
        assert np.array_equal(np.nonzero(filled)[0], dense["column"])
        assert np.array_equal(np.nonzero(filled)[1], np.asarray(dense["ring"], np.int64) % BEAMS)
        for key in set(grid) & set(POINT_KEYS):
            assert grid[key].dtype == dense[key].dtype
            assert grid[key][filled].tobytes() == dense[key].tobytes(), key
        _check_empty(grid, filled)


def _check_empty(grid: dict[str, npt.NDArray[np.generic]], filled: npt.NDArray[np.bool_]) -> None:
    for key, empty in POINT_KEYS.items():
        assert np.array_equal(
            grid[key][~filled].astype(np.float64),
            np.full(grid[key][~filled].shape, empty),
            equal_nan=True,
        ), key
    owner = np.broadcast_to(grid["column_lidar_id"][:, None], filled.shape)
    assert np.array_equal(grid["lidar_id"], owner)


def test_mcap_cloud_equals_npz(folder: Path, tmp_path: Path) -> None:
    to_file(FIXTURE, tmp_path / "scans.mcap", "mcap")
    with (tmp_path / "scans.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [
            (m.channel.topic, m.message, m.decoded_message) for m in reader.iter_decoded_messages()
        ]
    clouds = [row for row in found if row[0] == "/points"]
    assert len(clouds) == len(COUNTS)
    for path, (_, message, ros) in zip(scan_files(folder), clouds, strict=True):
        want = Cloud.of(path)
        start_ns = int(load(path)["start_ns"])
        stamp = ros.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == message.log_time == start_ns
        assert ros.header.frame_id == "base_link"
        assert ros.is_dense
        points = np.frombuffer(ros.data, POINT_CLOUD)
        for key in ("xyz", "intensity", "ring", "return_type", "lidar_id"):
            assert points[key].tobytes() == getattr(want, key).tobytes(), key
        exact_s = (want.at_ns - start_ns) / 1e9
        # Rounded toward zero: never above the exact time, and not a whole step below.
        given_s = points["time_s"].astype(np.float64)
        assert (given_s <= exact_s).all()
        assert (np.nextafter(points["time_s"], np.float32(1)) > exact_s).all()
    for lidar in LIDARS:
        assert sum(topic == f"/{lidar.name}/imu" for topic, _, _ in found) == IMU_PACKETS
