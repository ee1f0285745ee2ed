"""Votes of stems for a turn and a shift, against motions that are known."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.registration import ORIGIN
from mlbatch.poses.stems import Stems, best_move
from tests.poses.clouds import motion

COUNT = 60


def stems_at(axis_m: F64Array) -> Stems:
    """Stems at places (k, 3)."""
    ones = np.ones(len(axis_m))
    return Stems(axis_m, np.array([0.0, 0.0, 1.0]), 0.2 * ones, 0.01 * ones, 0.0 * ones)


def seen(rng: np.random.Generator, axis_m: F64Array) -> F64Array:
    """Two thirds of the places, with noise."""
    rows = rng.permutation(COUNT)[: COUNT * 2 // 3]
    return axis_m[rows] + 0.02 * rng.standard_normal((len(rows), 3))


@pytest.mark.parametrize("turn_deg", [-21.0, 4.5, 16.0])
def test_the_motion_that_lets_stems_meet_has_the_most_votes(turn_deg: float) -> None:
    rng = np.random.default_rng(0)
    wrong = motion((0.8, -0.9, 0.1), (0.0, 0.0, turn_deg))
    places = []
    for _ in range(2):
        axis_m = np.column_stack([rng.uniform(-18, 18, (COUNT, 2)), rng.uniform(1, 2, COUNT)])
        moved = seen(rng, axis_m) @ wrong.rotation.T + wrong.position_m
        places.append(([stems_at(moved)], [stems_at(seen(rng, axis_m))]))
    found = best_move(places)
    left = found.rotation @ wrong.rotation
    assert abs(np.degrees(np.arctan2(left[1, 0], left[0, 0]))) < 1.5
    shift_m = found.rotation @ wrong.position_m + found.position_m
    assert np.abs(shift_m[:2]).max() < 0.3


@pytest.mark.parametrize("related", [True, False])
def test_without_a_better_motion_nothing_moves(related: bool) -> None:
    rng = np.random.default_rng(1)
    axis_m = np.column_stack([rng.uniform(-18, 18, (COUNT, 2)), rng.uniform(1, 2, COUNT)])
    other_m = axis_m if related else axis_m[:, [1, 0, 2]] * [1, -1, 1]
    sides = [stems_at(seen(rng, axis_m))], [stems_at(seen(rng, other_m))]
    assert best_move([sides]) is ORIGIN
    assert best_move([([], [])]) is ORIGIN
