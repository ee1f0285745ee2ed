"""Rotation and delay between two sensors of one rigid body, from how both turn.

Of a gyroscope: its rotation to a lidar, and how late its clock is. Of two lidars: how late one
clock is against the other. The bias of a gyroscope is solved for, so that only changes of the
angular velocity count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.agreement import Turns
from mlbatch.motion.se3 import exp_rotation, log_rotation, skew
from mlbatch.poses.hand_eye import DOUBT, Noise, known_rows, transformed
from mlbatch.units import NS_PER_MS, NS_PER_S

_LEAST_STEPS = 30
# Parts of a window that the turns of a lidar are interpolated at.
_FINER = 10
# Delays that are tried first.
_FARTHEST_NS = NS_PER_S
_STEP_NS = 20 * NS_PER_MS
# Variance of the turns, by that of what the fit leaves.
_LEAST_SIGNAL = 4.0
_MOST_SIGMAS = 5.0
_ROUNDS = 4
_ITERATIONS = 6
# Standard deviations of what is known.
_MOST_SIGMA_RAD = math.radians(1.0)
_MOST_SIGMA_S = 0.01
# What odometry adds to its noise: of simulated drives the delay was up to 2.3 ms off.
_ADDED = np.array([math.radians(0.03)] * 3 + [0.0] * 3 + [0.002]) ** 2
_PRIOR = np.array([3.0] * 3 + [1.0] * 3 + [1.0]) ** -2

# Slower turns about a second axis, root mean square, do not fix a rotation to 1 degree, rad/s.
_LEAST_RATE = math.radians(0.5)

_INSTEAD = "drive a figure of eight, and over a kerb, so that it turns about two axes"


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """How the second sensor lies and counts time.

    rotation: (3, 3), first_from_other; covariance: (7, 7) of its turn in the frame of the first
    sensor, rad, of the bias, rad/s, and of the delay, s; bias: (3,), of the second sensor, its
    frame, rad/s; delay_s: what its stamps are late by (an event has later stamps than in the clock
    of the first sensor); undetermined: what the motion does not fix of the rotation, in words, or
    ""; late_undetermined: the same of the delay.
    """

    rotation: F64Array
    bias: F64Array
    delay_s: float
    covariance: F64Array
    undetermined: str
    late_undetermined: str

    @property
    def sigma_rad(self) -> F64Array:
        """Standard deviations (3,) of the rotation."""
        found: F64Array = np.sqrt(np.diag(self.covariance)[:3])
        return found

    @property
    def delay_sigma_s(self) -> float:
        """Standard deviation of the delay."""
        return math.sqrt(self.covariance[6, 6])


def turning(seen: F64Array, middle_ns: I64Array, turns: Turns, name: str) -> Turning:
    """Compare turns seen by a lidar with those of another sensor.

    seen: (k, 3), rotation vectors from the middle of the window before to that of each window,
    frame of the lidar, rad, NaN where unknown; middle_ns: (k,); turns: of the other sensor, own
    clock and frame; name: of the other sensor, for words.
    """
    inside = (middle_ns[1:] <= turns.stamp_ns[-1] - _FARTHEST_NS) if len(turns.stamp_ns) else []
    rows = np.flatnonzero(known_rows(seen[1:])) + 1 if len(inside) else np.zeros(0, np.int64)
    rows = rows[
        (middle_ns[rows - 1] >= turns.stamp_ns[0]) & (middle_ns[rows] <= turns.stamp_ns[-1])
    ]
    if len(rows) < _LEAST_STEPS:
        words = (
            f"{name}: expected {_LEAST_STEPS} windows with its samples and the motion of the "
            f"lidar, found {len(rows)}; record longer"
        )
        return Turning(np.eye(3), np.zeros(3), 0.0, np.diag(1.0 / _PRIOR), words, words)
    fit = _Fit(seen[rows], middle_ns[rows - 1], middle_ns[rows], turns)
    state = fit.start()
    for _ in range(_ROUNDS):
        fit.weigh(state)
        for _ in range(_ITERATIONS):
            state = fit.after(state)
    inverse = np.asarray(np.linalg.inv(fit.normal(state)), np.float64)
    covariance = DOUBT * inverse + np.diag(_ADDED)
    return Turning(*state, covariance, *_words(fit, state, covariance, name))


@dataclass(frozen=True, slots=True, eq=False)
class ImuRotation:
    """How an IMU lies, by its turns and those of the first lidar.

    body_from_imu: (3, 3); sigma_deg: (3,), about x, y, z of the body; off_deg: from the rotation
    that metadata or /tf_static give, NaN without; late_ms, late_sigma_ms: of its stamps, NaN where
    it turns too evenly; refusal: why none of it is known (NaN), or "".
    """

    name: str
    body_from_imu: F64Array
    sigma_deg: F64Array
    off_deg: float
    late_ms: float
    late_sigma_ms: float
    refusal: str = ""


def imu_rotation(
    seen: F64Array,
    middle_ns: I64Array,
    turns: Turns,
    name: str,
    body_from_first: F64Array,
    stated: F64Array | None,
) -> ImuRotation:
    """Rotation of an IMU by `turning`; body_from_first, stated (body_from_imu): (3, 3)."""
    found = turning(seen, middle_ns, turns, name)
    if found.undetermined:
        return refused_imu(name, found.undetermined)
    rotation = np.matmul(body_from_first, found.rotation)
    covariance = np.matmul(np.matmul(body_from_first, found.covariance[:3, :3]), body_from_first.T)
    off_deg = late_ms = late_sigma_ms = float("nan")
    if stated is not None:
        turn = log_rotation(np.matmul(rotation, stated.T)[None])[0]
        off_deg = math.degrees(float(np.linalg.norm(turn)))
    if not found.late_undetermined:
        late_ms, late_sigma_ms = 1000.0 * found.delay_s, 1000.0 * found.delay_sigma_s
    sigma_deg = np.degrees(np.sqrt(np.diag(covariance)))
    return ImuRotation(name, rotation, sigma_deg, off_deg, late_ms, late_sigma_ms)


def refused_imu(name: str, reason: str) -> ImuRotation:
    """An IMU that the motion does not fix."""
    unknown = np.full((4, 3), np.nan)
    return ImuRotation(name, unknown[:3], unknown[3], np.nan, np.nan, np.nan, reason)


def turns_too_little(turns: Turns, name: str) -> str:
    """Why turns by a gyroscope fix no rotation, whatever a lidar sees, or ""."""
    stamp_ns = np.arange(turns.stamp_ns[0], turns.stamp_ns[-1], 100 * NS_PER_MS)
    steps = turns.between(stamp_ns[:-1], stamp_ns[1:]) / 0.1
    if len(steps) < _LEAST_STEPS:
        return f"{name}: expected samples of 3 s, found fewer; record longer"
    # Of constant turns a bias is as likely.
    rates = np.linalg.svd(steps - steps.mean(axis=0), compute_uv=False) / math.sqrt(len(steps))
    if rates[1] >= _LEAST_RATE:
        return ""
    first, second = (math.degrees(rate) for rate in rates[:2].tolist())
    return (
        f"{name}: expected turns about two axes by {math.degrees(_LEAST_RATE):.1f} degrees/s, "
        f"found {first:.1f} and {second:.1f} (root mean square); {_INSTEAD}"
    )


def gyroscope_turns(stamp_ns: I64Array, rate: F64Array) -> Turns:
    """Turns by the samples (n, 3) of a gyroscope, rad/s, at increasing times (n,)."""
    step_s = np.diff(stamp_ns) / NS_PER_S
    steps = 0.5 * (rate[1:] + rate[:-1]) * step_s[:, None]
    return Turns(stamp_ns, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]))


def lidar_turns(turned: F64Array, middle_ns: I64Array) -> Turns:
    """Turns by rotation vectors (k, 3) of a lidar between the middles (k,) of windows, rad.

    Between middles by cubics (E. Catmull, R. Rom, 1974); where a rotation is not known, as between
    those around it.
    """
    rows = np.arange(len(turned))
    known = known_rows(turned)
    if known.sum() < _LEAST_STEPS:
        return Turns(middle_ns[:0], np.zeros((0, 3)))
    filled = np.stack([np.interp(rows, rows[known], part[known]) for part in turned.T], axis=1)
    total = np.cumsum(filled, axis=0)
    before, begin, end, after = total[:-3], total[1:-2], total[2:-1], total[3:]
    shares = np.arange(_FINER)[:, None, None] / _FINER
    slope, next_slope = (end - before) / 2.0, (after - begin) / 2.0
    curve = begin + shares * (
        slope
        + shares
        * (
            3.0 * (end - begin)
            - 2.0 * slope
            - next_slope
            + shares * (2.0 * (begin - end) + slope + next_slope)
        )
    )
    gap_ns = (middle_ns[2:-1] - middle_ns[1:-2]) // _FINER
    stamps = middle_ns[1:-2] + np.arange(_FINER)[:, None] * gap_ns
    return Turns(stamps.T.reshape(-1), curve.transpose(1, 0, 2).reshape(-1, 3))


# Rotation first_from_other, bias, delay.
_State = tuple[F64Array, F64Array, float]


class _Fit:
    """Least squares over k spans."""

    def __init__(self, seen: F64Array, begin_ns: I64Array, end_ns: I64Array, turns: Turns) -> None:
        self.seen = seen
        self.begin_ns = begin_ns
        self.end_ns = end_ns
        self.turns = turns
        self.span_s = (end_ns - begin_ns) / NS_PER_S
        self.run = np.cumsum(np.concatenate([[0], (begin_ns[1:] != end_ns[:-1]).astype(np.int64)]))
        self.noise = Noise(np.ones(3), np.zeros(3))

    def other(self, delay_s: float) -> F64Array:
        """Turns of the other sensor over the spans, (k, 3)."""
        late_ns = round(delay_s * NS_PER_S)
        return self.turns.between(self.begin_ns + late_ns, self.end_ns + late_ns)

    def start(self) -> _State:
        """The best of many delays, each with the best rotation (W. Kabsch, 1976)."""
        steps = _FARTHEST_NS // _STEP_NS
        seen = self.seen - self.seen.mean(axis=0)
        tried = []
        for delay_s in np.arange(-steps, steps + 1) * (_STEP_NS / NS_PER_S):
            other = self.other(float(delay_s))
            other = other - other.mean(axis=0)
            left, stretch, right = np.linalg.svd(np.matmul(seen.T, other))
            hand = np.array([1.0, 1.0, np.sign(np.linalg.det(np.matmul(left, right)))])
            gain = float((stretch * hand).sum()) - 0.5 * float((other**2).sum())
            tried.append((gain, abs(float(delay_s)), float(delay_s), np.matmul(left * hand, right)))
        # Of equal ones the least delay.
        _, _, delay_s, rotation = max(tried, key=lambda one: (one[0], -one[1]))
        return rotation, np.zeros(3), delay_s

    def left(self, state: _State) -> F64Array:
        """Differences (k, 3), rad."""
        rotation, bias, delay_s = state
        own = self.other(delay_s) - self.span_s[:, None] * bias
        left: F64Array = self.seen - np.matmul(own, rotation.T)
        return left

    def weigh(self, state: _State) -> None:
        """Leave out what lies far off, and estimate the noise of the rest."""
        left = self.left(state)
        left = left - np.median(left, axis=0)
        most = 1.4826 * _MOST_SIGMAS * np.median(np.abs(left), axis=0) + 1e-9
        kept = np.flatnonzero((np.abs(left) <= most).all(axis=1))
        again = _Fit(self.seen[kept], self.begin_ns[kept], self.end_ns[kept], self.turns)
        self.__dict__.update(again.__dict__)
        self.noise = Noise.of(self.left(state), self.run)

    def _jacobian(self, state: _State) -> F64Array:
        rotation, bias, delay_s = state
        own = np.matmul(self.other(delay_s) - self.span_s[:, None] * bias, rotation.T)
        half_s = _STEP_NS / NS_PER_S
        change = (self.other(delay_s + half_s) - self.other(delay_s - half_s)) / (2.0 * half_s)
        found = np.zeros((len(own), 3, 7))
        found[:, :, :3] = skew(own)
        found[:, :, 3:6] = self.span_s[:, None, None] * rotation
        found[:, :, 6] = -np.matmul(change, rotation.T)
        return found

    def _white(self, values: F64Array) -> F64Array:
        changed, frequency = transformed(values, self.run)
        scale = 1.0 / np.sqrt(self.noise.variance(frequency))
        white: F64Array = changed * scale.reshape(*scale.shape, *(1,) * (values.ndim - 2))
        return white

    def normal(self, state: _State) -> F64Array:
        """Normal matrix (7, 7)."""
        jacobian = self._white(self._jacobian(state)).reshape(-1, 7)
        found: F64Array = np.matmul(jacobian.T, jacobian) + np.diag(_PRIOR)
        return found

    def after(self, state: _State) -> _State:
        """The state after a step of Gauss-Newton."""
        jacobian = self._white(self._jacobian(state)).reshape(-1, 7)
        gradient = np.matmul(jacobian.T, self._white(self.left(state)).ravel())
        gradient[3:6] += _PRIOR[3:6] * state[1]
        change = -np.linalg.solve(np.matmul(jacobian.T, jacobian) + np.diag(_PRIOR), gradient)
        turn = exp_rotation(change[None, :3])[0]
        delay_s = state[2] + float(np.clip(change[6], -0.05, 0.05))
        return np.matmul(turn, state[0]), state[1] + change[3:6], delay_s

    def signal(self, state: _State) -> float:
        """Mean square of the turns, by that of the differences."""
        left = self.left(state)
        own = self.seen - self.seen.mean(axis=0)
        return float((own**2).sum() / max(float((left**2).sum()), 1e-12))


def _words(fit: _Fit, state: _State, covariance: F64Array, name: str) -> tuple[str, str]:
    """Reasons why the rotation, and the delay, are not determined; "" if they are."""
    if fit.signal(state) < _LEAST_SIGNAL:
        words = f"{name}: expected a machine that turns, found none that it and the lidar share"
        return f"{words}; {_INSTEAD}", f"{words}; {_INSTEAD}"
    variance, axes = np.linalg.eigh(covariance[:3, :3])
    rotation = late = ""
    if variance[2] > _MOST_SIGMA_RAD**2:
        x, y, z = axes[:, 2]
        sigma_deg = math.degrees(math.sqrt(variance[2]))
        rotation = (
            f"{name}: its turn about ({x:.2f}, {y:.2f}, {z:.2f}) in the frame of the lidar is "
            f"known to {sigma_deg:.2g} degrees only; {_INSTEAD}"
        )
    sigma_s = math.sqrt(covariance[6, 6])
    if sigma_s > _MOST_SIGMA_S:
        late = (
            f"{name}: its delay is known to {1000.0 * sigma_s:.2g} ms only; turn back and forth, "
            "not evenly"
        )
    return rotation, late
