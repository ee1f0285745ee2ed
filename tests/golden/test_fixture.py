"""The synthetic recordings, converted: against their scene, their tables and themselves."""

from __future__ import annotations

import csv
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import mlbatch
from mlbatch.digests import compare, read_golden
from mlbatch.simulate.scene import Boxes, Rectangles, Scene, Stems
from tests.builders.run import FIXTURE, Cloud, load, scan_files, to_file
from tests.builders.simulated import distance_to_scene
from tests.builders.two_lidars import BEAMS, LEFT, RIGHT, SECOND_NS
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
MACHINE_LOW_M = (-1.6, -0.7, 0.0)
MACHINE_HIGH_M = (1.2, 0.7, 1.8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fixture as npz."""
    target = tmp_path_factory.mktemp("fixture") / "scans"
    to_file(FIXTURE, target, "npz")
    return target


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


def hall() -> Scene:
    """The scene of both SOURCE.md: walls, floor, ceiling, ramp; pillars; a crate, the machine."""
    surfaces = np.array(
        [
            [(-8, -7, 0), (20, 0, 0), (0, 0, 5)],
            [(-8, 7, 0), (20, 0, 0), (0, 0, 5)],
            [(-8, -7, 0), (0, 14, 0), (0, 0, 5)],
            [(12, -7, 0), (0, 14, 0), (0, 0, 5)],
            [(-8, -7, 0), (20, 0, 0), (0, 14, 0)],
            # The ceiling is open above x -2..6, y -4..4.
            [(-8, -7, 5), (6, 0, 0), (0, 14, 0)],
            [(6, -7, 5), (6, 0, 0), (0, 14, 0)],
            [(-2, -7, 5), (8, 0, 0), (0, 3, 0)],
            [(-2, 4, 5), (8, 0, 0), (0, 3, 0)],
            [(7, -2, 0), (4, 0, 1.5), (0, 4, 0)],
        ],
        np.float64,
    )
    pillars = np.array([(x, y, 0.0) for x in (-4, 6.5) for y in (-4.5, 4.5)])
    radius = np.full(4, 0.4)
    low = np.array([(2.5, -5.5, 0), MACHINE_LOW_M])
    high = np.array([(3.7, -4.5, 1), MACHINE_HIGH_M])
    still = (np.zeros(2), np.zeros((2, 3)), np.full(2, np.inf), np.ones(2))
    return Scene(
        (
            Rectangles(surfaces[:, 0], surfaces[:, 1], surfaces[:, 2], np.ones(len(surfaces))),
            Stems(pillars, np.full(4, 5.0), radius, radius, np.ones(4)),
            Boxes((low + high) / 2, high - low, *still),
        )
    )


# Of each sensor: a step of its range, mm, and what an azimuth in 0.01 degrees leaves open, m per m:
# half a step is 8.7e-5.
STEPS = {
    "two_lidars": ((1, 0), (8, 0)),
    "four_makers": ((8, 0), (2, 1e-4), (4, 1e-4), (2.5, 1e-4)),
}


@pytest.mark.parametrize("fixture", STEPS)
def test_every_point_lies_on_a_surface_of_the_scene(fixture: str, tmp_path: Path) -> None:
    cloud = Cloud.of_all(converted(fixture, tmp_path))
    for lidar_id, (step_mm, per_m) in enumerate(STEPS[fixture]):
        own = cloud.of_sensor(lidar_id)
        xyz_m = own.xyz.astype(np.float64)
        # Float32 at 20 m: 1e-5.
        allowed_m = step_mm / 2000 + per_m * own.range_m.astype(np.float64) + 1e-5
        away_m = distance_to_scene(hall(), xyz_m, np.zeros(len(xyz_m)))
        assert len(xyz_m) > 40_000
        assert (away_m <= allowed_m).all()


def test_the_machine_is_left_out(folder: Path) -> None:
    """The rig's box is the machine with 0.1 m around."""
    xyz_m = Cloud.of_all(folder).xyz
    low, high = np.array(MACHINE_LOW_M) - 0.1, np.array(MACHINE_HIGH_M) + 0.1
    assert not ((xyz_m > low) & (xyz_m < high)).all(axis=1).any()


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
