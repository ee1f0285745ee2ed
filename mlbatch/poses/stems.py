"""Axes of upright stems, poles and columns in a cloud.

Two lidars see different sides of a stem. Across its width the points of a beam that sweeps over a
cylinder are spread evenly, so their variance there is r^2 / 3, and their mean lies pi / 4 r before
the axis: radius and axis follow in closed form.

Stems all look the same: least squares from afar may match each with its neighbour. Each turn about
the upright and each shift of a guess has as many votes as stems that meet; the right one has by far
the most.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import exp_rotation
from mlbatch.poses.surfaces import NO_DISTANCES, Distances

# Points are grouped in layers, by neighbouring cells in a layer, m.
_LAYER_M = 0.8
_CELL_M = 0.2
_FARTHEST_M = 25.0
# Groups wider than this many cells are no stems.
_MOST_CELLS = 6
_LEAST_POINTS = 10
_RADIUS_M = (0.05, 0.5)
# Of the heights of the points of a stem, m: less than two rings have.
_LEAST_HIGH_M = 0.08
# Kurtosis across: 1.8 where points are spread evenly, 1 of two columns, 3 of foliage.
_KURTOSIS = (1.45, 2.4)
# Curvature of the face seen, as a share of 1 / radius: least squares of the half circle give 0.74.
_CURVED = (0.3, 1.3)
# Of the depth of points about the half circle, m and share of the radius.
_ROUGH_M, _ROUGH_SHARE = 0.03, 0.2
# Of an axis that is not a perfect cylinder, m.
_FLOOR_M = 0.008
# Stems stand parallel: fewest steps from layer to layer that say how, and most of a step, m.
_FEWEST_STEPS = 4
_MOST_STEP_M = 0.5
# Stems are compared at most this far from their middles, m.
_MOST_ALONG_M = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Stems:
    """Pieces of k stems of a cloud.

    axis_m: (k, 3), on the axis in the middle of the piece; along: (3,), unit, of all; radius_m,
    sigma_m, time_s: (k,); sigma of the axis across.
    """

    axis_m: F64Array
    along: F64Array
    radius_m: F64Array
    sigma_m: F64Array
    time_s: F64Array

    def __len__(self) -> int:
        return len(self.radius_m)


NO_STEMS = Stems(np.zeros((0, 3)), np.array([0.0, 0.0, 1.0]), np.zeros(0), np.zeros(0), np.zeros(0))


def stems(points_m: F64Array, time_s: F64Array, origin_m: F64Array) -> Stems:
    """Stems among points (n, 3) with times (n,), seen from the origin (3,) of their lidar.

    z must be up within 30 degrees.
    """
    near = ((points_m - origin_m) ** 2).sum(axis=1) < _FARTHEST_M**2
    group = _groups(points_m[near])
    rows = np.flatnonzero(near)[group >= 0]
    group = group[group >= 0]
    if not len(group):
        return NO_STEMS
    order = np.argsort(group, kind="stable")
    rows, group = rows[order], group[order]
    first = np.flatnonzero(np.concatenate([[True], group[1:] != group[:-1]]))
    points_m = points_m[rows]
    count = np.diff(first, append=len(rows))
    mean = np.add.reduceat(points_m, first, axis=0) / count[:, None]
    along = _direction(mean)
    if along is None:
        return NO_STEMS
    view = mean - origin_m
    view -= np.matmul(view, along)[:, None] * along
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    local = points_m - np.repeat(mean, count, axis=0)
    high = np.matmul(local, along)
    across = (local * np.repeat(np.cross(along, view), count, axis=0)).sum(axis=1)
    deep = (local * np.repeat(view, count, axis=0)).sum(axis=1)
    width = across**2
    terms = np.stack([high**2, width, width**2, deep, deep * width, deep**2], axis=1)
    high2, width2, width4, deep1, deep_width, deep2 = (
        np.add.reduceat(terms, first, axis=0) / count[:, None]
    ).T
    between = _between_columns(across, first)
    radius_m = np.sqrt(3.0 * (width2 + between))
    kurtosis = width4 / (width2**2 + 1e-12)
    spread = width4 - width2**2
    curve = (deep_width - deep1 * width2) / (spread + 1e-12)
    rough_m = np.sqrt(np.maximum(deep2 - curve**2 * spread, 0.0))
    good = (high2 > _LEAST_HIGH_M**2) & _within(radius_m, _RADIUS_M) & _within(kurtosis, _KURTOSIS)
    good &= _within(curve * radius_m, _CURVED)
    good &= rough_m < _ROUGH_M + _ROUGH_SHARE * radius_m
    axis_m = mean + np.pi / 4 * radius_m[:, None] * view
    # Either edge is somewhere between two columns.
    sigma_m = np.sqrt(_FLOOR_M**2 + between / 2)
    mean_s = np.add.reduceat(time_s[rows], first) / count
    return Stems(axis_m[good], along, radius_m[good], sigma_m[good], mean_s[good])


def _between_columns(across_m: F64Array, first: I64Array) -> F64Array:
    """Variance (k,) that the width between columns adds to that of their points, m2.

    across_m: (n,), of the points of groups that begin at first (k,).
    """
    count = np.diff(first, append=len(across_m))
    order = np.lexsort((across_m, np.repeat(np.arange(len(first)), count)))
    gap = np.diff(across_m[order], append=0.0)
    # Not from the last point of a group to the next group.
    gap[first + count - 1] = 0.0
    found: F64Array = np.add.reduceat(gap**3, first) / (np.add.reduceat(gap, first) + 1e-9)
    return found / 12.0


def _within(values: F64Array, limits: tuple[float, float]) -> BoolArray:
    return (values >= limits[0]) & (values <= limits[1])


def _groups(points_m: F64Array) -> I64Array:
    """A number of the group of each point (n,): neighbours in a layer; -1: too large or small."""
    cells = np.floor(points_m / [_CELL_M, _CELL_M, _LAYER_M]).astype(np.int64) + (1 << 16)
    key, inverse, count = np.unique(
        (cells[:, 2] << 40) | (cells[:, 1] << 20) | cells[:, 0],
        return_inverse=True,
        return_counts=True,
    )
    ends = []
    for step in (1, 1 << 20, (1 << 20) + 1, (1 << 20) - 1):
        at = np.minimum(np.searchsorted(key, key + step), max(0, len(key) - 1))
        start = np.flatnonzero(key[at] == key + step)
        ends.append((start, at[start]))
    one, other = (np.concatenate(side) for side in zip(*ends, strict=True))
    label = np.arange(len(key))
    # The least number of a group reaches all of its cells if it is small.
    for _ in range(_MOST_CELLS):
        least = np.minimum(label[one], label[other])
        np.minimum.at(label, one, least)
        np.minimum.at(label, other, least)
    size = np.zeros(len(key), np.int64)
    np.add.at(size, label, count)
    usable = size >= _LEAST_POINTS
    usable[label[one][label[one] != label[other]]] = False
    usable[label[other][label[one] != label[other]]] = False
    label[~usable[label]] = -1
    found: I64Array = label[inverse]
    return found


def _direction(mean: F64Array) -> F64Array | None:
    """The direction of the most stems, from groups (k, 3) above each other."""
    layer = np.floor(mean[:, 2] / _LAYER_M).astype(np.int64)
    apart = mean[None, :, :] - mean[:, None, :]
    level = np.hypot(apart[:, :, 0], apart[:, :, 1])
    level[layer[None, :] != layer[:, None] + 1] = np.inf
    nearest = np.argmin(level, axis=1)
    steps = np.flatnonzero(level[np.arange(len(mean)), nearest] < _MOST_STEP_M)
    if len(steps) < _FEWEST_STEPS:
        return None
    way = apart[steps, nearest[steps]]
    slope = np.median(way[:, :2] / way[:, 2:], axis=0)
    way = np.array([slope[0], slope[1], 1.0])
    found: F64Array = way / np.linalg.norm(way)
    return found


def stem_distances(first: Stems, second: Stems, parallel: float, most_m: float) -> Distances:
    """Compare the axes of two clouds, each with the nearest of the other: two rows per pair.

    parallel: least cosine between the directions; most_m: largest distance.
    """
    if not len(first) or not len(second) or first.along @ second.along < parallel:
        return NO_DISTANCES
    along = first.along + second.along
    along /= np.linalg.norm(along)
    ways = np.linalg.svd(along[None])[2][1:]
    one, other = np.matmul(first.axis_m, ways.T), np.matmul(second.axis_m, ways.T)
    left, right = _within_reach(one[:, 0], other[:, 0], most_m)
    high = (second.axis_m @ along)[right] - (first.axis_m @ along)[left]
    far = (other[right, 0] - one[left, 0]) ** 2 + (other[right, 1] - one[left, 1]) ** 2
    near = (np.abs(high) <= _MOST_ALONG_M) & (far < most_m**2)
    left, right, high, far = left[near], right[near], high[near], far[near]
    kept = _is_least(left, far) & _is_least(right, far)
    left, right, high = left[kept], right[kept], high[kept]
    # A radius that differs says that they are two stems.
    ratio = first.radius_m[left] / second.radius_m[right]
    kept = (ratio > 0.5) & (ratio < 2.0)
    left, right, high = left[kept], right[kept], high[kept]
    middle_m = (first.axis_m[left] + second.axis_m[right]) / 2
    # Each along its own direction to the height of the middle.
    half = high[:, None] / 2
    gap = second.axis_m[right] - first.axis_m[left] - half * (first.along + second.along)
    sigma_m = np.sqrt(first.sigma_m[left] ** 2 + second.sigma_m[right] ** 2)
    time_s = np.stack([first.time_s[left], second.time_s[right]], axis=1)
    tilt = (first.along - second.along) / 2
    number = len(left)
    return Distances(
        np.concatenate([left, left]),
        np.repeat(ways, number, axis=0),
        np.concatenate([middle_m, middle_m]),
        np.concatenate([gap @ ways[0], gap @ ways[1]]),
        np.concatenate([sigma_m, sigma_m]),
        np.concatenate([time_s, time_s]),
        np.repeat([-(tilt @ way) * along for way in ways], number, axis=0),
    )


def _within_reach(one: F64Array, other: F64Array, most: float) -> tuple[I64Array, I64Array]:
    """Rows of both, in pairs, whose values (n,) and (m,) differ by most at most."""
    order = np.argsort(other)
    begin = np.searchsorted(other[order], one - most, side="left")
    count = np.searchsorted(other[order], one + most, side="right") - begin
    left = np.repeat(np.arange(len(one)), count)
    within = np.arange(len(left)) - np.repeat(np.cumsum(count) - count, count)
    return left, order[begin[left] + within]


def _is_least(group: I64Array, value: F64Array) -> BoolArray:
    """Mask (n,) of the least value of each group."""
    order = np.lexsort((value, group))
    found = np.zeros(len(group), np.bool_)
    found[order] = np.diff(group[order], prepend=-1) != 0
    return found


# Turns that are tried, shifts that are counted, and cells of shifts that are one vote.
_TURNS_RAD = np.deg2rad(np.arange(-30.0, 30.1, 1.5))
_MOST_M = 2.0
_VOTE_M = 0.25
_CELLS = round(2 * _MOST_M / _VOTE_M)
# Stems are compared in a layer about their median height, of this half height, m.
_LEVEL_M = 0.6
# What is better than none: as many votes by factor, and more.
_FACTOR, _MORE = 1.5, 10.0


def best_move(places: Iterable[tuple[list[Stems], list[Stems]]]) -> Pose:
    """The motion of stems onto the others with the most votes in all places; ORIGIN if they fit."""
    votes = np.zeros((len(_TURNS_RAD), _CELLS - 1, _CELLS - 1))
    for moved, others in places:
        from_m, to_m = _layer(moved, others)
        for number, turn_rad in enumerate(_TURNS_RAD):
            cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
            turned_m = np.matmul(from_m, np.array([[cosine, sine], [-sine, cosine]]))
            apart_m = to_m[None, :, :] - turned_m[:, None, :]
            cell = np.floor((apart_m.reshape(-1, 2) + _MOST_M) / _VOTE_M).astype(np.int64)
            cell = cell[((cell >= 0) & (cell < _CELLS)).all(axis=1)]
            count = np.bincount(cell[:, 0] * _CELLS + cell[:, 1], minlength=_CELLS * _CELLS)
            grid = count.reshape(_CELLS, _CELLS)
            # Cells overlap by half, so that no shift lies between two.
            votes[number] += grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1] + grid[:-1, :-1]
    middle = _CELLS // 2 - 1
    most = votes.max()
    about = slice(middle - 1, middle + 2)
    here = votes[np.abs(_TURNS_RAD) < np.deg2rad(2.0), about, about].max()
    if most < _FACTOR * here + _MORE:
        return ORIGIN
    best = np.unravel_index(np.argmax(votes), votes.shape)
    shift_m = (np.array(best[1:]) + 1) * _VOTE_M - _MOST_M
    rotation = exp_rotation(np.array([[0.0, 0.0, _TURNS_RAD[best[0]]]]))[0]
    return Pose(rotation, np.array([*shift_m, 0.0]))


def _layer(moved: list[Stems], others: list[Stems]) -> tuple[F64Array, F64Array]:
    """Level places (n, 2) and (m, 2) of both in one layer."""
    first = np.concatenate([stems.axis_m for stems in moved]) if moved else np.zeros((0, 3))
    second = np.concatenate([stems.axis_m for stems in others]) if others else np.zeros((0, 3))
    middle_m = float(np.median(first[:, 2])) if len(first) else 0.0
    first = first[np.abs(first[:, 2] - middle_m) < _LEVEL_M]
    second = second[np.abs(second[:, 2] - middle_m) < _LEVEL_M]
    return first[:, :2], second[:, :2]
