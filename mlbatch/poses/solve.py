"""Poses of all lidars at once, by least squares over distances between surfaces.

A place is two or more windows that follow each other. Its clouds, one a lidar and window, are
moved to one instant by a twist of their own, which is solved with the poses: distances between
windows of one lidar fix the twist, distances between lidars the poses. A correction of a lidar is
a small motion of its points in the body frame, after the pose that they were converted with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import exp_rotation, exp_transform
from mlbatch.poses.surfaces import Distances, Planes, distances, planes

# Cauchy kernel: residuals of this many standard deviations have half of their weight.
_KERNEL = 2.5
# Observations this near to each other, and of one place, are not independent, m.
_BLOCK_M = 3.0
# What a direction needs besides its standard deviation: a share of its observations whose normals
# lie along it, as normals are not exact, and blocks that they come from.
_ALONG = 0.15
_FEWEST_BLOCKS = 6
_STEP_M = 1e-4
_STEP_RAD = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of one lidar in one window: (n, 3) in the body frame, m, as measured; time_s: (n,),
    from the instant of the place."""

    lidar: int
    points_m: F64Array
    time_s: F64Array


# Clouds of windows that follow each other.
Place = Sequence[Cloud]


@dataclass(slots=True, eq=False)
class State:
    """What is solved for.

    corrections: of each lidar, body_from_body, the first one ORIGIN; twists: (places, 6), m/s and
    rad/s; delay_s: (lidars,), added to the times of each lidar, the first one 0.
    """

    corrections: list[Pose]
    twists: F64Array
    delay_s: F64Array

    @classmethod
    def start(cls, lidars: int, places: int) -> State:
        """Poses as converted, at rest."""
        return cls([ORIGIN] * lidars, np.zeros((places, 6)), np.zeros(lidars))


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """How surfaces are matched: edge of cells, least cosine between normals, most distance."""

    edge_m: float
    parallel: float
    most_m: float


FINE = Level(0.5, 0.97, 0.15)
LEVELS = (Level(2.0, 0.9, 1.0), Level(1.0, 0.94, 0.4), FINE)


@dataclass(slots=True, eq=False)
class Rows:
    """Weighted equations: jacobian (m, u), residual (m,) in standard deviations; block: (m,).

    pair: (m, 2), lidars of each.
    """

    jacobian: list[F64Array] = field(default_factory=list)
    residual: list[F64Array] = field(default_factory=list)
    block: list[I64Array] = field(default_factory=list)
    pair: list[I64Array] = field(default_factory=list)


class Problem:
    """Least squares over places.

    Unknowns: 6 for each lidar but the first (shift in m, turn in rad, body frame), its delay if
    `delays`, then 6 for each place.
    """

    def __init__(self, places: Sequence[Place], lidars: int, *, delays: bool = False) -> None:
        self.places = places
        self.lidars = lidars
        self.each = 7 if delays else 6
        self.poses = self.each * (lidars - 1)
        self.unknowns = self.poses + 6 * len(places)

    def clouds(self, place: int, state: State, edge_m: float) -> list[Planes]:
        """Planes of the clouds of a place, moved to its instant."""
        found: list[Planes] = []
        for cloud in self.places[place]:
            pose = state.corrections[cloud.lidar]
            points_m = np.matmul(cloud.points_m, pose.rotation.T) + pose.position_m
            time_s = cloud.time_s + state.delay_s[cloud.lidar]
            found.append(planes(moved(points_m, time_s, state.twists[place]), time_s, edge_m))
        return found

    def rows(self, state: State, level: Level) -> Rows:
        """All equations at a state."""
        rows = Rows()
        for number, place in enumerate(self.places):
            surfaces = self.clouds(number, state, level.edge_m)
            for first, second in combinations(range(len(place)), 2):
                pair = place[first].lidar, place[second].lidar
                found = distances(surfaces[first], surfaces[second], level.parallel, level.most_m)
                if len(found):
                    self._add(rows, number, pair, found, state.twists[number])
        return rows

    def _add(
        self, rows: Rows, place: int, pair: tuple[int, int], found: Distances, twist: F64Array
    ) -> None:
        jacobian = np.zeros((len(found), self.unknowns))
        lever = np.concatenate([found.normal, np.cross(found.at_m, found.normal)], axis=1)
        for lidar, sign in zip(pair, (-1.0, 1.0), strict=True):
            if lidar:
                at = self.each * (lidar - 1)
                jacobian[:, at : at + 6] += sign * lever
                if self.each == 7:
                    jacobian[:, at + 6] += sign * np.matmul(lever, twist)
        apart_s = found.time_s[:, 1] - found.time_s[:, 0]
        at = self.poses + 6 * place
        jacobian[:, at : at + 6] = lever * apart_s[:, None]
        block = np.floor(found.at_m / _BLOCK_M).astype(np.int64)
        key = ((place * 1000 + block[:, 0]) * 1000 + block[:, 1]) * 1000 + block[:, 2]
        rows.jacobian.append(jacobian / found.sigma_m[:, None])
        rows.residual.append(found.distance_m / found.sigma_m)
        rows.block.append(key)
        rows.pair.append(np.tile(np.array(pair), (len(found), 1)))


def moved(points_m: F64Array, time_s: F64Array, twist: F64Array) -> F64Array:
    """Points (n, 3) moved by a constant twist (6,) over their times (n,)."""
    if not twist.any():
        return points_m
    # A thousand steps over the time of a place are enough for any vehicle.
    steps, index = np.unique(np.round(time_s, 4), return_inverse=True)
    rotation, shift = exp_transform(steps[:, None] * twist[:3], steps[:, None] * twist[3:])
    turned = np.matmul(rotation[index], points_m[:, :, None])[:, :, 0]
    found: F64Array = turned + shift[index]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Outcome.

    covariance: (poses, poses) of the corrections, twists eliminated, m and rad; weak: (poses, w),
    unit directions (a turn counts 10 m a rad) that the scene does not determine; matched: of each
    pair of lidars, distances that were used; rms: of residuals in standard deviations.
    """

    state: State
    covariance: F64Array
    weak: F64Array
    matched: dict[tuple[int, int], int]
    rms: float
    converged: bool


# A turn by 1 rad moves what is this far by as much, m.
_LEVER_M = 10.0
# Standard deviations of a direction that is determined, m and (by _LEVER_M) rad.
_MOST_SIGMA_M = 0.015


def solve(problem: Problem, state: State, level: Level, most_steps: int = 25) -> Solution:
    """Gauss-Newton from a state, with surfaces matched anew in each step."""
    converged = False
    equations = _Equations(problem, problem.rows(state, level))
    for _ in range(most_steps):
        step = equations.step()
        state = _after(problem, state, step)
        equations = _Equations(problem, problem.rows(state, level))
        if _is_small(problem, step):
            converged = True
            break
    covariance, weak = equations.determined()
    return Solution(state, covariance, weak, equations.matched(), equations.rms, converged)


def find_poses(
    places: Sequence[Place], lidars: int, *, delays: bool = False, guess: State | None = None
) -> Solution:
    """Solve for the poses of all lidars, coarse to fine.

    guess: where to start, else the poses that the points were converted with; up to 20 degrees and
    1 m off.
    """
    state = guess or State.start(lidars, len(places))
    problem = Problem(places, lidars)
    for level in LEVELS[:-1]:
        state = solve(problem, state, level).state
    return solve(Problem(places, lidars, delays=delays), state, LEVELS[-1])


def _is_small(problem: Problem, step: F64Array) -> bool:
    six = step[: problem.poses].reshape(-1, problem.each) if problem.poses else np.zeros((0, 6))
    return bool((np.abs(six[:, :3]) < _STEP_M).all() and (np.abs(six[:, 3:6]) < _STEP_RAD).all())


def _after(problem: Problem, state: State, step: F64Array) -> State:
    """The state after a step (u,)."""
    corrections = list(state.corrections)
    delay_s = state.delay_s.copy()
    for lidar in range(1, problem.lidars):
        at = problem.each * (lidar - 1)
        pose, part = corrections[lidar], step[at : at + problem.each]
        turn = exp_rotation(part[None, 3:6])[0]
        corrections[lidar] = Pose(
            np.matmul(turn, pose.rotation), np.matmul(turn, pose.position_m) + part[:3]
        )
        if problem.each == 7:
            delay_s[lidar] += part[6]
    return State(corrections, state.twists + step[problem.poses :].reshape(-1, 6), delay_s)


class _Equations:
    """Normal equations of rows, with robust weights."""

    def __init__(self, problem: Problem, rows: Rows) -> None:
        self.problem = problem
        empty = not rows.jacobian
        self.jacobian = np.zeros((0, problem.unknowns)) if empty else np.concatenate(rows.jacobian)
        self.residual = np.zeros(0) if empty else np.concatenate(rows.residual)
        self.block = np.zeros(0, np.int64) if empty else np.concatenate(rows.block)
        self.pair = np.zeros((0, 2), np.int64) if empty else np.concatenate(rows.pair)
        # Noise of real scenes exceeds that of the points; never below 1.
        scale = 1.4826 * float(np.median(np.abs(self.residual))) if len(self.residual) else 1.0
        self.scale = max(1.0, scale)
        normalised = self.residual / self.scale
        self.weight = 1.0 / (1.0 + (normalised / _KERNEL) ** 2)
        self.rms = float(np.sqrt((normalised**2 * self.weight).mean())) if len(normalised) else 0.0
        self._scaled = self.jacobian / self.scale
        # What is not seen at all stays where it is.
        self._prior = np.full(problem.unknowns, 1e-6)
        self.normal = np.matmul(self._scaled.T * self.weight, self._scaled)
        self.inverse = np.linalg.inv(self.normal + np.diag(self._prior))

    def step(self) -> F64Array:
        """Change of all unknowns."""
        gradient = np.matmul(self._scaled.T, self.weight * self.residual / self.scale)
        found: F64Array = -np.matmul(self.inverse, gradient)
        return found

    def matched(self) -> dict[tuple[int, int], int]:
        """Number of distances by pair of lidars."""
        pairs, counts = np.unique(self.pair, axis=0, return_counts=True)
        return {(int(a), int(b)): int(n) for (a, b), n in zip(pairs, counts, strict=True)}

    def determined(self) -> tuple[F64Array, F64Array]:
        """Covariance of the poses, and the directions that are not determined."""
        size = self.problem.poses
        units = np.ones(size)
        for lidar in range(self.problem.lidars - 1):
            at = self.problem.each * lidar
            units[at + 3 : at + 6] = 1.0 / _LEVER_M
        plain = self.inverse[:size, :size]
        _, axes = np.linalg.eigh(plain / units[:, None] / units)
        weak = [axis for axis in axes.T if not self._is_seen(axis, units)]
        # Sums of a block count as one observation (sandwich); never less than noise alone gives.
        by_block = self._by_block()[:size, :size]
        least, found = np.diag(plain), np.maximum(np.diag(by_block), 1e-30)
        grown = np.sqrt(np.maximum(1.0, least / found))
        return by_block * grown[:, None] * grown, np.array(weak).reshape(-1, size).T

    def _by_block(self) -> F64Array:
        """Covariance of all unknowns if observations of a block are one."""
        order = np.argsort(self.block, kind="stable")
        scores = self._scaled * (self.weight * self.residual / self.scale)[:, None]
        first = np.unique(self.block[order], return_index=True)[1]
        summed = np.add.reduceat(scores[order], first, axis=0) if len(order) else scores
        meat = np.matmul(summed.T, summed)
        found: F64Array = np.matmul(np.matmul(self.inverse, meat), self.inverse)
        return found

    def _is_seen(self, axis: F64Array, units: F64Array) -> bool:
        """Whether observations along a direction of the poses (size,) determine it."""
        size = self.problem.poses
        # What a change along the axis does to the distances that the twists do not take up.
        change = np.matmul(self._scaled[:, :size], axis * units)
        twists = self._scaled[:, size:]
        if twists.shape[1]:
            root = np.sqrt(self.weight)
            fit, *_ = np.linalg.lstsq(twists * root[:, None], change * root, rcond=1e-9)
            change = change - np.matmul(twists, fit)
        sigma = 1.0 / np.maximum(np.abs(self._scaled).max(axis=1), 1e-12)
        along = np.abs(change) * sigma >= _ALONG
        known = float((self.weight[along] * change[along] ** 2).sum())
        blocks = len(np.unique(self.block[along]))
        return blocks >= _FEWEST_BLOCKS and known * _MOST_SIGMA_M**2 > 1.0
