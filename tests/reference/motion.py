"""Transforms of columns to one instant, pose by pose: the oracle of `motion/track.py`."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.track import PoseTrack


def column_moves(track: PoseTrack, stamp_ns: I64Array, to_ns: int) -> F64Array:
    """Return the transforms (n, 3, 4), m, of columns (n,) to the pose at `to_ns`."""
    target = track.at(to_ns)
    moves = [np.linalg.solve(target, track.at(stamp)) for stamp in stamp_ns.tolist()]
    return np.array(moves)[:, :3]
