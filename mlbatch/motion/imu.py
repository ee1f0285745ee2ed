"""Poses from an IMU: angular velocity and specific force, integrated from a standstill.

At the standstill the mean of the gyroscope is its bias, and the mean of the accelerometer is
gravity, whose direction gives roll and pitch. The error of the velocity grows with time and with
errors of the accelerometer; within a window only its product with 0.1 s matters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.errors import RecordingError
from mlbatch.frames.transforms import inverse
from mlbatch.motion.gravity import (
    GRAVITY_TOLERANCE,
    LEAST_SAMPLES,
    MOST_BIAS,
    MOST_TILT_DEG,
    STANDSTILL_NS,
    tilt_deg,
)
from mlbatch.motion.se3 import exp_rotation, rotated
from mlbatch.motion.track import MAX_GAP_NS, PoseTrack
from mlbatch.units import NS_PER_MS, NS_PER_S, STANDARD_GRAVITY

# Largest standard deviation at a standstill: engines run, hands shake.
_MOST_RATE = 0.05
_MOST_FORCE = 0.5
# Without samples for longer, velocity and attitude are not known any more.
_MOST_GAP_PERIODS = 3
_LEAST_GAP_NS = 20 * NS_PER_MS


@dataclass(frozen=True, slots=True, eq=False)
class Standstill:
    """Means of the IMU at rest, in the IMU frame; period_ns: between samples.

    gyro_bias: (3,), rad/s; gravity: (3,), m/s2, upward.
    """

    gyro_bias: F64Array
    gravity: F64Array
    period_ns: int


def standstill(stamp_ns: I64Array, force: F64Array, rate: F64Array, name: str) -> Standstill:
    """Return biases of the first second; RecordingError if the IMU moved, or felt no gravity.

    stamp_ns: (n,); force, rate: (n, 3), m/s2 and rad/s; name: of the IMU, for errors.
    """
    rows = stamp_ns - stamp_ns[0] <= STANDSTILL_NS if len(stamp_ns) else np.zeros(0, np.bool_)
    if int(rows.sum()) < LEAST_SAMPLES or stamp_ns[-1] - stamp_ns[0] < STANDSTILL_NS:
        raise RecordingError(
            f"{name}: expected {LEAST_SAMPLES} samples in the first second, found "
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
    bias = rate[rows].mean(axis=0)
    turn = float(np.sqrt((bias**2).sum()))
    if turn > MOST_BIAS:
        raise RecordingError(
            f"{name}: expected the rig to stand in the first second, found a mean of {turn:.3g} "
            "rad/s; begin the recording at rest, or use another source of poses"
        )
    gravity = force[rows].mean(axis=0)
    size = float(np.sqrt((gravity**2).sum()))
    if abs(size / STANDARD_GRAVITY - 1.0) > GRAVITY_TOLERANCE:
        raise RecordingError(
            f"{name}: expected {STANDARD_GRAVITY:.2f} m/s2 at rest, found {size:.3f}; check the "
            "units of the IMU"
        )
    return Standstill(bias, gravity, int(np.median(np.diff(stamp_ns[rows]))))


def check_upright(up: F64Array, name: str) -> None:
    """RecordingError unless a specific force at rest (3,), body frame, points along z."""
    tilted_deg = tilt_deg(up, np.array([0.0, 0.0, 1.0]))
    if tilted_deg > MOST_TILT_DEG:
        found = " ".join(f"{value:.1f}" for value in up)
        raise RecordingError(
            f"{name}: expected +{STANDARD_GRAVITY:.2f} m/s2 within {MOST_TILT_DEG:.0f} degrees of "
            f"the body's z axis at rest, found {found} m/s2, {tilted_deg:.0f} degrees from it; "
            "check the sign of the accelerometer and the extrinsics of the IMU"
        )


@dataclass(slots=True)
class _State:
    """The last integrated sample: pose and velocity of the IMU, and its rates."""

    rotation: F64Array
    velocity: F64Array
    position_m: F64Array
    acceleration: F64Array
    turning: F64Array
    stamp_ns: int


class Integrator:
    """Integrates the samples of one IMU as they come; results do not depend on their grouping."""

    def __init__(self, body_from_imu: F64Array, name: str = "imu") -> None:
        """body_from_imu: (4, 4), m; name: for errors and as the source of the track."""
        self._imu_from_body = inverse(body_from_imu)
        self._name = name
        self._waiting: list[tuple[I64Array, F64Array, F64Array]] = []
        self._rest: Standstill | None = None
        self._begin_ns = 0
        self._state: _State | None = None
        self.gyro_bias: tuple[float, ...] = ()
        # The gap that ended the integration.
        self.gap_ns = 0

    @property
    def is_lost(self) -> bool:
        """Whether a gap ended the integration."""
        return self.gap_ns > 0

    def push(self, stamp_ns: I64Array, force: F64Array, rate: F64Array) -> PoseTrack:
        """Return the poses at samples (n,), none before the first second is complete.

        stamp_ns: increasing; force, rate: (n, 3), m/s2 and rad/s, frame of the IMU.
        """
        if self._rest is None:
            self._waiting.append((stamp_ns, force, rate))
            stamp_ns, force, rate = (
                np.concatenate(part) for part in zip(*self._waiting, strict=True)
            )
            if len(stamp_ns) == 0 or stamp_ns[-1] - stamp_ns[0] <= STANDSTILL_NS:
                return self._track(stamp_ns[:0], np.zeros((0, 3, 3)), np.zeros((0, 3)))
            self._rest = standstill(stamp_ns, force, rate, self._name)
            self.gyro_bias = tuple(self._rest.gyro_bias.tolist())
            check_upright(self._imu_from_body[:3, :3].T @ self._rest.gravity, self._name)
            self._begin_ns = int(stamp_ns[0])
            self._waiting = []
        if self.is_lost or len(stamp_ns) == 0:
            return self._track(stamp_ns[:0], np.zeros((0, 3, 3)), np.zeros((0, 3)))
        return self._integrated(self._rest, stamp_ns, force, rate)

    def _integrated(
        self, rest: Standstill, stamp_ns: I64Array, force: F64Array, rate: F64Array
    ) -> PoseTrack:
        turning = rate - rest.gyro_bias
        state = self._state
        if state is None:
            still = np.zeros(3)
            first = int(stamp_ns[0])
            state = _State(_upright(rest.gravity), still, still, still, turning[0], first)
        stamps = np.concatenate([[state.stamp_ns], stamp_ns])
        steps_ns = np.diff(stamps)
        # Half a period more, so that its jitter does not count.
        most_ns = max(_LEAST_GAP_NS, _MOST_GAP_PERIODS * rest.period_ns) + rest.period_ns // 2
        # Within the standstill nothing is missed.
        moves = stamp_ns - self._begin_ns > STANDSTILL_NS
        gaps = np.flatnonzero(steps_ns > np.where(moves, most_ns, MAX_GAP_NS))
        count = int(gaps[0]) if len(gaps) else len(stamp_ns)
        if len(gaps):
            self.gap_ns = int(steps_ns[count])
        step_s: F64Array = np.diff(stamps[: count + 1]) / NS_PER_S
        rates = np.concatenate([state.turning[None], turning[:count]])
        # Mean angular velocity of each step.
        turns = exp_rotation(0.5 * (rates[1:] + rates[:-1]) * step_s[:, None])
        rotation = np.empty((count + 1, 3, 3))
        rotation[0] = state.rotation
        for row in range(count):
            rotation[row + 1] = rotation[row] @ turns[row]
        gravity = np.array([0.0, 0.0, math.sqrt(float((rest.gravity**2).sum()))])
        acceleration = rotated(rotation[1:], force[:count]) - gravity
        acceleration[stamp_ns[:count] - self._begin_ns <= STANDSTILL_NS] = 0.0
        felt = np.concatenate([state.acceleration[None], acceleration])
        velocity = _summed(state.velocity, felt, step_s)
        position = _summed(state.position_m, velocity, step_s)
        last = int(stamps[count])
        self._state = _State(rotation[-1], velocity[-1], position[-1], felt[-1], rates[-1], last)
        return self._track(stamp_ns[:count], rotation[1:], position[1:])

    def _track(self, stamp_ns: I64Array, rotation: F64Array, position_m: F64Array) -> PoseTrack:
        """Return poses of the body for poses of the IMU."""
        arm = rotated(rotation, self._imu_from_body[None, :3, 3])
        body = np.matmul(rotation, self._imu_from_body[:3, :3])
        return PoseTrack(stamp_ns, body, position_m + arm, self._name)


def _summed(begin: F64Array, rates: F64Array, step_s: F64Array) -> F64Array:
    """Return integrals (n + 1, 3) of rates (n + 1, 3) by the trapezoidal rule, from (3,)."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * step_s[:, None]
    sums: F64Array = np.cumsum(np.concatenate([begin[None], steps]), axis=0)
    return sums


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
