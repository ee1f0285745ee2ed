"""Where the stems of one lidar meet those of the others, among all turns and shifts of a guess.

Stems all look the same: least squares from afar may match each with its neighbour. Each turn about
the upright and each shift has as many votes as stems that meet; the right one has by far the most.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import exp_rotation
from mlbatch.poses.stems import Stems

# Turns that are tried, shifts that are counted, and cells of shifts that are one vote.
_TURNS_RAD = np.deg2rad(np.arange(-30.0, 30.1, 1.5))
_MOST_M = 2.0
_CELL_M = 0.25
_CELLS = round(2 * _MOST_M / _CELL_M)
# Stems are compared in a layer about their median height, of this half height, m.
_LAYER_M = 0.6
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
            cell = np.floor((apart_m.reshape(-1, 2) + _MOST_M) / _CELL_M).astype(np.int64)
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
    shift_m = (np.array(best[1:]) + 1) * _CELL_M - _MOST_M
    rotation = exp_rotation(np.array([[0.0, 0.0, _TURNS_RAD[best[0]]]]))[0]
    return Pose(rotation, np.array([*shift_m, 0.0]))


def _layer(moved: list[Stems], others: list[Stems]) -> tuple[F64Array, F64Array]:
    """Level places (n, 2) and (m, 2) of both in one layer."""
    first = np.concatenate([stems.axis_m for stems in moved]) if moved else np.zeros((0, 3))
    second = np.concatenate([stems.axis_m for stems in others]) if others else np.zeros((0, 3))
    middle_m = float(np.median(first[:, 2])) if len(first) else 0.0
    first = first[np.abs(first[:, 2] - middle_m) < _LAYER_M]
    second = second[np.abs(second[:, 2] - middle_m) < _LAYER_M]
    return first[:, :2], second[:, :2]
