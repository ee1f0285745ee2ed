"""The motion of the body: smooth poses, their rates, and what an IMU feels; world frame, metres.

Positions and yaw are natural cubic splines through waypoints, or cubic curves that do not
overshoot; sway adds sinusoids to single coordinates, the ground its height and its tilt. A
standstill precedes them, and the speed then grows smoothly. Rotations are
Rz(yaw) Ry(pitch) Rx(roll), as in URDF.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.terrain import Terrain
from mlbatch.units import STANDARD_GRAVITY

COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
# From standstill to full speed.
RAMP_S = 1.0
# Step of differences that give the angular acceleration.
_STEP_S = 1e-4
# Between knots of height and tilt of the ground.
_GROUND_STEP_S = 0.2


@dataclass(frozen=True, slots=True)
class Sway:
    """A sinusoid of one coordinate; amplitude: m or rad."""

    coordinate: int
    amplitude: float
    frequency_hz: float
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses at n times: rotation (n, 3, 3) world_from_body, position (n, 3), and rates.

    velocity, acceleration: (n, 3) of the position, world frame; angular_velocity: (n, 3), body
    frame, rad/s.
    """

    rotation: F64Array
    position_m: F64Array
    velocity: F64Array
    acceleration: F64Array
    angular_velocity: F64Array


class Curve:
    """A cubic curve through values (k, m) at increasing knots (k,); constant outside of them."""

    def __init__(self, knots: F64Array, values: F64Array) -> None:
        """One knot: a constant."""
        self.knots = knots
        self.values = values

    def __call__(self, at: F64Array) -> tuple[F64Array, F64Array, F64Array]:
        """Return values and two derivatives, (n, m) each."""
        if len(self.knots) == 1:
            value = np.repeat(self.values, len(at), axis=0)
            return value, np.zeros_like(value), np.zeros_like(value)
        inside = np.clip(at, self.knots[0], self.knots[-1])
        i = np.clip(np.searchsorted(self.knots, inside, "right") - 1, 0, len(self.knots) - 2)
        step = (self.knots[i + 1] - self.knots[i])[:, None]
        value, first, second = self._piece(i, (inside - self.knots[i])[:, None] / step, step)
        moving = (at == inside)[:, None]
        return value, np.where(moving, first, 0.0), np.where(moving, second, 0.0)

    def _piece(
        self, i: I64Array, share: F64Array, step: F64Array
    ) -> tuple[F64Array, F64Array, F64Array]:
        """Return values and two derivatives at shares (n, 1) of the steps (n, 1) after knots i."""
        raise NotImplementedError


class Spline(Curve):
    """A natural cubic spline."""

    def __init__(self, knots: F64Array, values: F64Array) -> None:
        """Compute the second derivatives."""
        super().__init__(knots, values)
        count = len(knots)
        self.second = np.zeros_like(values)
        if count > 2:
            step = np.diff(knots)
            slope = np.diff(values, axis=0) / step[:, None]
            matrix = np.diag(2.0 * (step[:-1] + step[1:]))
            matrix += np.diag(step[1:-1], 1) + np.diag(step[1:-1], -1)
            self.second[1:-1] = np.linalg.solve(matrix, 6.0 * np.diff(slope, axis=0))

    def _piece(
        self, i: I64Array, share: F64Array, step: F64Array
    ) -> tuple[F64Array, F64Array, F64Array]:
        b = share
        a = 1.0 - b
        low, high = self.values[i], self.values[i + 1]
        low2, high2 = self.second[i], self.second[i + 1]
        bend = ((a**3 - a) * low2 + (b**3 - b) * high2) * step**2 / 6.0
        value = a * low + b * high + bend
        first = (high - low) / step
        first += ((3 * b**2 - 1) * high2 - (3 * a**2 - 1) * low2) * step / 6.0
        return value, first, a * low2 + b * high2


class MonotoneCurve(Curve):
    """A cubic curve that does not overshoot.

    Between equal values it is constant, so that a body that stops stands still. Slopes by Fritsch
    and Carlson (1980); the second derivative jumps at knots.
    """

    def __init__(self, knots: F64Array, values: F64Array) -> None:
        """Compute the slopes; at both ends they are 0."""
        super().__init__(knots, values)
        self.slopes = np.zeros_like(values)
        if len(knots) > 2:
            step = np.diff(knots)[:, None]
            change = np.diff(values, axis=0) / step
            before, after = change[:-1], change[1:]
            near = 2.0 * step[1:] + step[:-1]
            far = step[1:] + 2.0 * step[:-1]
            same = before * after > 0.0
            # A weighted harmonic mean, 0 at an extremum.
            with np.errstate(over="ignore"):
                weights = near / np.where(same, before, 1.0) + far / np.where(same, after, 1.0)
            self.slopes[1:-1] = np.where(same, (near + far) / weights, 0.0)

    def _piece(
        self, i: I64Array, share: F64Array, step: F64Array
    ) -> tuple[F64Array, F64Array, F64Array]:
        u = share
        low, rise = self.values[i], self.values[i + 1] - self.values[i]
        begin, end = self.slopes[i] * step, self.slopes[i + 1] * step
        # low + begin u + square u^2 + cube u^3.
        square = 3.0 * rise - 2.0 * begin - end
        cube = begin + end - 2.0 * rise
        value = low + u * (begin + u * (square + u * cube))
        first = (begin + u * (2.0 * square + 3.0 * u * cube)) / step
        return value, first, (2.0 * square + 6.0 * u * cube) / step**2


class Trajectory:
    """Poses of the body at any time since the start, s."""

    def __init__(
        self,
        path: Curve,
        sway: Sequence[Sway] = (),
        standstill_s: float = 0.0,
        ground: Curve | None = None,
    ) -> None:
        """path: (x, y, z, yaw) against the time since the standstill.

        ground: (z, roll, pitch) of the ground below the body, which are added.
        """
        self._path = path
        self._ground = ground
        self._sway = tuple(sway)
        self._standstill_s = standstill_s

    @property
    def end_s(self) -> float:
        """Time of the last waypoint; after it the body stands."""
        ramp_s = 0.5 * RAMP_S if self._standstill_s > 0.0 else 0.0
        return self._standstill_s + ramp_s + float(self._path.knots[-1])

    def poses(self, time_s: F64Array) -> Poses:
        """Return the poses at times (n,)."""
        value, first, second = self._coordinates(time_s)
        return Poses(
            _rotations(value[:, 3:]),
            value[:, :3],
            first[:, :3],
            second[:, :3],
            _body_rates(value[:, 3:], first[:, 3:]),
        )

    def inertial(self, time_s: F64Array, body_from_imu: F64Array) -> tuple[F64Array, F64Array]:
        """Return specific force and angular velocity (n, 3), frame of an IMU, m/s2 and rad/s."""
        poses = self.poses(time_s)
        later = self.poses(time_s + _STEP_S).angular_velocity
        earlier = self.poses(time_s - _STEP_S).angular_velocity
        rate = poses.angular_velocity
        change = (later - earlier) / (2.0 * _STEP_S)
        arm = body_from_imu[:3, 3]
        felt = poses.acceleration + np.array([0.0, 0.0, STANDARD_GRAVITY])
        force = np.einsum("nji,nj->ni", poses.rotation, felt)
        force += np.cross(change, arm) + np.cross(rate, np.cross(rate, arm))
        return force @ body_from_imu[:3, :3], rate @ body_from_imu[:3, :3]

    def _coordinates(self, time_s: F64Array) -> tuple[F64Array, F64Array, F64Array]:
        """Return x, y, z, roll, pitch, yaw (n, 6) and two derivatives by time."""
        own, speed, gain = _ramp(time_s, self._standstill_s)
        parts = [np.zeros((len(time_s), 6)) for _ in range(3)]
        for part, path in zip(parts, self._path(own), strict=True):
            part[:, :3] = path[:, :3]
            part[:, 5] = path[:, 3]
        if self._ground is not None:
            for part, ground in zip(parts, self._ground(own), strict=True):
                part[:, 2:5] += ground
        for sway in self._sway:
            pulse = 2.0 * math.pi * sway.frequency_hz
            phase = pulse * own + sway.phase_rad
            start = math.sin(sway.phase_rad)
            parts[0][:, sway.coordinate] += sway.amplitude * (np.sin(phase) - start)
            parts[1][:, sway.coordinate] += sway.amplitude * pulse * np.cos(phase)
            parts[2][:, sway.coordinate] -= sway.amplitude * pulse**2 * np.sin(phase)
        value, first, second = parts
        return (
            value,
            first * speed[:, None],
            second * speed[:, None] ** 2 + first * gain[:, None],
        )


def _ramp(time_s: F64Array, standstill_s: float) -> tuple[F64Array, F64Array, F64Array]:
    """Return the time along the path, its rate and the change of that; rate 3 u^2 - 2 u^3."""
    if standstill_s <= 0.0:
        return time_s, np.ones_like(time_s), np.zeros_like(time_s)
    u = np.clip((time_s - standstill_s) / RAMP_S, 0.0, 1.0)
    own = RAMP_S * (u**3 - 0.5 * u**4) + np.maximum(time_s - standstill_s - RAMP_S, 0.0)
    return own, 3.0 * u**2 - 2.0 * u**3, 6.0 * (u - u**2) / RAMP_S


def _rotations(rpy_rad: F64Array) -> F64Array:
    """Return rotations (n, 3, 3) of roll, pitch, yaw (n, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy_rad).T, np.sin(rpy_rad).T
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def _body_rates(rpy_rad: F64Array, change: F64Array) -> F64Array:
    """Return angular velocities (n, 3), body frame, of the changes of roll, pitch, yaw (n, 3)."""
    (cr, cp, _), (sr, sp, _) = np.cos(rpy_rad).T, np.sin(rpy_rad).T
    roll, pitch, yaw = change.T
    rates = (roll - yaw * sp, pitch * cr + yaw * cp * sr, -pitch * sr + yaw * cp * cr)
    return np.stack(rates, axis=-1)


def path_from_waypoints(
    time_s: F64Array, xyz_m: F64Array, yaw_rad: F64Array | None, kind: type[Curve] = Spline
) -> Curve:
    """Return the curve (x, y, z, yaw) through waypoints; without yaw, the body looks ahead."""
    if yaw_rad is None:
        _, ahead, _ = Spline(time_s, xyz_m)(time_s)
        moves = np.hypot(ahead[:, 0], ahead[:, 1]) > 1e-9
        yaw_rad = np.where(moves, np.arctan2(ahead[:, 1], ahead[:, 0]), 0.0)
    return kind(time_s, np.column_stack([xyz_m, np.unwrap(yaw_rad)]))


def ground_along(path: Curve, terrain: Terrain, footprint_m: float) -> Curve:
    """Return (z, roll, pitch) of a body that rests on a disc of the terrain, along its path.

    The plane of the disc is fitted to its centre and 8 places on its edge, so that bumps that are
    small against the machine tilt it little.
    """
    time_s = np.arange(0.0, path.knots[-1] + _GROUND_STEP_S, _GROUND_STEP_S)
    value, _, _ = path(time_s)
    angle = np.arange(9) * (math.pi / 4.0)
    around = 0.5 * footprint_m * np.column_stack([np.cos(angle), np.sin(angle)])
    around[8] = 0.0
    places = value[:, None, :2] + around
    height = terrain.height(places.reshape(-1, 2)).reshape(-1, 9)
    # Least squares: the places are symmetric about the centre.
    slope = height @ around / (around**2).sum(axis=0)
    cosine, sine = np.cos(value[:, 3]), np.sin(value[:, 3])
    ahead = slope[:, 0] * cosine + slope[:, 1] * sine
    left = slope[:, 1] * cosine - slope[:, 0] * sine
    roll = np.arcsin(left / np.sqrt(1.0 + ahead**2 + left**2))
    table = np.column_stack([height.mean(axis=1), roll, -np.arctan(ahead)])
    return MonotoneCurve(time_s, table)
