"""Poses of lidars from the motion of the machine alone, without a guess.

Each lidar measures its own motion from window to window, in its own frame, however it is mounted.
All are on one rigid body, so that the twist of one in its frame is that of the first lidar in the
other's (hand-eye calibration: K. Daniilidis, 1999; here per twist, weighted by their covariances).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.registration import Pose


@dataclass(frozen=True, slots=True, eq=False)
class SensorCloud:
    """Points of one lidar in one window, as measured: (n, 3) in its sensor frame, m; stamp_ns:
    (n,), int64, common clock."""

    points_m: F64Array
    stamp_ns: I64Array


@dataclass(frozen=True, slots=True, eq=False)
class MotionPose:
    """Pose of a lidar as its motion gives it.

    first_from_lidar: where nothing determines it along `weak`, the shift is the shortest one;
    sigma: (6,), standard deviations of shift, m, and turn, rad, in the frame of the first lidar,
    of what is determined; weak: (6, w), unit directions of shift and turn that the motion does not
    determine; undetermined: the same in words, each with what to record instead; refusal: why there
    is no pose that a refinement could start from, or "".
    """

    first_from_lidar: Pose
    sigma: F64Array
    weak: F64Array
    undetermined: tuple[str, ...]
    refusal: str


@dataclass(frozen=True, slots=True, eq=False)
class MotionPoses:
    """Poses of all lidars, the first one as it is; refusal: of all of them, or "".

    twists: number of pairs of windows whose motion was used, of each lidar.
    """

    poses: tuple[MotionPose, ...]
    twists: tuple[int, ...]
    refusal: str


def poses_from_motion(
    windows: Iterable[Sequence[SensorCloud]], names: Sequence[str]
) -> MotionPoses:
    """Poses of lidars in the frame of the first one.

    windows: each a cloud for each lidar, in order of `names`, consecutive; only the last few are
    held.
    """
    raise NotImplementedError
