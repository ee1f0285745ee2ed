"""Gaussians of voxels, the map of keyframes, and distribution-to-distribution registration.

D2D-NDT after Stoyanov et al. (Fast and accurate scan registration through minimization of the
distance between compact 3D NDT representations, 2012), by damped Gauss-Newton steps. Poses are
(4, 4); steps are (rotation vector, translation) in the frame of the moved cloud.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.int64]

# The paper, section 2.2: cells of a scan for its rough and its fine registration, and of the map.
ROUGH_M, FINE_M, MAP_M = 2.5, 0.5, 1.0
_LEAST_POINTS = 6
_LEAST_GAUSSIANS = 6
# Added to every covariance: noise of ranges, and surfaces thinner than it.
_FLOOR_M2 = 0.03**2
# d2 of the score (Magnusson 2009, section 6.2), as in the D2D-NDT of its authors.
_SHARPNESS = 0.05
_MOST_ITERATIONS = 30
_CONVERGED = 1e-4
_DAMPING = 1e-3
# Cells are numbered within a cube of this many around the origin.
_CELLS = 2048
_NEIGHBOURS = np.array(
    [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
)


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """Means (n, 3), m, and covariances (n, 3, 3), m2."""

    mean: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """A registered pose and the information (6, 6) of its Gaussians; None: no match."""

    pose: Array
    information: Array | None


def voxel_gaussians(points: Array, cell_m: float) -> Gaussians:
    """Return the Gaussians of the cells of a cloud (p, 3) that have enough points."""
    return _gaussians(_moments(points, cell_m)[1])


class KeyframeMap:
    """Gaussians of the cells of the last clouds, world frame."""

    def __init__(self, clouds: int) -> None:
        """clouds: how many are kept; the oldest goes."""
        self._clouds: deque[tuple[Indices, Array]] = deque(maxlen=clouds)
        self._keys = np.zeros(0, np.int64)
        self._gaussians = Gaussians(np.zeros((0, 3)), np.zeros((0, 3, 3)))

    @property
    def empty(self) -> bool:
        """Whether nothing can be registered."""
        return not len(self._keys)

    def insert(self, points: Array) -> None:
        """Merge a cloud (p, 3), world frame, as its Gaussians."""
        self._clouds.append(_moments(points, MAP_M))
        keys = np.concatenate([own for own, _ in self._clouds])
        moments = np.concatenate([own for _, own in self._clouds])
        keys, moments = _summed(keys, moments)
        full = moments[:, 0] >= _LEAST_POINTS
        self._keys = keys[full]
        self._gaussians = _gaussians(moments)

    def nearest(self, means: Array) -> tuple[Gaussians, NDArray[np.bool_]]:
        """Return the nearest Gaussian in the cell of each mean or next to it, and where one is."""
        cells = np.floor(means / MAP_M).astype(np.int64)[:, None, :] + _NEIGHBOURS
        keys = _keys(cells)
        place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        away = ((self._gaussians.mean[place] - means[:, None]) ** 2).sum(axis=2)
        away = np.where(self._keys[place] == keys, away, np.inf)
        choice = away.argmin(axis=1)
        rows = np.arange(len(means))
        place = place[rows, choice]
        found = np.isfinite(away[rows, choice])
        own = self._gaussians
        return Gaussians(own.mean[place[found]], own.covariance[place[found]]), found


def register(source: Gaussians, keyframes: KeyframeMap, guess: Array) -> Match:
    """Move Gaussians from a guessed pose onto the map."""
    pose = guess.copy()
    information = np.zeros((6, 6))
    for _ in range(_MOST_ITERATIONS):
        rotation = pose[:3, :3]
        moved = source.mean @ rotation.T + pose[:3, 3]
        target, found = keyframes.nearest(moved)
        if len(target.mean) < _LEAST_GAUSSIANS:
            return Match(guess, None)
        error = moved[found] - target.mean
        inverse = np.linalg.inv(
            rotation @ source.covariance[found] @ rotation.T + target.covariance
        )
        pulled = np.matmul(inverse, error[..., None])[..., 0]
        weight = np.exp(-0.5 * _SHARPNESS * (error * pulled).sum(axis=1))
        # Error after a step (turn, move) in the frame of the cloud: R (m x -turn + move).
        jacobian = np.empty((len(error), 3, 6))
        jacobian[:, :, :3] = -rotation @ _skew(source.mean[found])
        jacobian[:, :, 3:] = rotation
        weighted = np.matmul(jacobian.transpose(0, 2, 1), inverse * weight[:, None, None])
        information = np.matmul(weighted, jacobian).sum(axis=0)
        slope = np.matmul(weighted, error[..., None]).sum(axis=0)[:, 0]
        damped = information + _DAMPING * np.diag(np.diag(information)) + 1e-6 * np.eye(6)
        step = -np.linalg.solve(damped, slope)
        pose = pose @ _transform(step)
        if np.abs(step).max() < _CONVERGED:
            break
    return Match(pose, information)


def _keys(cells: Indices) -> Indices:
    """Return one number for each cell (..., 3)."""
    x, y, z = np.moveaxis(cells + _CELLS // 2, -1, 0)
    keys: Indices = (x * _CELLS + y) * _CELLS + z
    return keys


def _moments(points: Array, cell_m: float) -> tuple[Indices, Array]:
    """Return the cells of a cloud: number, and count, sums and sums of products of the points."""
    x, y, z = points.T
    rows = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
    return _summed(_keys(np.floor(points / cell_m).astype(np.int64)), rows)


def _summed(keys: Indices, rows: Array) -> tuple[Indices, Array]:
    """Return distinct keys, and the sums of the rows of each."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    begins = np.flatnonzero(np.diff(ordered, prepend=-1))
    return ordered[begins], np.add.reduceat(rows[order], begins, axis=0)


def _gaussians(moments: Array) -> Gaussians:
    full = moments[moments[:, 0] >= _LEAST_POINTS]
    count = full[:, :1]
    mean = full[:, 1:4] / count
    products = full[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3) / count[..., None]
    covariance = products - mean[:, :, None] * mean[:, None, :]
    return Gaussians(mean, covariance + _FLOOR_M2 * np.eye(3))


def _transform(step: Array) -> Array:
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    moved[:3, 3] = step[3:]
    return moved


def _skew(vectors: Array) -> Array:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
