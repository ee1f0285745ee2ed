"""Voxels that have a point, against a set of Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mlbatch.writers.map_writer import VoxelFilter


def test_the_first_point_in_each_voxel(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    voxels = VoxelFilter(70, tmp_path)
    seen: set[tuple[int, ...]] = set()
    for scan in range(140):
        # Far and near, on both sides of 0; more blocks than the file has at first.
        spread = (300, 20_000, 2_000_000)[scan % 3]
        units = random.integers(-spread, spread, (400, 3))
        units[: scan % 7] = units[-1]
        expected = []
        for row, point in enumerate(units.tolist()):
            cell = tuple(value // 70 for value in point)
            if cell not in seen:
                expected.append(row)
                seen.add(cell)
        assert voxels.first(units).tolist() == expected
    assert voxels.first(np.zeros((0, 3), np.int64)).tolist() == []
    voxels.close()
    assert not list(tmp_path.iterdir())
