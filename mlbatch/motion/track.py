"""Poses of the body at any time, and what moves columns to the pose at one instant.

Between two poses the twist is constant, so that the transform of a column is a sum of five matrices
of its pair of poses, times functions of its share of the way: for a twist with translation part p
and rotation vector w, W the matrix of w, and a share s,

    rotation     I + s a(s |w|) W + s^2 b(s |w|) W^2
    translation  s p + s^2 b(s |w|) W p + s^3 c(s |w|) W^2 p

with a, b and c as of `se3.coefficients`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.motion.se3 import coefficients, exp_transform, log_transform, skew
from mlbatch.units import NS_PER_S

# Poses further apart do not define the motion between them.
MAX_GAP_NS = NS_PER_S // 2


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

    def at(self, stamp_ns: int) -> F64Array:
        """Return the pose (4, 4) at a time that has one, on SE(3) with a constant twist between."""
        found = np.eye(4)
        after = int(self.stamp_ns.searchsorted(stamp_ns))
        if self.stamp_ns[after] == stamp_ns:
            found[:3, :3], found[:3, 3] = self.rotation[after], self.position_m[after]
            return found
        begin, end = slice(after - 1, after), slice(after, after + 1)
        back = self.rotation[begin].transpose(0, 2, 1)
        moved = np.matmul(back, (self.position_m[end] - self.position_m[begin])[..., None])
        part, vector = log_transform(np.matmul(back, self.rotation[end]), moved[..., 0])
        share = (stamp_ns - self.stamp_ns[begin]) / (self.stamp_ns[end] - self.stamp_ns[begin])
        turn, step = exp_transform(share * part, share * vector)
        found[:3, :3] = np.matmul(self.rotation[begin], turn)[0]
        found[:3, 3] = np.matmul(self.rotation[begin], step[..., None])[0, :, 0]
        found[:3, 3] += self.position_m[after - 1]
        return found


# Smaller entries do not change a float32 coordinate.
_NOTHING = 1e-9


class PoseLine:
    """Poses of the body in order of time; new ones are added at the end.

    track: poses that are kept; poses: number that were added.
    """

    def __init__(self, track: PoseTrack) -> None:
        self.track = track
        # Of each pair of poses, when it is added: a pair is in two windows or more.
        self._terms, self._angle = _pair_terms(track.rotation, track.position_m)
        self.poses = len(track.stamp_ns)

    @property
    def newest_ns(self) -> int | None:
        """Time of the last pose; None without a pose."""
        stamps = self.track.stamp_ns
        return int(stamps[-1]) if len(stamps) else None

    def extend(self, track: PoseTrack, keep_ns: int) -> None:
        """Add later poses; forget those before `keep_ns` but one."""
        own = self.track
        first = max(0, int(own.stamp_ns.searchsorted(keep_ns, "right")) - 1)
        self.poses += len(track.stamp_ns)
        before = slice(len(own.stamp_ns) - 1, None) if len(own.stamp_ns) else slice(0)
        terms, angle = _pair_terms(
            np.concatenate([own.rotation[before], track.rotation]),
            np.concatenate([own.position_m[before], track.position_m]),
        )
        self._terms = np.concatenate([self._terms[first:], terms])
        self._angle = np.concatenate([self._angle[first:], angle])
        self.track = PoseTrack(
            np.concatenate([own.stamp_ns[first:], track.stamp_ns]),
            np.concatenate([own.rotation[first:], track.rotation]),
            np.concatenate([own.position_m[first:], track.position_m]),
            own.source,
            own.max_gap_ns,
        )

    def has_poses(self, stamp_ns: I64Array, to_ns: int) -> bool:
        """Whether there is a pose at all times (n,), which increase, and at `to_ns`."""
        begin, end = self._span(stamp_ns, to_ns)
        stamps = self.track.stamp_ns
        if not len(stamps) or stamps[0] > begin or stamps[-1] < end:
            return False
        inside = np.append(stamp_ns, to_ns)
        after = stamps.searchsorted(inside, "left")
        is_between = stamps[after] != inside
        gap_ns = stamps[after] - stamps[np.maximum(after - 1, 0)]
        return not bool((is_between & (gap_ns > self.track.max_gap_ns)).any())

    def moves(self, stamp_ns: I64Array, to_ns: int) -> F32Array | None:
        """Return body_at_instant from body_at_column, (n, 3, 4) m, of columns that have poses.

        stamp_ns: (n,), increasing. None where the body did not move.
        """
        begin_ns, end_ns = self._span(stamp_ns, to_ns)
        around = self._around(begin_ns, end_ns)
        poses = self.track.stamp_ns[around]
        pairs = slice(around.start, around.stop - 1)
        terms, angle = self._terms[pairs].reshape(-1, 5, 3, 4).copy(), self._angle[pairs]
        # Relative to the first pose: far from the origin little would be left of a difference.
        position_m = self.track.position_m[around]
        terms[:, 0, :, 3] += position_m[:-1] - position_m[0]
        # The instant as a column more.
        times = np.append(stamp_ns, to_ns)
        pair = np.clip(poses.searchsorted(times, "right") - 1, 0, len(poses) - 2)
        shares: F64Array = (times - poses[pair]) / (poses[1:] - poses[:-1])[pair]
        weights = _weights(shares, angle[pair])
        target = (weights[-1] @ terms[pair[-1]].reshape(5, 12)).reshape(3, 4)
        terms = np.matmul(target[:, :3].T, terms)
        terms[:, 0, :, 3] -= target[:, 3] @ target[:, :3]
        # Columns between two poses follow each other.
        terms = terms.reshape(-1, 5, 12)
        moves: F64Array = np.empty((len(stamp_ns), 12))
        bounds = stamp_ns.searchsorted(poses[1:-1]).tolist()
        for matrices, begin, end in zip(terms, [0, *bounds], [*bounds, len(stamp_ns)], strict=True):
            if begin < end:
                np.matmul(weights[begin:end], matrices, out=moves[begin:end])
        moves = moves.reshape(-1, 3, 4)
        # The ends first: a body that moves is seen there.
        if not _are_moved(moves[[0, -1]]) and not _are_moved(moves):
            return None
        return np.ascontiguousarray(moves, np.float32)

    def _around(self, begin_ns: int, end_ns: int) -> slice:
        """The poses around a span of time, two at least."""
        stamps = self.track.stamp_ns
        low = max(0, int(stamps.searchsorted(begin_ns, "right")) - 1)
        high = min(len(stamps), int(stamps.searchsorted(end_ns, "left")) + 1)
        low = max(0, min(low, high - 2))
        return slice(low, max(high, low + 2))

    @staticmethod
    def _span(stamp_ns: I64Array, to_ns: int) -> tuple[int, int]:
        return min(int(stamp_ns[0]), to_ns), max(int(stamp_ns[-1]), to_ns)


def _are_moved(moves: F64Array) -> bool:
    return bool(np.abs(moves - np.eye(3, 4)).max() >= _NOTHING)


def _weights(shares: F64Array, angle: F64Array) -> F64Array:
    """Return the weights (n, 5) of the terms for shares (n,) of twists with angles (n,)."""
    first, second, third = coefficients(shares * angle)
    square = shares * shares
    ones = np.ones(len(shares))
    return np.stack([ones, shares, shares * first, square * second, square * shares * third], 1)


def _pair_terms(rotation: F64Array, position_m: F64Array) -> tuple[F64Array, F64Array]:
    """Return the five matrices (k, 5, 12) of k pairs of poses, and their angles (k,).

    They are in the world, but from the first pose of each pair. rotation, position_m: of k + 1
    poses world_from_body, or of none.
    """
    begin = rotation[:-1]
    back = begin.transpose(0, 2, 1)
    step_m = np.matmul(back, (position_m[1:] - position_m[:-1])[..., None])[..., 0]
    part, vector = log_transform(np.matmul(back, rotation[1:]), step_m)
    cross = skew(vector)
    square = np.matmul(cross, cross)
    terms = np.zeros((len(part), 5, 3, 4))
    terms[:, 0, :, :3] = np.eye(3)
    terms[:, 1, :, 3] = part
    terms[:, 2, :, :3] = cross
    terms[:, 3, :, :3] = square
    terms[:, 3, :, 3] = np.matmul(cross, part[..., None])[..., 0]
    terms[:, 4, :, 3] = np.matmul(square, part[..., None])[..., 0]
    in_world: F64Array = np.matmul(begin[:, None], terms)
    return in_world.reshape(len(part), 5, 12), np.sqrt((vector**2).sum(axis=1))
