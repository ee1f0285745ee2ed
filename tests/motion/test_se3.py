"""Exponentials and logarithms against power series and hand-worked rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import (
    exp_rotation,
    exp_transform,
    log_rotation,
    log_transform,
    quaternions_of,
    rotations_of,
    skew,
)

VECTORS = st.tuples(*[st.floats(-1.7, 1.7)] * 3)
SIZES = st.sampled_from([1e-12, 1e-6, 1e-4, 0.99e-4, 1e-2, 1.0])


def matrix_exponential(matrix: F64Array) -> F64Array:
    """The power series."""
    total = np.eye(len(matrix))
    term = np.eye(len(matrix))
    for number in range(1, 40):
        term = term @ matrix / number
        total = total + term
    return total


def four_by_four(part: F64Array, vector: F64Array) -> F64Array:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = skew(vector[None])[0]
    matrix[:3, 3] = part
    return matrix


@given(VECTORS, VECTORS, SIZES)
def test_the_exponential_is_the_power_series(
    part: tuple[float, ...], vector: tuple[float, ...], size: float
) -> None:
    rho, phi = np.array(part), size * np.array(vector)
    expected = matrix_exponential(four_by_four(rho, phi))
    rotation, translation = exp_transform(rho[None], phi[None])
    np.testing.assert_allclose(rotation[0], expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(translation[0], expected[:3, 3], atol=1e-12)


@given(VECTORS, VECTORS, SIZES)
def test_the_logarithm_inverts_it(
    part: tuple[float, ...], vector: tuple[float, ...], size: float
) -> None:
    rho, phi = np.array([part]), size * np.array([vector])
    found = log_transform(*exp_transform(rho, phi))
    np.testing.assert_allclose(found[1], phi, atol=1e-9)
    np.testing.assert_allclose(found[0], rho, atol=1e-9)


@pytest.mark.parametrize("axis", range(3))
def test_quarter_and_half_turns(axis: int) -> None:
    vector = np.zeros((2, 3))
    vector[:, axis] = math.pi / 2, math.pi
    quarter, half = exp_rotation(vector)
    one, other = (axis + 1) % 3, (axis + 2) % 3
    # Crosswise: the next axis turns to the one after it.
    assert quarter[other, one] == pytest.approx(1.0)
    assert quarter[one, other] == pytest.approx(-1.0)
    assert np.diagonal(half)[axis] == pytest.approx(1.0)
    np.testing.assert_allclose(np.abs(log_rotation(half[None])), np.abs(vector[1:]), atol=1e-7)


@given(VECTORS)
def test_quaternions_are_those_of_half_the_angle(vector: tuple[float, ...]) -> None:
    phi = np.array([vector])
    angle = float(np.linalg.norm(phi))
    (found,) = quaternions_of(exp_rotation(phi))
    expected = np.append(phi[0] / (angle or 1.0) * math.sin(angle / 2), math.cos(angle / 2))
    np.testing.assert_allclose(found * np.sign(found[3] * expected[3] or 1), expected, atol=1e-9)
    np.testing.assert_allclose(rotations_of(found[None]), exp_rotation(phi), atol=1e-12)
