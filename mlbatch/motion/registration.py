"""Registration of a window against a local map: the pose at its middle, and so its velocity.

The points of the window are moved to its middle by a constant twist, which is that of the motion
from the window before: each step of Gauss-Newton changes the pose, and with it the twist. Residuals
are distances across the plane or stem in the voxel that a point lies in (after the normal
distributions transform: P. Biber, W. Strasser, 2003), with the robust kernel of Geman and McClure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.se3 import exp_rotation, exp_transform, log_transform
from mlbatch.motion.voxels import Distributions

_MOST_STEPS = 40
# Steps below these end the iteration.
_STEP_M = 2e-4
_STEP_RAD = 2e-5
# Squared residual, in variances, at which the kernel quarters the influence of a point.
_KERNEL = 6.0
_FEWEST_MATCHES = 150
_MOST_CONDITION = 1e12
# Bounds of a result that can be used. A corridor gives decimetres along it.
_MOST_SPREAD_M = 0.02
_MOST_SPREAD_RAD = 0.005
_LEAST_SHARE = 0.004
_MOST_RESIDUAL_M = 0.1
# Digits of velocities in m/s and rad/s, so that the last bits of a processor do not matter.
_DIGITS = 6


class Pose(NamedTuple):
    """A rigid transform: rotation (3, 3), position_m (3,)."""

    rotation: F64Array
    position_m: F64Array

    def then(self, twist: F64Array) -> Pose:
        """The pose after a motion by a twist (6,) in its own frame."""
        rotation, position = exp_transform(twist[None, :3], twist[None, 3:])
        return Pose(
            np.matmul(self.rotation, rotation[0]),
            self.position_m + np.matmul(self.rotation, position[0]),
        )

    def twist_to(self, other: Pose) -> F64Array:
        """The twist (6,), translation part and rotation vector, that leads to another pose."""
        back = self.rotation.T
        rotation = np.matmul(back, other.rotation)
        step = np.matmul(back, other.position_m - self.position_m)
        part, vector = log_transform(rotation[None], step[None])
        return np.concatenate([part[0], vector[0]])


ORIGIN = Pose(np.eye(3), np.zeros(3))


class ColumnCloud(NamedTuple):
    """Points (n, 3) of a window in the body frame, m, as measured.

    column: (n,), index into time_s; time_s: (c,) of the columns, from the middle of the window.
    """

    points_m: F64Array
    column: I64Array
    time_s: F64Array

    @classmethod
    def of_points(cls, points_m: F64Array, time_s: F64Array) -> ColumnCloud:
        """Points (n, 3) at times (n,), those of one time as a column."""
        times_s, column = np.unique(time_s, return_inverse=True)
        return cls(points_m, column, times_s)

    def take(self, rows: I64Array) -> ColumnCloud:
        """Some of the points."""
        return ColumnCloud(self.points_m[rows], self.column[rows], self.time_s)

    def moved(self, velocity: F64Array) -> F64Array:
        """The points at the middle of the window, for a velocity (6,): twist a second."""
        twists = self.time_s[:, None] * velocity
        rotation, step = exp_transform(twists[:, :3], twists[:, 3:])
        turned = np.matmul(rotation[self.column], self.points_m[:, :, None])[:, :, 0]
        moved: F64Array = turned + step[self.column]
        return moved


class Registration(NamedTuple):
    """Outcome of a registration.

    pose: map_from_body at the middle of the window; velocity: (6,), twist a second; residual_m:
    median distance of matched points across planes and stems; gain: share of the cost of all points
    that is gone since they were moved; failure: why the result cannot be used, a word of the
    report, or an empty text.
    """

    pose: Pose
    velocity: F64Array
    residual_m: float = 0.0
    gain: float = 0.0
    failure: str = ""


class _Matches:
    """Points of a window in the voxels of the map, and the equations of a step."""

    def __init__(self, distributions: Distributions, local_m: F64Array, pose: Pose) -> None:
        """local_m: (n, 3), at the middle of the window, body frame."""
        arms_m = np.matmul(local_m, pose.rotation.T)
        points_m = arms_m + pose.position_m
        voxel, is_inside = distributions.find(points_m)
        voxel = voxel[is_inside]
        self.count = len(voxel)
        offset_m = points_m[is_inside] - distributions.mean_m[voxel]
        self._whiten = distributions.whiten[voxel]
        self._residual = np.matmul(self._whiten, offset_m[:, :, None])[:, :, 0]
        self._arms_m = arms_m[is_inside]

    def equations(self) -> tuple[F64Array, F64Array]:
        """Return the normal matrix (6, 6) and the gradient (6,) of shift in m and turn in rad."""
        square = (self._residual**2).sum(axis=1)
        # The square root of the weight (1 + square / kernel)^-2.
        root = 1.0 / (1.0 + square / _KERNEL)
        jacobian = np.concatenate([self._whiten, _cross(self._arms_m, self._whiten)], axis=2)
        rows = (jacobian * root[:, None, None]).reshape(-1, 6)
        values = (self._residual * root[:, None]).reshape(-1)
        return np.matmul(rows.T, rows), np.matmul(rows.T, values)

    def cost(self, points: int) -> float:
        """Sum of the kernel over all points; of a point in no voxel the most that it can be."""
        square = (self._residual**2).sum(axis=1)
        within = float((_KERNEL * square / (_KERNEL + square)).sum())
        return within + _KERNEL * (points - self.count)

    @property
    def residual_m(self) -> float:
        """Median distance across planes and stems."""
        size = np.sqrt((self._residual**2).sum(axis=1))
        across = np.sqrt((self._whiten**2).sum(axis=(1, 2)))
        return float(np.median(size / across))


def register(
    distributions: Distributions, cloud: ColumnCloud, before: Pose, gap_s: float, velocity: F64Array
) -> Registration:
    """Register a window; before: pose at the middle of an earlier one, gap_s ago.

    velocity: (6,), the first guess.
    """
    pose = before.then(velocity * gap_s)
    for _ in range(_MOST_STEPS):
        matches = _Matches(distributions, cloud.moved(velocity), pose)
        if matches.count < _FEWEST_MATCHES:
            return Registration(pose, velocity, failure="few_points")
        normal, gradient = matches.equations()
        if np.linalg.cond(normal) > _MOST_CONDITION:
            return Registration(pose, velocity, failure="degenerate")
        step: F64Array = np.negative(np.linalg.solve(normal, gradient))
        turn = exp_rotation(step[None, 3:])[0]
        pose = Pose(np.matmul(turn, pose.rotation), pose.position_m + step[:3])
        velocity = before.twist_to(pose) / gap_s
        if np.abs(step[:3]).max() < _STEP_M and np.abs(step[3:]).max() < _STEP_RAD:
            velocity = np.round(velocity, _DIGITS)
            failure = "degenerate" if _is_degenerate(normal) else ""
            if not failure and matches.residual_m > _MOST_RESIDUAL_M:
                failure = "residual"
            unmoved = _Matches(distributions, cloud.points_m, pose)
            count = len(cloud.points_m)
            gain = 1.0 - matches.cost(count) / max(unmoved.cost(count), 1e-12)
            return Registration(
                before.then(velocity * gap_s), velocity, matches.residual_m, gain, failure
            )
    return Registration(pose, velocity, failure="no_convergence")


def _is_degenerate(normal: F64Array) -> bool:
    """Whether a direction of motion is not seen, as along a corridor."""
    inverse = np.linalg.inv(normal)
    spread_m = np.sqrt(np.linalg.eigvalsh(inverse[:3, :3])[-1])
    spread_rad = np.sqrt(np.linalg.eigvalsh(inverse[3:, 3:])[-1])
    share = np.linalg.eigvalsh(normal[:3, :3])[0] / np.trace(normal[:3, :3])
    return bool(spread_m > _MOST_SPREAD_M or spread_rad > _MOST_SPREAD_RAD or share < _LEAST_SHARE)


def _cross(arms: F64Array, rows: F64Array) -> F64Array:
    """Return arms (n, 3) times rows (n, 3, 3), crosswise."""
    x, y, z = (arms[:, axis, None] for axis in range(3))
    a, b, c = (rows[:, :, axis] for axis in range(3))
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=2)
