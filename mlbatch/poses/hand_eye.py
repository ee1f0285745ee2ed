"""Pose between two sensors of one rigid body, from the motion that each of them measured.

If A and B are the twists of two sensors over one span of time, each in its own frame, and R, t the
pose of the second one in the frame of the first one, then exactly (R. Murray, Z. Li, S. Sastry, "A
Mathematical Introduction to Robotic Manipulation", 1994, section 2.4)

    turn   B = R' A
    shift  B = R' (A + turn of A x t)

Each step of an odometry has an error of its own, which stays, and its poses have errors that the
next step takes back. Both variances are estimated from what the fit leaves: sine transforms of a
run of steps are independent then, and slow motions, where errors that are taken back cancel, weigh
more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.motion.registration import Pose
from mlbatch.motion.se3 import exp_rotation, skew

# Runs are cut into pieces of so many steps.
_MOST_STEPS = 200
# Standard deviations of a step before any is estimated: shift, m, and turn, rad.
_FIRST_SIGMA = np.array([0.01] * 3 + [0.002] * 3)
# Variances that are tried, as shares of the mean square of the differences.
_SHARES = np.geomspace(1e-4, 2.0, 40)
# Differences beyond, in robust standard deviations, are errors of an odometry.
_MOST_SIGMAS = 6.0
_ROUNDS = 4
_MOST_ITERATIONS = 25
_SETTLED = 1e-7
_MOST_DAMPING = 1e6
# What errors seem to say is not known exactly.
_SAFETY = 1.3
# Of variances: errors of odometry follow the motion. Of simulated drives in a room, a street and a
# forest, they were 0.4 to 2.4 times the standard deviations without it.
DOUBT = 3.0
# What is known before any motion: of shifts from the first sensor, m; of turns nothing, rad.
_PRIOR = np.array([3.0] * 3 + [3.0] * 3) ** -2
# Fits that leave this much more, in variances, are another answer; others nearer to it are the
# same one.
_OTHER_COST = 25.0
_OTHER_RAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Motions over k spans of time: first, other: (k, 6), twists of two sensors, m and rad.

    run: (k,), increasing; spans with one number follow each other without a gap.
    """

    first: F64Array
    other: F64Array
    run: I64Array

    def __len__(self) -> int:
        return len(self.run)

    def take(self, kept: BoolArray) -> Steps:
        """Some of the steps; what is left out ends a run."""
        run = np.cumsum(~kept)[kept] + 1_000_000 * self.run[kept]
        return Steps(self.first[kept], self.other[kept], run)


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """first_from_other; covariance: (6, 6) of its shift and turn in the frame of the first sensor,
    m and rad, where nothing is known of 3 m and 3 rad; steps: that were used; is_unique: whether no
    other pose explains the motion as well.
    """

    first_from_other: Pose
    covariance: F64Array
    steps: int
    is_unique: bool


def hand_eye(steps: Steps) -> HandEye:
    """Find the pose of the other sensor from any start."""
    steps = steps.take(known_rows(steps.first) & known_rows(steps.other))
    noise = Noise(_FIRST_SIGMA**2, np.zeros(6))
    spectrum = _Spectrum.of(steps, noise)
    fits = sorted((_fit(spectrum, start) for start in _STARTS), key=lambda fit: fit.cost)
    best = fits[0]
    for _ in range(_ROUNDS):
        left = _left(steps, best.pose)
        steps = steps.take(_is_usual(left))
        noise = Noise.of(_left(steps, best.pose), steps.run)
        spectrum = _Spectrum.of(steps, noise)
        best = _fit(spectrum, best.pose)
    is_unique = all(
        _angle(fit.pose, best.pose) < _OTHER_RAD or _fit(spectrum, fit.pose).is_another(best)
        for fit in fits[1:]
    )
    pose, covariance = _without_noise(spectrum, best)
    return HandEye(pose, covariance, len(steps), is_unique)


def _without_noise(spectrum: _Spectrum, best: _Fit) -> tuple[Pose, F64Array]:
    """The pose and its covariance without what errors of the first sensor seem to say.

    They count as motion, so that a machine at rest seems to determine a pose, and levers come out
    short (attenuation: W. Fuller, "Measurement Error Models", 1987, section 1.1).
    """
    left = _left(spectrum.steps, best.pose).reshape(-1, 2, 3)
    errors = replace(spectrum.steps, first=np.matmul(left, best.pose.rotation.T).reshape(-1, 6))
    jacobian = _Spectrum(errors, spectrum.scale).jacobian(best.pose)
    by_noise = np.matmul(jacobian.T, jacobian)
    root = np.linalg.cholesky(best.normal)
    back = np.linalg.inv(root)
    share, axes = np.linalg.eigh(np.matmul(np.matmul(back, by_noise), back.T))
    axes = np.matmul(root, axes)
    known = np.matmul(axes * np.maximum(0.0, 1.0 - _SAFETY * share), axes.T) + np.diag(_PRIOR)
    covariance = np.linalg.inv(known)
    # Errors are of both sensors, by shares that are not known: any from none to all is as likely.
    short = np.matmul(covariance[:, :3], np.matmul(by_noise[:3, :3], best.pose.position_m))
    position_m = best.pose.position_m + short[:3] / 2.0
    covariance = DOUBT * (covariance + np.outer(short, short) / 12.0)
    return Pose(best.pose.rotation, position_m), covariance


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    pose: Pose
    normal: F64Array
    cost: float

    def is_another(self, best: _Fit) -> bool:
        """Whether this is the best pose after all, or one that explains less."""
        return _angle(self.pose, best.pose) < _OTHER_RAD or self.cost > best.cost + _OTHER_COST


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Variances (c,) of a step: of errors that stay, and of those that the next step takes back."""

    stays: F64Array
    returns: F64Array

    @classmethod
    def of(cls, left: F64Array, run: I64Array) -> Noise:
        """Most likely variances of differences (k, c) in runs (k,)."""
        values, frequency = transformed(left, run)
        square = np.maximum((left**2).sum(axis=0) / max(1, len(left)), 1e-16)
        stays, returns = (part.ravel() for part in np.meshgrid(_SHARES, _SHARES, indexing="ij"))
        variance = stays[:, None] + returns[:, None] * frequency
        log = np.log(variance).sum(axis=1)
        found = []
        for column, scale in zip(values.T, square, strict=True):
            at = int((log + (column**2 / scale / variance).sum(axis=1)).argmin())
            found.append((stays[at] * scale, returns[at] * scale))
        return cls(*np.array(found).T)

    def variance(self, frequency: F64Array) -> F64Array:
        """Variances (k, c) of transforms at frequencies (k,)."""
        found: F64Array = self.stays + self.returns * frequency[:, None]
        return found


def transformed(values: F64Array, run: I64Array) -> tuple[F64Array, F64Array]:
    """Sine transforms of values (k, ...) of each run, and their frequencies (k,).

    They diagonalise the covariance of differences of white noise, whose variances are the
    frequencies: 2 - 2 cos(pi j / (n + 1)).
    """
    changed, frequency = np.zeros_like(values), np.zeros(len(run))
    for begin, end in _pieces(run):
        count = end - begin
        angle = math.pi * np.arange(1, count + 1) / (count + 1)
        sines = np.sin(angle[:, None] * np.arange(1, count + 1)) * math.sqrt(2.0 / (count + 1))
        changed[begin:end] = np.tensordot(sines, values[begin:end], axes=1)
        frequency[begin:end] = 2.0 - 2.0 * np.cos(angle)
    return changed, frequency


def _pieces(run: I64Array) -> list[tuple[int, int]]:
    """Bounds of runs, cut to _MOST_STEPS."""
    bounds = np.flatnonzero(np.diff(run)) + 1
    begins = np.concatenate([[0], bounds]) if len(run) else bounds
    ends = np.concatenate([bounds, [len(run)]]) if len(run) else bounds
    return [
        (at, min(at + _MOST_STEPS, int(end)))
        for begin, end in zip(begins, ends, strict=True)
        for at in range(int(begin), int(end), _MOST_STEPS)
    ]


def _left(steps: Steps, pose: Pose) -> F64Array:
    """Differences (k, 6) between the motion of the other sensor and what the pose makes of it."""
    shift, turn = steps.first[:, :3], steps.first[:, 3:]
    shift = shift + np.cross(turn, pose.position_m)
    left: F64Array = steps.other - np.concatenate(
        [np.matmul(shift, pose.rotation), np.matmul(turn, pose.rotation)], axis=1
    )
    return left


def _jacobian(steps: Steps, pose: Pose) -> F64Array:
    """Change (k, 6, 6) of the differences with a shift and a turn (from the left) of the pose."""
    shift, turn = steps.first[:, :3], steps.first[:, 3:]
    moved = shift + np.cross(turn, pose.position_m)
    back = pose.rotation.T
    found = np.zeros((len(steps), 6, 6))
    # R' exp(-d) a = R' a + R' [a] d
    found[:, :3, :3] = -np.matmul(back, skew(turn))
    found[:, :3, 3:] = -np.matmul(back, skew(moved))
    found[:, 3:, 3:] = -np.matmul(back, skew(turn))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Sine transforms of steps; scale: (k, 6), by which differences are independent ones of
    variance 1."""

    steps: Steps
    scale: F64Array

    @classmethod
    def of(cls, steps: Steps, noise: Noise) -> _Spectrum:
        """Transform both motions; the law between them is linear, and so holds on."""
        first, frequency = transformed(steps.first, steps.run)
        other, _ = transformed(steps.other, steps.run)
        scale = 1.0 / np.sqrt(noise.variance(frequency))
        return cls(Steps(first, other, steps.run), scale)

    def left(self, pose: Pose) -> F64Array:
        """Differences (6 k,)."""
        white: F64Array = (_left(self.steps, pose) * self.scale).ravel()
        return white

    def jacobian(self, pose: Pose) -> F64Array:
        """Their change (6 k, 6) with the pose."""
        white: F64Array = (_jacobian(self.steps, pose) * self.scale[:, :, None]).reshape(-1, 6)
        return white

    def cost(self, pose: Pose) -> float:
        """Sum of squares with that of the prior."""
        prior = float((_PRIOR[:3] * pose.position_m**2).sum())
        return float((self.left(pose) ** 2).sum()) + prior


def _fit(spectrum: _Spectrum, pose: Pose) -> _Fit:
    """Levenberg-Marquardt from a pose."""
    damping, cost = 1e-3, spectrum.cost(pose)
    normal = np.diag(_PRIOR)
    for _ in range(_MOST_ITERATIONS):
        jacobian = spectrum.jacobian(pose)
        normal = np.matmul(jacobian.T, jacobian) + np.diag(_PRIOR)
        gradient = np.matmul(jacobian.T, spectrum.left(pose))
        gradient[:3] += _PRIOR[:3] * pose.position_m
        change = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        turn = exp_rotation(change[None, 3:])[0]
        tried = Pose(np.matmul(turn, pose.rotation), pose.position_m + change[:3])
        tried_cost = spectrum.cost(tried)
        if tried_cost > cost:
            if damping > _MOST_DAMPING:
                break
            damping *= 10.0
            continue
        pose, cost, damping = tried, tried_cost, damping / 10.0
        if np.abs(change).max() < _SETTLED:
            break
    return _Fit(pose, normal, cost)


def known_rows(values: F64Array) -> BoolArray:
    """Mask (k,) of rows (k, c) without NaN."""
    return np.asarray(np.isfinite(values).all(axis=1), np.bool_)


def _is_usual(left: F64Array) -> BoolArray:
    """Mask (k,) of steps without a difference far beyond the others."""
    size = np.median(np.abs(left), axis=0) if len(left) else np.zeros(6)
    return np.asarray((np.abs(left) <= 1.4826 * _MOST_SIGMAS * size + 1e-12).all(axis=1), np.bool_)


def _angle(first: Pose, second: Pose) -> float:
    cosine = (np.trace(np.matmul(first.rotation.T, second.rotation)) - 1.0) / 2.0
    return math.acos(min(1.0, max(-1.0, float(cosine))))


def _turns_of_a_cube() -> list[Pose]:
    """The 24 rotations that map axes on axes: any rotation is within 63 degrees of one."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.linalg.det(matrix) > 0.0:
            found.append(Pose(matrix, np.zeros(3)))
    return found


_STARTS = _turns_of_a_cube()
