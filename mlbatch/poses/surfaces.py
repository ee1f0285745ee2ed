"""Flat pieces of surfaces in the cells of a grid, and their distances between two clouds.

Two clouds that see one wall have a plane each in the cells that it crosses. How far one plane is
from the other, along the normal, is one observation of their relative pose (as between
distributions: T. Stoyanov et al., 2012), whose variance follows from noise, number and spread of
the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.motion.voxels import doubled_keys, voxel_keys

# A cell with fewer points has no reliable plane.
_LEAST_POINTS = 8
# A plane: least standard deviation along it, in edges; most across it, m, and as a share of the
# variance along it.
_LEAST_SPREAD = 0.12
_MOST_THICK_M = 0.06
_FLAT = 0.04
# Where cells begin: the ground of many body frames is at 0, and its noise would part it.
_OFF_M = 0.11
# Planes along a face of their cell: least cosine; of a slab that touches it, the middle is
# sqrt(3) standard deviations away.
_ALIGNED = 0.9
_CUT = 2.5
# Roughness of surfaces and of the model of a lidar, m.
_FLOOR_M = 0.004


class Planes(NamedTuple):
    """Planes of k cells of a cloud.

    key: (k,), increasing; mean_m: (k, 3); time_s: (k,), mean of the points'; normal: (k, 3);
    spread: (k, 3, 3), of the error of the plane across itself: variance at distance d from the
    mean is noise + d' spread d, m2; noise: (k,), m2.
    """

    key: I64Array
    mean_m: F64Array
    time_s: F64Array
    normal: F64Array
    noise: F64Array
    spread: F64Array

    def take(self, rows: I64Array | BoolArray) -> Planes:
        """Some of the planes."""
        return Planes(
            self.key[rows],
            self.mean_m[rows],
            self.time_s[rows],
            self.normal[rows],
            self.noise[rows],
            self.spread[rows],
        )

    def variance(self, at_m: F64Array) -> F64Array:
        """Variance (k,) of each plane across itself at points (k, 3), m2."""
        off_m = at_m - self.mean_m
        found: F64Array = self.noise + np.einsum("ki,kij,kj->k", off_m, self.spread, off_m)
        return found


@dataclass(eq=False, repr=False)
class Moments:
    """Sums over the points of k cells: key (k,), increasing; count (k,); total (k, 10), of x, y, z,
    their products xx, xy, xz, yy, yz, zz, and time."""

    edge_m: float
    key: I64Array
    count: I64Array
    total: F64Array

    @classmethod
    def of_points(cls, points_m: F64Array, time_s: F64Array, edge_m: float) -> Moments:
        """Sums of points (n, 3) with times (n,), in cells of an edge."""
        x, y, z = np.ascontiguousarray(points_m.T)
        key = voxel_keys(points_m + _OFF_M, edge_m)
        columns = (x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, time_s)
        return cls._merged(edge_m, key, (None, *columns))

    def doubled(self) -> Moments:
        """The sums in cells of twice the edge."""
        return self._merged(2 * self.edge_m, doubled_keys(self.key), (self.count, *self.total.T))

    @classmethod
    def _merged(
        cls, edge_m: float, key: I64Array, columns: Sequence[F64Array | I64Array | None]
    ) -> Moments:
        """Sums by key of counts (None: ones) and the columns of `total`."""
        order = np.argsort(key)
        increasing = key[order]
        begins = np.diff(increasing, prepend=-1) != 0
        cell = np.empty(len(key), np.int64)
        cell[order] = np.cumsum(begins) - 1
        cells = int(np.count_nonzero(begins))
        # Faster than `np.add.reduceat`.
        count, *total = (np.bincount(cell, column, cells) for column in columns)
        return cls(edge_m, increasing[begins], count.astype(np.int64), np.stack(total, axis=1))

    def planes(self) -> Planes:
        """The planes of cells that have one."""
        enough = self.count >= _LEAST_POINTS
        key, count = self.key[enough], self.count[enough]
        # Products of distances to 1 km lose 0.02 mm to rounding.
        means = self.total[enough] / count[:, None]
        mean = means[:, :3]
        square = means[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)
        square -= mean[:, :, None] * mean[:, None, :]
        may_be = _may_be_flat(square, self.edge_m)
        key, count, means, mean = key[may_be], count[may_be], means[may_be], mean[may_be]
        variance, axes = np.linalg.eigh(square[may_be])
        variance = np.maximum(variance, 0.0)
        across, along, _ = variance.T
        is_plane = along >= (_LEAST_SPREAD * self.edge_m) ** 2
        is_plane &= across <= np.minimum(_FLAT * along, _MOST_THICK_M**2)
        # What a face of the cell cuts looks flat, and lies at the same place in every cloud.
        within_m = (mean + _OFF_M) % self.edge_m
        margin_m = np.minimum(within_m, self.edge_m - within_m)
        is_cut = (np.abs(axes[:, :, 0]) > _ALIGNED) & (margin_m < _CUT * np.sqrt(across)[:, None])
        is_plane &= ~is_cut.any(axis=1)
        variance, axes, count = variance[is_plane], axes[is_plane], count[is_plane]
        noise = np.maximum(variance[:, 0], _FLOOR_M**2) / (count - 3)
        # Of the tilt about each axis along the plane: noise by the spread of the points on it.
        tilt = axes[:, :, 1:] * np.sqrt(noise[:, None] / variance[:, 1:])[:, None, :]
        return Planes(
            key[is_plane],
            mean[is_plane],
            means[is_plane, 9],
            np.ascontiguousarray(axes[:, :, 0]),
            noise + _FLOOR_M**2,
            np.matmul(tilt, tilt.transpose(0, 2, 1)),
        )


def _may_be_flat(variance: F64Array, edge_m: float) -> BoolArray:
    """Mask of variances (k, 3, 3), m2, that bounds do not say are no plane: cheaper than axes."""
    xx, xy, xz, yy, yz, zz = variance.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].T
    # Of principal variances a <= b <= c: ab + ac + bc >= bc >= bb, so that abc is at most a of it.
    yy_zz, xy_zz, xy_yz = yy * zz - yz * yz, xy * zz - xz * yz, xy * yz - xz * yy
    pairs = yy_zz + xx * zz - xz * xz + xx * yy - xy * xy
    product = xx * yy_zz - xy * xy_zz + xz * xy_yz
    found = pairs >= (_LEAST_SPREAD * edge_m) ** 4
    found &= product <= pairs * np.minimum(_MOST_THICK_M**2, _FLAT * np.sqrt(np.abs(pairs)))
    return np.asarray(found, np.bool_)


def planes(points_m: F64Array, time_s: F64Array, edge_m: float) -> Planes:
    """Planes of points (n, 3) with times (n,), in cells of an edge."""
    return Moments.of_points(points_m, time_s, edge_m).planes()


@dataclass(eq=False, repr=False)
class Distances:
    """Distances between the planes of two clouds, m rows.

    key: (m,), of the cell; normal: (m, 3); at_m: (m, 3), between the two planes; distance_m: (m,),
    from the first to the second along the normal; sigma_m: (m,), its standard deviation;
    time_s: (m, 2), of both; tilt: (m, 3), half of the difference of the two normals.
    """

    key: I64Array
    normal: F64Array
    at_m: F64Array
    distance_m: F64Array
    sigma_m: F64Array
    time_s: F64Array
    tilt: F64Array

    def __len__(self) -> int:
        return len(self.key)


NO_DISTANCES = Distances(
    *(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0)),
    *(np.zeros((0, 2)), np.zeros((0, 3))),
)


def joined(parts: Sequence[Distances]) -> Distances:
    """The rows of all parts, in their order."""
    parts = [NO_DISTANCES, *parts]
    columns = ([getattr(part, each.name) for part in parts] for each in fields(Distances))
    return Distances(*map(np.concatenate, columns))


def shared_cells(first: Planes, second: Planes) -> tuple[I64Array, I64Array]:
    """Rows of both in which they have a plane in the same cell."""
    at = np.minimum(np.searchsorted(second.key, first.key), max(0, len(second.key) - 1))
    if not len(second.key):
        return at[:0], at[:0]
    left = np.flatnonzero(second.key[at] == first.key)
    return left, at[left]


def distances(first: Planes, second: Planes, parallel: float, most_m: float) -> Distances:
    """Compare the planes of two clouds in the cells that they share.

    parallel: least cosine between normals; most_m: largest distance.
    """
    left, right = shared_cells(first, second)
    first, second = first.take(left), second.take(right)
    cosine = (first.normal * second.normal).sum(axis=1)
    opposite = np.sign(cosine)[:, None] * second.normal
    normal = first.normal + opposite
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    at_m = (first.mean_m + second.mean_m) / 2
    distance_m = (normal * (second.mean_m - first.mean_m)).sum(axis=1)
    variance = first.variance(at_m) + second.variance(at_m)
    kept = (np.abs(cosine) >= parallel) & (np.abs(distance_m) <= most_m)
    return Distances(
        first.key[kept],
        normal[kept],
        at_m[kept],
        distance_m[kept],
        np.sqrt(variance[kept]),
        np.stack([first.time_s, second.time_s], axis=1)[kept],
        ((first.normal - opposite) / 2)[kept],
    )
