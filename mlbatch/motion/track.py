"""Poses of the body at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.motion.se3 import exp_transform, log_transform
from mlbatch.units import NS_PER_S

# Poses further apart do not define the motion between them.
MAX_GAP_NS = NS_PER_S // 2


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """n poses world_from_body: rotation (n, 3, 3), position_m (n, 3); known: (n,) or identity."""

    rotation: F64Array
    position_m: F64Array
    known: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Poses world_from_body at increasing times; source: what the report names.

    stamp_ns: (k,) common clock; rotation: (k, 3, 3); position_m: (k, 3).
    """

    stamp_ns: I64Array
    rotation: F64Array
    position_m: F64Array
    source: str = ""
    max_gap_ns: int = MAX_GAP_NS

    def at(self, stamp_ns: I64Array) -> Poses:
        """Return the poses at times (n,), interpolated on SE(3): constant twist between poses.

        Unknown before the first pose, after the last one, and between poses further apart than
        max_gap_ns.
        """
        count = len(stamp_ns)
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
        position = np.zeros((count, 3))
        known = np.zeros(count, np.bool_)
        if len(self.stamp_ns) == 0 or count == 0:
            return Poses(rotation, position, known)
        after = np.searchsorted(self.stamp_ns, stamp_ns, "left")
        # A stamp of a pose needs no other one.
        inside = np.minimum(after, len(self.stamp_ns) - 1)
        exact = self.stamp_ns[inside] == stamp_ns
        rotation[exact] = self.rotation[inside[exact]]
        position[exact] = self.position_m[inside[exact]]
        known |= exact
        between = (after > 0) & (after < len(self.stamp_ns)) & ~exact
        gap_ns = self.stamp_ns[inside] - self.stamp_ns[np.maximum(inside - 1, 0)]
        between &= gap_ns <= self.max_gap_ns
        rows = np.flatnonzero(between)
        # Many columns lie between the same two poses.
        pairs, pair = np.unique(after[rows], return_inverse=True)
        begin = self.rotation[pairs - 1]
        back = begin.transpose(0, 2, 1)
        moved = np.matmul(back, (self.position_m[pairs] - self.position_m[pairs - 1])[..., None])
        part, vector = log_transform(np.matmul(back, self.rotation[pairs]), moved[..., 0])
        since = stamp_ns[rows] - self.stamp_ns[after[rows] - 1]
        share = (since / gap_ns[rows])[:, None]
        turn, step = exp_transform(share * part[pair], share * vector[pair])
        rotation[rows] = np.matmul(begin[pair], turn)
        position[rows] = np.matmul(begin[pair], step[..., None])[..., 0]
        position[rows] += self.position_m[after[rows] - 1]
        known[rows] = True
        return Poses(rotation, position, known)
