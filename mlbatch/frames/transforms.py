"""Rigid transforms as (4, 4) float64 matrices, metres: `body_from_sensor @ xyz_sensor`.

Angles as in URDF: roll, pitch, yaw about the fixed axes x, y, z, so R = Rz Ry Rx. Quaternions are
x, y, z, w as in geometry_msgs. Sums are written out instead of dot products, so that results depend
neither on the CPU nor on library versions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError
from mlbatch.units import RAD_PER_DEG

# Deviation from a rotation that is accepted and corrected.
TOLERANCE = 1e-3
# Above rounding errors of computed matrices, below rounding errors of numbers with few digits.
_ROUNDING = 1e-12
# Products of larger numbers overflow.
_LARGEST = 1e100


def from_rpy_deg(translation_m: Sequence[float], rpy_deg: Sequence[float]) -> F64Array:
    """Return the transform of a translation and roll, pitch, yaw about the fixed axes x, y, z."""
    (cx, sx), (cy, sy), (cz, sz) = (_cos_sin_deg(angle) for angle in rpy_deg)
    rotation = (
        (cy * cz, sx * sy * cz - cx * sz, cx * sy * cz + sx * sz),
        (cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - sx * cz),
        (-sy, sx * cy, cx * cy),
    )
    return _joined(rotation, translation_m)


def from_quaternion(translation_m: Sequence[float], xyzw: Sequence[float]) -> F64Array:
    """Return the transform of a translation and a unit quaternion x, y, z, w; else RigError."""
    norm = math.sqrt(sum(part * part for part in xyzw))
    if not abs(norm - 1.0) <= TOLERANCE:
        raise RigError(
            f"expected a quaternion of norm 1 within {TOLERANCE}, found norm {norm:.6g}; "
            "give x, y, z, w in this order, normalised"
        )
    x, y, z, w = (part / norm for part in xyzw)
    rotation = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return _joined(rotation, translation_m)


def rigid(matrix: F64Array) -> F64Array:
    """Return the transform of a (4, 4) or (3, 4) matrix; RigError if it is not rigid.

    A rotation with few digits is replaced by the nearest exact one, so that distances are kept.
    """
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise RigError(
            f"expected 4 (or 3) rows of 4 finite numbers, found shape {matrix.shape}; "
            "give the rotation with the translation as last column"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > _ROUNDING:
        shown = ", ".join(f"{value:.6g}" for value in matrix[3])
        raise RigError(
            f"expected 0, 0, 0, 1 as last row, found {shown}; "
            "give the translation as last column, metres"
        )
    rotation = np.clip(matrix[:3, :3], -_LARGEST, _LARGEST).astype(np.float64)
    skew = np.abs(_gram(rotation) - np.eye(3)).max()
    if not skew <= TOLERANCE:
        raise RigError(
            f"expected orthonormal axes within {TOLERANCE}, found axes off by {skew:.3g}; "
            "give a rotation without scale or shear"
        )
    if _determinant(rotation) < 0:
        raise RigError(
            "expected a rotation (determinant 1), found a mirror image (determinant -1); "
            "check the signs of the axes"
        )
    return _joined(_nearest_rotation(rotation), matrix[:3, 3])


def quaternion(matrix: F64Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation (3, 3) or a transform (4, 4).

    K = 4 q q^T is linear in the rotation; its row with the largest diagonal is q up to a factor
    and far from 0 (S. W. Shepperd, "Quaternion from rotation matrix", 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = matrix[:3, :3].tolist()
    product = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    row = product[int(np.argmax(np.diagonal(product)))]
    x, y, z, w = (row / np.sqrt((row * row).sum())).tolist()
    # Adding 0.0 changes -0.0 to 0.0, so that equal poses give equal bytes.
    sign = -1.0 if w < 0 else 1.0
    return sign * x + 0.0, sign * y + 0.0, sign * z + 0.0, sign * w + 0.0


def rpy_deg(matrix: F64Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in degrees; at a pitch of +-90 degrees one of the solutions."""
    m = matrix.tolist()
    yaw = math.atan2(m[1][0], m[0][0])
    cosine = math.cos(yaw)
    sine = math.sin(yaw)
    # Without the yaw, Ry Rx is left, whose angles are well defined for any pitch.
    pitch = math.atan2(-m[2][0], cosine * m[0][0] + sine * m[1][0])
    roll = math.atan2(sine * m[0][2] - cosine * m[1][2], cosine * m[1][1] - sine * m[0][1])
    return roll / RAD_PER_DEG, pitch / RAD_PER_DEG, yaw / RAD_PER_DEG


def compose(a_from_b: F64Array, b_from_c: F64Array) -> F64Array:
    """Return the transform a_from_c."""
    columns = [
        a_from_b[:, 0] * x + a_from_b[:, 1] * y + a_from_b[:, 2] * z + a_from_b[:, 3] * w
        for x, y, z, w in b_from_c.T
    ]
    return np.stack(columns, axis=1)


def inverse(a_from_b: F64Array) -> F64Array:
    """Return the transform b_from_a of a rigid transform."""
    x, y, z = a_from_b[:3, 3]
    axes = a_from_b[:3, :3]
    return _joined(axes.T, -(axes[0] * x + axes[1] * y + axes[2] * z))


def _joined(
    rotation: F64Array | Sequence[Sequence[float]], origin: F64Array | Sequence[float]
) -> F64Array:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = origin
    return matrix


def _cos_sin_deg(angle_deg: float) -> tuple[float, float]:
    """Return cosine and sine, exact at multiples of 90 degrees."""
    within_deg = math.remainder(angle_deg, 360.0)
    quarter = round(within_deg / 90.0)
    rest = (within_deg - 90.0 * quarter) * RAD_PER_DEG
    cosine = math.cos(rest)
    sine = math.sin(rest)
    # Subtracting from 0.0 makes no -0.0.
    return (
        (cosine, sine),
        (0.0 - sine, cosine),
        (0.0 - cosine, 0.0 - sine),
        (sine, 0.0 - cosine),
    )[quarter % 4]


def _gram(rotation: F64Array) -> F64Array:
    """Return the products of all pairs of axes, the identity for a rotation."""
    x, y, z = rotation
    products: F64Array = x[:, None] * x + y[:, None] * y + z[:, None] * z
    return products


def _determinant(rotation: F64Array) -> float:
    (a, b, c), (d, e, f), (g, h, i) = rotation
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def _nearest_rotation(rotation: F64Array) -> F64Array:
    """Return the polar factor by Newton-Schulz steps R (3 - R'R) / 2; convergence is quadratic."""
    for _ in range(4):
        step = (3.0 * np.eye(3) - _gram(rotation)) / 2.0
        if np.abs(step - np.eye(3)).max() <= _ROUNDING:
            break
        rotation = (
            rotation[:, :1] * step[0] + rotation[:, 1:2] * step[1] + rotation[:, 2:] * step[2]
        )
    return rotation
