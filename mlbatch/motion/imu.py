"""Poses from an IMU: angular velocity and specific force, integrated from a standstill.

At the standstill the mean of the gyroscope is its bias, and the mean of the accelerometer is
gravity, whose direction gives roll and pitch. The error of the velocity grows with time and with
errors of the accelerometer; within a window only its product with 0.1 s matters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.errors import RecordingError
from mlbatch.motion.se3 import exp_rotation
from mlbatch.motion.track import MAX_GAP_NS, PoseTrack
from mlbatch.units import NS_PER_S, STANDARD_GRAVITY

STANDSTILL_NS = NS_PER_S
_LEAST_SAMPLES = 20
# Largest standard deviation at a standstill: engines run, hands shake.
_MOST_RATE = 0.05
_MOST_FORCE = 0.5
_GRAVITY_TOLERANCE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Standstill:
    """What the IMU measured at rest: gyro_bias (3,), rad/s; gravity (3,), m/s2, IMU frame."""

    gyro_bias: F64Array
    gravity: F64Array


def standstill(stamp_ns: I64Array, force: F64Array, rate: F64Array, name: str) -> Standstill:
    """Return biases of the first second; RecordingError if the IMU moved, or felt no gravity.

    stamp_ns: (n,); force, rate: (n, 3), m/s2 and rad/s; name: of the IMU, for errors.
    """
    rows = stamp_ns - stamp_ns[0] <= STANDSTILL_NS if len(stamp_ns) else np.zeros(0, np.bool_)
    if int(rows.sum()) < _LEAST_SAMPLES or stamp_ns[-1] - stamp_ns[0] < STANDSTILL_NS:
        raise RecordingError(
            f"{name}: expected {_LEAST_SAMPLES} samples in the first second, found "
            f"{int(rows.sum())}; use another source of poses"
        )
    spread_rate = float(rate[rows].std(axis=0).max())
    spread_force = float(force[rows].std(axis=0).max())
    if spread_rate > _MOST_RATE or spread_force > _MOST_FORCE:
        raise RecordingError(
            f"{name}: expected the rig to stand in the first second, found deviations of "
            f"{spread_rate:.3g} rad/s and {spread_force:.3g} m/s2; begin the recording at rest, or "
            "use another source of poses"
        )
    gravity = force[rows].mean(axis=0)
    size = float(np.sqrt((gravity**2).sum()))
    if abs(size / STANDARD_GRAVITY - 1.0) > _GRAVITY_TOLERANCE:
        raise RecordingError(
            f"{name}: expected {STANDARD_GRAVITY:.2f} m/s2 at rest, found {size:.3f}; check the "
            "units of the IMU"
        )
    return Standstill(rate[rows].mean(axis=0), gravity)


def integrated(
    stamp_ns: I64Array,
    force: F64Array,
    rate: F64Array,
    body_from_imu: F64Array,
    name: str = "imu",
) -> PoseTrack:
    """Return the track of the body from samples in the order of their times.

    stamp_ns: (n,), increasing; force, rate: (n, 3), IMU frame; body_from_imu: (4, 4), m. A gap
    longer than MAX_GAP_NS ends what is known of the velocity: the track ends there.
    """
    rest = standstill(stamp_ns, force, rate, name)
    gaps = np.flatnonzero(np.diff(stamp_ns) > MAX_GAP_NS)
    count = int(gaps[0]) + 1 if len(gaps) else len(stamp_ns)
    stamp_ns = stamp_ns[:count]
    step_s: F64Array = np.diff(stamp_ns) / NS_PER_S
    turning = rate[:count] - rest.gyro_bias
    # Mean angular velocity of each step.
    turns = exp_rotation(0.5 * (turning[1:] + turning[:-1]) * step_s[:, None])
    rotation = np.empty((count, 3, 3))
    rotation[0] = _upright(rest.gravity)
    for row in range(count - 1):
        rotation[row + 1] = rotation[row] @ turns[row]
    gravity = np.array([0.0, 0.0, np.sqrt((rest.gravity**2).sum())])
    acceleration = np.einsum("nij,nj->ni", rotation, force[:count]) - gravity
    still = stamp_ns - stamp_ns[0] <= STANDSTILL_NS
    acceleration[still] = 0.0
    velocity = _summed(acceleration, step_s)
    position = _summed(velocity, step_s)
    # The body hangs at the IMU.
    imu_from_body = np.linalg.inv(body_from_imu)
    moved = position + np.einsum("nij,j->ni", rotation, imu_from_body[:3, 3])
    return PoseTrack(stamp_ns, rotation @ imu_from_body[:3, :3], moved, name)


def _summed(rates: F64Array, step_s: F64Array) -> F64Array:
    """Return integrals (n, 3) of rates (n, 3) by the trapezoidal rule, from 0."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * step_s[:, None]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _upright(gravity: F64Array) -> F64Array:
    """Return the rotation (3, 3) with the least angle that turns a vector (3,) upward."""
    up = gravity / np.sqrt((gravity**2).sum())
    axis = np.array([up[1], -up[0], 0.0])
    size = float(np.hypot(axis[0], axis[1]))
    if size == 0.0:
        return np.eye(3) if up[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    angle = float(np.arctan2(size, up[2]))
    turned: F64Array = exp_rotation((axis * (angle / size))[None])[0]
    return turned
