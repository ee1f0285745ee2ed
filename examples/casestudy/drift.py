"""The paper's drift: the largest error of position after an alignment on the first 10 % of the way.

A second alignment, of heading and position alone, stands beside it: on a nearly straight way the
rotation about it is hardly determined by positions (section 2.2 uses positions of a prism).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from evaluation import Array, Track, at_times

ALIGNED_SHARE = 0.1
# A total station measures about this often.
STEP_S = 0.1
# More than this share of the way is called a failure.
FAILED_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Drift:
    """Largest errors of position, m, with 6 and 4 degrees of freedom aligned; length of the way."""

    six_m: float
    four_m: float
    way_m: float


def on_reference(estimate: Track, truth: Track) -> tuple[Track, Track]:
    """Return both at the times of the reference: every 0.1 s, while there is an estimate."""
    first, last = estimate.stamp_s[[0, -1]]
    times = np.arange(np.ceil(first / STEP_S), np.floor(last / STEP_S) + 0.5) * STEP_S
    times = times[(times >= max(first, truth.stamp_s[0])) & (times <= min(last, truth.stamp_s[-1]))]
    return at_times(estimate, times), at_times(truth, times)


def aligned_poses(reference: Track) -> int:
    """Return how many poses are in the first 10 % of the way."""
    way = _way(reference)
    return int((way <= ALIGNED_SHARE * way[-1]).sum())


def drift(estimate: Track, truth: Track) -> Drift:
    """Return the drift of an estimate; both are interpolated linearly."""
    own, reference = on_reference(estimate, truth)
    count = aligned_poses(reference)
    places, true_places = own.poses[:, :3, 3], reference.poses[:, :3, 3]
    largest = []
    for rotation in (_rotation, _heading):
        turn = rotation(places[:count], true_places[:count])
        move = true_places[:count].mean(axis=0) - turn @ places[:count].mean(axis=0)
        error = places @ turn.T + move - true_places
        largest.append(float(np.sqrt((error**2).sum(axis=1)).max()))
    return Drift(largest[0], largest[1], float(_way(reference)[-1]))


def _way(track: Track) -> Array:
    steps = np.diff(track.poses[:, :3, 3], axis=0)
    way: Array = np.concatenate([[0.0], np.cumsum(np.sqrt((steps**2).sum(axis=1)))])
    return way


def _rotation(own: Array, reference: Array) -> Array:
    """Return the least-squares rotation (Umeyama 1991), without scale."""
    left, _, right = np.linalg.svd((reference - reference.mean(0)).T @ (own - own.mean(0)))
    sign = np.sign(np.linalg.det(left @ right))
    turn: Array = left @ np.diag([1.0, 1.0, sign]) @ right
    return turn


def _heading(own: Array, reference: Array) -> Array:
    """Return the least-squares rotation about z."""
    (ax, ay, _), (bx, by, _) = (own - own.mean(0)).T, (reference - reference.mean(0)).T
    angle = np.arctan2((ax * by - ay * bx).sum(), (ax * bx + ay * by).sum())
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
