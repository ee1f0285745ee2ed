"""Exponentials and logarithms of n rotations and rigid transforms.

Rotations are (n, 3, 3), rotation vectors (n, 3) in rad, translations (n, 3) in m. A twist is the
pair of a translation part and a rotation vector. Source: J. Sola, J. Deray, D. Atchuthan, "A micro
Lie theory for state estimation in robotics", 2018, appendices B and D.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F64Array

# Below, series replace the quotients; their next terms are beyond float64.
_SMALL_RAD = 1e-4


def skew(vectors: F64Array) -> F64Array:
    """Return matrices (n, 3, 3) that multiply crosswise by vectors (n, 3) from the left."""
    x, y, z = vectors.T
    nothing = np.zeros(len(vectors))
    rows = ((nothing, -z, y), (z, nothing, -x), (-y, x, nothing))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def exp_rotation(vectors: F64Array) -> F64Array:
    """Return the rotations of rotation vectors."""
    angle = np.sqrt((vectors**2).sum(axis=1))
    first, second, _ = coefficients(angle)
    cross = skew(vectors)
    return np.eye(3) + first[:, None, None] * cross + second[:, None, None] * (cross @ cross)


def rotated(rotations: F64Array, vectors: F64Array) -> F64Array:
    """Return vectors (n, 3) or (1, 3), each turned by its rotation (n, 3, 3).

    Sums of three products, as each vector alone would get: `matmul` of numpy 1.26 rounds vectors
    differently by how many there are.
    """
    x, y, z = (rotations[..., axis] * vectors[:, axis, None] for axis in range(3))
    return x + y + z


def log_rotation(rotations: F64Array) -> F64Array:
    """Return rotation vectors, of angles up to pi."""
    quaternions = quaternions_of(rotations)
    vector = quaternions[:, :3]
    size = np.sqrt((vector**2).sum(axis=1))
    angle = 2.0 * np.arctan2(size, quaternions[:, 3])
    # The limit of angle / sin(angle / 2) is 2.
    scale = np.where(size > 0.5 * _SMALL_RAD, angle / np.maximum(size, _SMALL_RAD / 4), 2.0)
    return vector * scale[:, None]


def exp_transform(part_m: F64Array, vectors: F64Array) -> tuple[F64Array, F64Array]:
    """Return rotations and translations of twists (translation part, rotation vector)."""
    moved: F64Array = np.matmul(_left_jacobian(vectors), part_m[..., None])[..., 0]
    return exp_rotation(vectors), moved


def log_transform(rotations: F64Array, translation_m: F64Array) -> tuple[F64Array, F64Array]:
    """Return the twists (translation part, rotation vector) of transforms."""
    vectors = log_rotation(rotations)
    part = np.linalg.solve(_left_jacobian(vectors), translation_m[..., None])[..., 0]
    return np.asarray(part, np.float64), vectors


def quaternions_of(rotations: F64Array) -> F64Array:
    """Return unit quaternions (n, 4) x, y, z, w with w >= 0.

    Of the four rows that are multiples of the quaternion the longest is used (Shepperd, 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = rotations.transpose(1, 2, 0)
    rows = (
        (1 + a - e - i, b + d, c + g, h - f),
        (b + d, 1 - a + e - i, f + h, c - g),
        (c + g, f + h, 1 - a - e + i, d - b),
        (h - f, c - g, d - b, 1 + a + e + i),
    )
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
    longest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    row = outer[np.arange(len(outer)), longest]
    row = row / np.sqrt((row**2).sum(axis=1))[:, None]
    positive: F64Array = np.where(row[:, 3:] < 0.0, -row, row)
    return positive


def rotations_of(quaternions: F64Array) -> F64Array:
    """Return the rotations of unit quaternions (n, 4) x, y, z, w."""
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def _left_jacobian(vectors: F64Array) -> F64Array:
    angle = np.sqrt((vectors**2).sum(axis=1))
    _, second, third = coefficients(angle)
    cross = skew(vectors)
    return np.eye(3) + second[:, None, None] * cross + third[:, None, None] * (cross @ cross)


def coefficients(angle: F64Array) -> tuple[F64Array, F64Array, F64Array]:
    """Return sin(a) / a, (1 - cos(a)) / a^2 and (a - sin(a)) / a^3."""
    square = angle * angle
    is_small = angle < _SMALL_RAD
    safe = np.where(is_small, 1.0, angle)
    first = np.where(is_small, 1.0 - square / 6.0, np.sin(safe) / safe)
    # 1 - cos(a) = 2 sin(a / 2)^2 without cancellation.
    half = np.sin(0.5 * safe) / (0.5 * safe)
    second = np.where(is_small, 0.5 - square / 24.0, 0.5 * half * half)
    third = np.where(is_small, 1.0 / 6.0 - square / 120.0, (safe - np.sin(safe)) / safe**3)
    return first, second, third
