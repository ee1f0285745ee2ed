"""A map of the last few windows: a plane or an upright stem in each voxel, where there is one.

What a lidar draws moves with it: a ring on the ground is a line, the last ring and the first one on
a house form a plane, columns on a distant wall look like poles. Matched with those of the window
before, they show no motion. So only directions count across planes that continue in a neighbouring
voxel, and across stems that are alone.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array

# Voxels are numbered from the origin of the map in both directions.
_HALF = 1 << 20
# A voxel with fewer points has no reliable distribution.
_LEAST_POINTS = 6
# Noise of ranges and of the model, m.
_NOISE_M = 0.03
# Variances in squares of voxel edges; 1/12 is that of points spread evenly. A plane is spread in
# two directions, a stem in one.
_THICK = 0.1**2
_FLAT = 0.1
_LONG = 0.15**2
# Least cosine between a stem and the z axis; most of that between the normal of a wall and it.
_UPRIGHT = 0.9
_LEVEL = 0.5
# Least standard deviation of a stem in any direction, m: a single column of a lidar has none.
_ROUND_M = 0.01
# A plane continues in a neighbour: least cosine between normals, most distance in voxel edges.
_PARALLEL = 0.97
_FLUSH = 0.08
_LEVEL_NEIGHBOURS = [
    (x << 42) + (y << 21) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)
]
_NEIGHBOURS = [
    *(step + z for step in _LEVEL_NEIGHBOURS for z in (-1, 0, 1)),
    *(-1, 1),
]


def voxel_keys(points_m: F64Array, edge_m: float) -> I64Array:
    """Return one number a voxel, for points (n, 3); equal for points in one voxel."""
    cells = np.floor(points_m / edge_m).astype(np.int64) + _HALF
    keys: I64Array = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return keys


def doubled_keys(keys: I64Array) -> I64Array:
    """Return the numbers of the voxels of twice the edge that contain voxels (n,)."""
    mask = 2 * _HALF - 1
    x, y, z = keys >> 42, (keys >> 21) & mask, keys & mask
    half = _HALF // 2
    found: I64Array = (((x >> 1) + half) << 42) | (((y >> 1) + half) << 21) | ((z >> 1) + half)
    return found


def first_in_voxels(points_m: F64Array, edge_m: float) -> I64Array:
    """Return the index of the first of the points (n, 3) in each voxel, increasing."""
    return np.sort(np.unique(voxel_keys(points_m, edge_m), return_index=True)[1])


class _Sums(NamedTuple):
    """Sums over the points of each voxel: key (k,), and count, x, y, z, xx, xy, xz, yy, yz, zz.

    Coordinates count from the centre of the voxel.
    """

    key: I64Array
    total: F64Array

    @classmethod
    def by_key(cls, key: I64Array, values: F64Array) -> _Sums:
        """Sum the rows of values (n, 10) by their keys (n,)."""
        if not len(key):
            return cls(key, values)
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
        return cls(ordered[first], np.add.reduceat(values[order], first, axis=0))


class Distributions(NamedTuple):
    """Planes and stems of k voxels.

    key: (k,), increasing; mean_m: (k, 3); whiten: (k, 3, 3), rows are the directions across them,
    divided by the standard deviation in m; else 0.
    """

    key: I64Array
    mean_m: F64Array
    whiten: F64Array
    edge_m: float

    def find(self, points_m: F64Array) -> tuple[I64Array, BoolArray]:
        """Return the voxel of each point (n, 3), and whether there is one."""
        key = voxel_keys(points_m, self.edge_m)
        if not len(self.key):
            return np.zeros(len(key), np.int64), np.zeros(len(key), np.bool_)
        at = np.minimum(self.key.searchsorted(key), len(self.key) - 1)
        return at, self.key[at] == key


class LocalMap:
    """Points of the last windows, as sums a voxel."""

    def __init__(self, edge_m: float, windows: int) -> None:
        """edge_m: of a voxel; windows: how many are kept."""
        self.edge_m = edge_m
        self._windows: deque[_Sums] = deque(maxlen=windows)

    def __len__(self) -> int:
        return len(self._windows)

    def add(self, points_m: F64Array) -> None:
        """Add the points (n, 3) of a window, in the frame of the map; forget the oldest window."""
        key = voxel_keys(points_m, self.edge_m)
        x, y, z = (points_m - _centres(key, self.edge_m)).T
        rows = (np.ones(len(key)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
        self._windows.append(_Sums.by_key(key, np.stack(rows, axis=1)))

    def distributions(self) -> Distributions:
        """The planes and stems of all voxels with enough points."""
        merged = _Sums.by_key(
            np.concatenate([one.key for one in self._windows]),
            np.concatenate([one.total for one in self._windows]),
        )
        enough = merged.total[:, 0] >= _LEAST_POINTS
        key, total = merged.key[enough], merged.total[enough]
        means = total[:, 1:] / total[:, :1]
        mean, square = means[:, :3], means[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)
        variance, direction = np.linalg.eigh(square - mean[:, :, None] * mean[:, None, :])
        mean_m = mean + _centres(key, self.edge_m)
        variance = np.maximum(variance, 0.0)
        is_plane, is_stem = self._shapes(key, mean_m, variance, direction)
        used = np.stack([is_plane | is_stem, is_stem, np.zeros_like(is_stem)], axis=1)
        scale = used / np.sqrt(variance + _NOISE_M**2)
        whiten = direction.transpose(0, 2, 1) * scale[:, :, None]
        kept = is_plane | is_stem
        return Distributions(key[kept], mean_m[kept], whiten[kept], self.edge_m)

    def _shapes(
        self, key: I64Array, mean_m: F64Array, variance: F64Array, direction: F64Array
    ) -> tuple[BoolArray, BoolArray]:
        """Masks of k voxels: planes, and stems.

        variance: (k, 3), increasing, m2; direction: (k, 3, 3), their directions as columns.
        """
        first, second, third = variance.T / self.edge_m**2
        is_plane = (second >= _THICK) & (first <= _FLAT * second)
        is_wall = is_plane & (np.abs(direction[:, 2, 0]) < _LEVEL)
        is_stem = (second < _THICK) & (third >= _LONG) & (np.abs(direction[:, 2, 2]) > _UPRIGHT)
        is_stem &= variance[:, 0] >= _ROUND_M**2
        is_alone = ~_has_neighbour(key[is_stem], key[is_stem | is_wall])
        is_stem[is_stem] = is_alone
        planes = np.flatnonzero(is_plane)
        is_plane[planes] = self._continues(key[planes], mean_m[planes], direction[planes, :, 0])
        return is_plane, is_stem

    def _continues(self, key: I64Array, mean_m: F64Array, normal: F64Array) -> BoolArray:
        """Mask (k,): True for planes with a neighbour on the same plane."""
        found = np.zeros(len(key), np.bool_)
        most_m = _FLUSH * self.edge_m
        for step in _NEIGHBOURS if len(key) else ():
            at = np.minimum(key.searchsorted(key + step), len(key) - 1)
            apart_m = mean_m[at] - mean_m
            found |= (
                (key[at] == key + step)
                & (np.abs((normal * normal[at]).sum(axis=1)) > _PARALLEL)
                & (np.abs((normal * apart_m).sum(axis=1)) < most_m)
                & (np.abs((normal[at] * apart_m).sum(axis=1)) < most_m)
            )
        return found


def _has_neighbour(key: I64Array, others: I64Array) -> BoolArray:
    """Mask (k,): voxels with a horizontal neighbour among the others, which are increasing."""
    found = np.zeros(len(key), np.bool_)
    for step in _LEVEL_NEIGHBOURS if len(others) else ():
        at = np.minimum(others.searchsorted(key + step), len(others) - 1)
        found |= others[at] == key + step
    return found


def _centres(key: I64Array, edge_m: float) -> F64Array:
    mask = 2 * _HALF - 1
    cells = np.stack([key >> 42, (key >> 21) & mask, key & mask], axis=1) - _HALF
    centres: F64Array = (cells + 0.5) * edge_m
    return centres
