"""Rigid transforms against rotations worked out by hand, and their laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.frames.transforms import (
    compose,
    from_quaternion,
    from_rpy_deg,
    inverse,
    quaternion,
    rigid,
    rpy_deg,
)

ORIGIN = (0.0, 0.0, 0.0)
HALF = math.sqrt(0.5)

ANGLES = st.floats(min_value=-360.0, max_value=360.0)
LENGTHS = st.floats(min_value=-1000.0, max_value=1000.0)
TRANSFORMS = st.builds(from_rpy_deg, st.tuples(*[LENGTHS] * 3), st.tuples(*[ANGLES] * 3))


def _turned(matrix: F64Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Transform a point in plain arithmetic."""
    rows = matrix.tolist()
    a, b, c = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows[:3])
    return a, b, c


@pytest.mark.parametrize(
    ("rpy", "x_goes_to", "y_goes_to", "z_goes_to"),
    [
        # Right-handed rotations by 90 degrees: y to z, z to x, x to y.
        ((90.0, 0.0, 0.0), (1, 0, 0), (0, 0, 1), (0, -1, 0)),
        ((0.0, 90.0, 0.0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),
        ((0.0, 0.0, 90.0), (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ((0.0, 0.0, 180.0), (-1, 0, 0), (0, -1, 0), (0, 0, 1)),
        ((0.0, 0.0, 270.0), (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        # About the fixed axes in the order x, y, z: first roll, y goes to z; then pitch, z to x;
        # then yaw, x to y. Axes that rotate along would give another result.
        ((90.0, 90.0, 0.0), (0, 0, -1), (1, 0, 0), (0, -1, 0)),
        ((90.0, 0.0, 90.0), (0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((0.0, 90.0, 90.0), (0, 0, -1), (-1, 0, 0), (0, 1, 0)),
        ((90.0, 90.0, 90.0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ],
)
def test_rotations_by_90_degrees_are_exact(
    rpy: tuple[float, float, float],
    x_goes_to: tuple[int, int, int],
    y_goes_to: tuple[int, int, int],
    z_goes_to: tuple[int, int, int],
) -> None:
    matrix = from_rpy_deg(ORIGIN, rpy)
    assert _turned(matrix, 1, 0, 0) == x_goes_to
    assert _turned(matrix, 0, 1, 0) == y_goes_to
    assert _turned(matrix, 0, 0, 1) == z_goes_to


@pytest.mark.parametrize(
    ("xyzw", "rpy"),
    [
        ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
        ((HALF, 0.0, 0.0, HALF), (90.0, 0.0, 0.0)),
        ((0.0, HALF, 0.0, HALF), (0.0, 90.0, 0.0)),
        ((0.0, 0.0, HALF, HALF), (0.0, 0.0, 90.0)),
        ((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 180.0)),
        ((1.0, 0.0, 0.0, 0.0), (180.0, 0.0, 0.0)),
        # A rotation by 120 degrees about (1, 1, 1) takes x to y, y to z, z to x.
        ((0.5, 0.5, 0.5, 0.5), (90.0, 0.0, 90.0)),
    ],
)
def test_quaternions_by_hand(
    xyzw: tuple[float, float, float, float], rpy: tuple[float, float, float]
) -> None:
    matrix = from_quaternion((1.0, 2.0, 3.0), xyzw)
    np.testing.assert_allclose(matrix, from_rpy_deg((1.0, 2.0, 3.0), rpy), atol=1e-15)
    np.testing.assert_allclose(quaternion(matrix), xyzw, atol=1e-15)


def test_matrix_of_few_digits_becomes_a_rotation() -> None:
    typed: F64Array = np.array([[0.7071, -0.7071, 0, 1], [0.7071, 0.7071, 0, 2], [0, 0, 1, 3]])
    expected = np.array([[HALF, -HALF, 0, 1], [HALF, HALF, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    np.testing.assert_allclose(rigid(typed), expected, atol=1e-15)


@pytest.mark.parametrize("factor", [0.9996, 1.0004])
def test_scale_within_the_tolerance_is_taken_out(factor: float) -> None:
    matrix = from_rpy_deg(ORIGIN, (10.0, 20.0, 30.0))
    scaled = matrix.copy()
    scaled[:3, :3] *= factor
    np.testing.assert_allclose(rigid(scaled), matrix, atol=1e-14)


def _matrix(*rows: tuple[float, ...]) -> F64Array:
    return np.array(rows, dtype=np.float64)


X = (1, 0, 0, 0)
Y = (0, 1, 0, 0)
Z = (0, 0, 1, 0)
W = (0, 0, 0, 1)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (_matrix(X, Y), "expected 4 (or 3) rows of 4 finite numbers, found shape (2, 4)"),
        (_matrix(X, Y, (0, 0, math.nan, 0), W), "expected 4 (or 3) rows of 4 finite numbers, "),
        (_matrix(X, Y, Z, (1, 2, 3, 1)), "expected 0, 0, 0, 1 as last row, found 1, 2, 3, 1"),
        # Scaled by 1.1: its axes have a squared length of 1.21.
        (
            _matrix((1.1, 0, 0, 0), (0, 1.1, 0, 0), (0, 0, 1.1, 0), W),
            "expected orthonormal axes within 0.001, found axes off by 0.21",
        ),
        # Two axes that meet at the cosine 0.01.
        (
            _matrix((1, 0.01, 0, 0), Y, Z, W),
            "expected orthonormal axes within 0.001, found axes off by 0.01",
        ),
        (_matrix(Y, X, Z, W), "expected a rotation (determinant 1), found a mirror image"),
        (_matrix((-1, 0, 0, 0), Y, Z), "expected a rotation (determinant 1), found a mirror image"),
    ],
)
def test_matrices_that_are_not_rigid_are_refused(matrix: F64Array, message: str) -> None:
    with pytest.raises(RigError) as caught:
        rigid(matrix)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "xyzw", [(0, 0, 0, 0), (0, 0, 0, 1.002), (1, 1, 0, 0), (0, 0, 0, math.nan)]
)
def test_quaternion_that_is_not_unit_is_refused(xyzw: tuple[float, ...]) -> None:
    with pytest.raises(
        RigError, match=r"^expected a quaternion of norm 1 within 0.001, found norm "
    ):
        from_quaternion(ORIGIN, xyzw)


@given(TRANSFORMS)
@example(from_rpy_deg(ORIGIN, (0.0, 90.0, 0.0)))
@example(from_rpy_deg(ORIGIN, (0.0, -90.0, 30.0)))
@example(from_rpy_deg(ORIGIN, (20.0, 90.0 - 1e-10, 30.0)))
@example(from_rpy_deg(ORIGIN, (180.0, 0.0, 180.0)))
def test_quaternion_and_angles_give_the_matrix_again(matrix: F64Array) -> None:
    translation = matrix[:3, 3].tolist()
    xyzw = np.array(quaternion(matrix))
    assert xyzw[3] >= 0
    assert float((xyzw**2).sum()) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(from_quaternion(translation, xyzw.tolist()), matrix, atol=1e-14)
    np.testing.assert_allclose(from_rpy_deg(translation, rpy_deg(matrix)), matrix, atol=1e-14)


@given(TRANSFORMS)
def test_rotations_stay_as_they_are(matrix: F64Array) -> None:
    assert rigid(matrix).tobytes() == matrix.tobytes()
    assert rigid(matrix[:3]).tobytes() == matrix.tobytes()


@given(TRANSFORMS, TRANSFORMS, st.tuples(LENGTHS, LENGTHS, LENGTHS))
def test_composition_applies_both_transforms(
    outer: F64Array, inner: F64Array, point: tuple[float, float, float]
) -> None:
    expected = _turned(outer, *_turned(inner, *point))
    assert _turned(compose(outer, inner), *point) == pytest.approx(expected, abs=1e-9)


@given(TRANSFORMS)
def test_inverse_undoes(matrix: F64Array) -> None:
    np.testing.assert_allclose(compose(inverse(matrix), matrix), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(compose(matrix, inverse(matrix)), np.eye(4), atol=1e-9)
