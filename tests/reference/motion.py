"""Transforms of columns to one instant, pose by pose: the oracle of `motion/track.py`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.motion.track import PoseTrack


@dataclass(frozen=True, slots=True, eq=False)
class ColumnMotion:
    """Transforms of n columns into the body frame at one instant; identity without a pose.

    rotation: (n, 3, 3); translation_m: (n, 3); no_pose: (n,).
    """

    rotation: F64Array
    translation_m: F64Array
    no_pose: BoolArray


def column_motion(track: PoseTrack, stamp_ns: I64Array, to_ns: int) -> ColumnMotion:
    """Return the transforms of columns (n,) to the pose at `to_ns`.

    All columns are without a pose if there is none at `to_ns`.
    """
    target = track.at(np.array([to_ns], np.int64))
    poses = track.at(stamp_ns)
    count = len(stamp_ns)
    no_pose = ~poses.known if target.known[0] else np.ones(count, np.bool_)
    back = target.rotation[0].T
    rotation = np.matmul(back, poses.rotation)
    translation = (poses.position_m - target.position_m[0]) @ back.T
    rotation[no_pose] = np.eye(3)
    translation[no_pose] = 0.0
    return ColumnMotion(rotation, translation, no_pose)
