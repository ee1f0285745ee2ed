"""Gaussians of voxels, the local map, and distribution-to-distribution registration (D2D-NDT).

The score of Stoyanov et al. (Fast and accurate scan registration through minimization of the
distance between compact 3D NDT representations, 2012), maximised by Gauss-Newton steps. Poses are
(4, 4), steps are (rotation vector, translation) in the frame of the moved cloud.
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

VOXEL_M = 1.0
_LEAST_POINTS = 6
# Added to every covariance: noise of ranges, and surfaces thinner than it.
_FLOOR_M2 = 0.03**2
# d2 of the score, for an outlier ratio of 0.55 and voxels of 1 m (Magnusson 2009, section 6.2).
_OUTLIERS = 0.55
_MOST_ITERATIONS = 15
_CONVERGED = 1e-4
_NEIGHBOURS = np.array(
    [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
)


def _sharpness() -> float:
    inside = 10.0 * (1.0 - _OUTLIERS)
    outside = _OUTLIERS / VOXEL_M**3
    offset = -np.log(outside)
    depth = -np.log(inside + outside) - offset
    return float(-2.0 * np.log((-np.log(inside * np.exp(-0.5) + outside) - offset) / depth))


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
    """Means (n, 3), m, and covariances (n, 3, 3), m2."""

    mean: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """A registered pose; information (6, 6): of the matched Gaussians alone."""

    pose: Array
    information: Array
    matched: int


def _moments(points: Array, keys: Indices) -> tuple[Indices, Array]:
    """Return distinct keys, and for each: number, sums and sums of products of its points."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    begins = np.flatnonzero(np.diff(ordered, prepend=np.iinfo(np.int64).min))
    x, y, z = points[order].T
    rows = np.stack([np.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
    return ordered[begins], np.add.reduceat(rows, begins, axis=0)


def _gaussians(moments: Array) -> Gaussians:
    count = moments[:, :1]
    mean = moments[:, 1:4] / count
    products = moments[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3) / count[..., None]
    covariance = products - mean[:, :, None] * mean[:, None, :]
    return Gaussians(mean, covariance + _FLOOR_M2 * np.eye(3))


def voxel_gaussians(points: Array) -> Gaussians:
    """Gaussians of the voxels of a cloud (p, 3) that have enough points."""
    cell = np.floor(points / VOXEL_M).astype(np.int64) + 512
    moments = _moments(points, (cell[:, 0] * 1024 + cell[:, 1]) * 1024 + cell[:, 2])[1]
    return _gaussians(moments[moments[:, 0] >= _LEAST_POINTS])


class LocalMap:
    """Gaussians of the voxels of the last clouds, in a box of the world around its origin."""

    _SIZE = np.array([256, 256, 96])

    def __init__(self, lasts_s: float) -> None:
        """lasts_s: clouds that are older are removed."""
        self._lasts_s = lasts_s
        self._slot_of = np.full(int(np.prod(self._SIZE)), -1, np.int32)
        self._used = 0
        self._moments = np.zeros((4096, 10))
        self._clouds: deque[tuple[float, Indices, Array]] = deque()
        self.gaussians = _gaussians(np.ones((4096, 10)))

    def insert(self, stamp_s: float, points: Array) -> None:
        """Add a cloud (p, 3), world frame, and remove those that are too old."""
        keys, moments = _moments(points, self._keys(np.floor(points / VOXEL_M).astype(np.int64)))
        inside = keys >= 0
        keys, moments = keys[inside], moments[inside]
        new = keys[self._slot_of[keys] < 0]
        self._slot_of[new] = self._used + np.arange(len(new))
        self._used += len(new)
        while self._used > len(self._moments):
            self._grow()
        slots = self._slot_of[keys].astype(np.int64)
        self._add(slots, moments)
        self._clouds.append((stamp_s, slots, moments))
        while self._clouds[0][0] < stamp_s - self._lasts_s:
            _, old, gone = self._clouds.popleft()
            self._add(old, -gone)

    def nearest(self, means: Array) -> tuple[Indices, NDArray[np.bool_]]:
        """Return the slot of the nearest Gaussian in the voxel of each mean or next to it."""
        cells = np.floor(means / VOXEL_M).astype(np.int64)[:, None, :] + _NEIGHBOURS
        keys = self._keys(cells.reshape(-1, 3))
        slots = np.where(keys >= 0, self._slot_of[keys], -1)
        slots = slots.reshape(len(means), len(_NEIGHBOURS))
        full = (slots >= 0) & (self._moments[slots, 0] >= _LEAST_POINTS)
        away = ((self.gaussians.mean[slots] - means[:, None]) ** 2).sum(axis=2)
        choice = np.argmin(np.where(full, away, np.inf), axis=1)
        rows = np.arange(len(means))
        return slots[rows, choice].astype(np.int64), full[rows, choice]

    def _keys(self, cells: Indices) -> Indices:
        """Numbers of cells (n, 3); -1 outside of the box."""
        shifted = cells + self._SIZE // 2
        inside = ((shifted >= 0) & (shifted < self._SIZE)).all(axis=1)
        keys = (shifted[:, 0] * self._SIZE[1] + shifted[:, 1]) * self._SIZE[2] + shifted[:, 2]
        found: Indices = np.where(inside, keys, -1)
        return found

    def _add(self, slots: Indices, moments: Array) -> None:
        self._moments[slots] += moments
        counts = np.maximum(self._moments[slots, :1], 1.0)
        changed = _gaussians(np.concatenate([counts, self._moments[slots, 1:]], axis=1))
        self.gaussians.mean[slots] = changed.mean
        self.gaussians.covariance[slots] = changed.covariance

    def _grow(self) -> None:
        more = np.zeros_like(self._moments)
        self._moments = np.concatenate([self._moments, more])
        own, added = self.gaussians, _gaussians(np.ones_like(more))
        self.gaussians = Gaussians(
            np.concatenate([own.mean, added.mean]),
            np.concatenate([own.covariance, added.covariance]),
        )


def register(source: Gaussians, local_map: LocalMap, guess: Array, prior: Array) -> Match:
    """Move Gaussians from a guessed pose onto the map; prior: information (6, 6) of the guess."""
    sharpness = _sharpness()
    pose = guess.copy()
    information = np.zeros((6, 6))
    matched = 0
    for _ in range(_MOST_ITERATIONS):
        rotation = pose[:3, :3]
        moved = source.mean @ rotation.T + pose[:3, 3]
        slots, found = local_map.nearest(moved)
        slots = slots[found]
        matched = len(slots)
        if matched == 0:
            return Match(guess, np.zeros((6, 6)), 0)
        target = local_map.gaussians
        error = moved[found] - target.mean[slots]
        spread = rotation @ source.covariance[found] @ rotation.T + target.covariance[slots]
        inverse = np.linalg.inv(spread)
        pulled = np.matmul(inverse, error[..., None])[..., 0]
        weight = np.exp(-0.5 * sharpness * (error * pulled).sum(axis=1))
        # Error after a step (turn, move) in the frame of the cloud: R (m x -turn + move).
        jacobian = np.empty((matched, 3, 6))
        jacobian[:, :, :3] = -rotation @ _skew(source.mean[found])
        jacobian[:, :, 3:] = rotation
        weighted = np.matmul(jacobian.transpose(0, 2, 1), inverse * weight[:, None, None])
        information = np.matmul(weighted, jacobian).sum(axis=0)
        slope = np.matmul(weighted, error[..., None]).sum(axis=0)[:, 0]
        back = np.linalg.inv(guess) @ pose
        away = np.concatenate([Rotation.from_matrix(back[:3, :3]).as_rotvec(), back[:3, 3]])
        step = -np.linalg.solve(information + prior, slope + prior @ away)
        pose = pose @ _transform(step)
        if np.abs(step).max() < _CONVERGED:
            break
    return Match(pose, information, matched)


def _transform(step: Array) -> Array:
    moved = np.eye(4)
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    moved[:3, 3] = step[3:]
    return moved


def _skew(vectors: Array) -> Array:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
