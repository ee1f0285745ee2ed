"""The velocity of each window from its own points: `--deskew constant-velocity`.

Each window is registered against the few windows before it, with the last velocity as the first
guess. No map is kept, and poses are never used but for the motion from one window to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.motion.registration import ORIGIN, ColumnCloud, Pose, Registration, register
from mlbatch.motion.voxels import LocalMap, first_in_voxels
from mlbatch.units import NS_PER_S

_EDGE_M = 1.0
_WINDOWS = 5
# Points kept, one a small voxel: for the map, and for a registration.
_MAP_EDGE_M = 0.2
_QUERY_EDGE_M = 0.5
_MOST_QUERIES = 4000
# Beyond, columns are further apart than voxels.
_FARTHEST_M = 80.0
# Two windows further apart are not registered with each other.
_MOST_GAP_NS = NS_PER_S // 2
# Changes of velocity beyond these are errors of the registration, m/s2 and rad/s2.
_MOST_ACCELERATION = 20.0
_MOST_TURN_ACCELERATION = 20.0
# The first two windows are moved by the velocity between them, until it changes by less than this.
_SETTLED = 0.05
_MOST_ROUNDS = 15
# A window is moved if that removes this share of the cost: at rest, and where the motion changes
# within a window, it does not.
_LEAST_GAIN = 0.01

# Why a window has no velocity; words of the report.
FIRST = "first"
JUMP = "jump"
NO_GAIN = "no_gain"
REASONS = (FIRST, NO_GAIN, "few_points", "degenerate", "no_convergence", "residual", JUMP)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Motion of a window; velocity: (6,), twist a second, m/s and rad/s; None where it is unknown.

    reason: why its points are not to be moved, or ""; residual_m: of a window that was registered,
    else None.
    """

    velocity: F64Array | None = None
    reason: str = ""
    residual_m: float | None = None


class VelocityEstimator:
    """Takes the points of one window after the other."""

    def __init__(self, windows: int = _WINDOWS) -> None:
        """windows: how many are kept for the next one; more drift less, and cost more."""
        self._windows = windows
        self._map = LocalMap(_EDGE_M, windows)
        self._pose: Pose = ORIGIN
        self._velocity = np.zeros(6)
        # Middle of the last window that is in the map, or of the first one.
        self._middle_ns: int | None = None
        # The first window, until there is a second one.
        self._first: ColumnCloud | None = None

    def add(self, cloud: ColumnCloud, middle_ns: int, period_ns: int) -> Estimate:
        """Register the next window; period_ns: its length."""
        near = np.flatnonzero((cloud.points_m**2).sum(axis=1) < _FARTHEST_M**2)
        cloud = cloud.take(near)
        cloud = cloud.take(first_in_voxels(cloud.points_m, _MAP_EDGE_M))
        gap_ns = None if self._middle_ns is None else middle_ns - self._middle_ns
        if gap_ns is None or gap_ns > max(_MOST_GAP_NS, 2 * period_ns):
            return self._begin(cloud, middle_ns, FIRST)
        gap_s = gap_ns / NS_PER_S
        if self._first is not None:
            return self._second(self._first, cloud, middle_ns, gap_s)
        found = register(
            self._map.distributions(), _thinned(cloud), self._pose, gap_s, self._velocity
        )
        reason = found.failure or self._jump(found, gap_s)
        if reason:
            return Estimate(reason=reason)
        self._keep(cloud, found, middle_ns)
        # Over a failed window the velocity is an older one.
        if gap_ns > 1.5 * period_ns:
            return Estimate(reason=FIRST, residual_m=found.residual_m)
        reason = NO_GAIN if found.gain < _LEAST_GAIN else ""
        return Estimate(found.velocity, reason, found.residual_m)

    def _begin(self, cloud: ColumnCloud, middle_ns: int, reason: str) -> Estimate:
        self._first = cloud
        self._middle_ns = middle_ns
        return Estimate(reason=reason)

    def _second(
        self, first: ColumnCloud, cloud: ColumnCloud, middle_ns: int, gap_s: float
    ) -> Estimate:
        """Register the second window against the first one, which has its velocity.

        The velocity of none of them is known before: it is repeated until it settles.
        """
        velocity = np.zeros(6)
        query = _thinned(cloud)
        for _ in range(_MOST_ROUNDS):
            self._map = LocalMap(_EDGE_M, self._windows)
            self._map.add(first.moved(velocity))
            found = register(self._map.distributions(), query, ORIGIN, gap_s, velocity)
            if found.failure:
                return self._begin(cloud, middle_ns, found.failure)
            has_settled = bool(np.abs(found.velocity - velocity).max() < _SETTLED)
            velocity = found.velocity
            if has_settled:
                self._first = None
                self._keep(cloud, found, middle_ns)
                return Estimate(reason=FIRST, residual_m=found.residual_m)
        return self._begin(cloud, middle_ns, "no_convergence")

    def _jump(self, found: Registration, gap_s: float) -> str:
        change = (found.velocity - self._velocity) / gap_s
        shift, turn = math.hypot(*change[:3]), math.hypot(*change[3:])
        return JUMP if shift > _MOST_ACCELERATION or turn > _MOST_TURN_ACCELERATION else ""

    def _keep(self, cloud: ColumnCloud, found: Registration, middle_ns: int) -> None:
        moved = np.matmul(cloud.moved(found.velocity), found.pose.rotation.T)
        self._map.add(moved + found.pose.position_m)
        self._pose = found.pose
        self._velocity = found.velocity
        self._middle_ns = middle_ns


def _thinned(cloud: ColumnCloud) -> ColumnCloud:
    """The points to register."""
    rows = first_in_voxels(cloud.points_m, _QUERY_EDGE_M)
    return cloud.take(rows[:: -(-len(rows) // _MOST_QUERIES) or 1])
