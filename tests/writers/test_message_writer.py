"""Rotations as quaternions."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.writers.message_writer import quaternion

HALF = 0.5**0.5


@pytest.mark.parametrize(
    ("rotation", "wanted"),
    [
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], (0, 0, 0, 1)),
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (HALF, 0, 0, HALF)),
        ([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (0, HALF, 0, HALF)),
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, HALF, HALF)),
        # Half turns, where w is 0.
        ([[1, 0, 0], [0, -1, 0], [0, 0, -1]], (1, 0, 0, 0)),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], (0, 1, 0, 0)),
        ([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], (0, 0, 1, 0)),
        # x to y, y to z, z to x: a third of a turn about (1, 1, 1).
        ([[0, 0, 1], [1, 0, 0], [0, 1, 0]], (0.5, 0.5, 0.5, 0.5)),
    ],
)
def test_known_turns(rotation: list[list[int]], wanted: tuple[float, ...]) -> None:
    assert quaternion(np.array(rotation, float)) == pytest.approx(wanted)


def test_it_turns_vectors_as_the_matrix_does() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.linalg.det(rotation)
        *axis, w = quaternion(rotation)
        vector = rng.normal(size=3)
        # v + 2 w (q x v) + 2 q x (q x v)
        once = np.cross(axis, vector)
        turned = vector + 2 * w * once + 2 * np.cross(axis, once)
        np.testing.assert_allclose(turned, rotation @ vector, atol=1e-12)
        assert w >= 0
