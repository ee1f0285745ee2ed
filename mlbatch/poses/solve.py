"""Poses of all lidars at once, by least squares over distances between surfaces and stems.

A place is two or more windows that follow each other. Its clouds, one per lidar and window, are
moved to one instant by a twist of their own, which is solved with the poses: distances between
windows of one lidar fix the twist, distances between lidars the poses. A correction of a lidar is
a small motion of its points in the body frame, after the pose that they were converted with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.registration import ORIGIN, Pose
from mlbatch.motion.se3 import exp_rotation, log_rotation, skew
from mlbatch.poses.surfaces import Distances, Moments, Planes, distances, joined
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.poses.stems import Stems

# Cauchy kernel: residuals of this many standard deviations have half of their weight.
KERNEL = 2.5
# Observations in one sector of the body frame, and in a ring where radii differ by this factor, are
# not independent: a tree ahead stays ahead from place to place.
_SECTORS = 36
_RING = 2.0
# A turn by 1 rad moves what is this far by as much, m.
_LEVER_M = 10.0
# What a direction needs to be determined: a standard deviation, m and (by _LEVER_M) rad; the share
# of its information that is not noise of normals; blocks that the information comes from.
_MOST_SIGMA_M = 0.005
_TRUE_SHARE = 0.3
_FEWEST_BLOCKS = 3.0
# Errors of lidars that no scene shows, m and rad.
_FLOOR_M, _FLOOR_RAD = 0.001, 0.000175
# A direction that is not determined, m.
_UNKNOWN_M = 1.0
# Twists of vehicles, standard deviations, m/s and rad/s.
_SPEED_MPS, _TURN_RADPS = 15.0, 1.5
# Damping: standard deviations of a step where nothing is seen, m and m/s; largest steps.
_STEP_M, _STEP_MPS = 0.2, 1.0
# Steps of noise alone are divided by one more than this.
_CALM = 3.0
_LONGEST_M, _LONGEST_RAD = 0.5, 0.1
_LONGEST_MPS, _LONGEST_RADPS = 5.0, 0.5
# What the last term of a motion may be, as a share of a distance.
_SERIES = 1e-6
# Where surfaces are matched so far apart, steps of poses that follow each other within a cosine are
# made longer, each by more.
_FAR_M = 1.0
_ALONG = 0.9
_LONGER, _MOST_LONGER = 1.5, 4.0
# A step that changes poses and twists by less ends the search.
_SMALL_M, _SMALL_RAD = 1e-4, 1e-5
_SMALL_MPS, _SMALL_RADPS = 0.04, 0.006


@dataclass(eq=False, repr=False)
class Cloud:
    """Points of one lidar in one window, or in a sweep as its driver cut it.

    points_m: (n, 3), m, as measured, in the body frame unless said; time_s: (n,), from instant_ns,
    which counts only if clouds of several instants are compared; origin_m: (3,), where the lidar
    is, as its points were converted (without it stems are not compared).
    """

    lidar: int
    points_m: F64Array
    time_s: F64Array
    origin_m: F64Array | None = None
    instant_ns: int = 0

    @classmethod
    def of_sweep(cls, points_m: F64Array, stamp_ns: I64Array) -> Cloud:
        """A cloud with stamps (n,), its instant between the first and the last one."""
        middle_ns = (int(stamp_ns.min()) + int(stamp_ns.max())) // 2
        return cls(0, points_m, (stamp_ns - middle_ns) / NS_PER_S, None, middle_ns)

    @property
    def span_s(self) -> float:
        """From its first to its last point."""
        return float(np.ptp(self.time_s))

    @cached_property
    def stems(self) -> Stems | None:
        """Its stems; None without an origin."""
        if self.origin_m is None:
            return None
        # Not loaded by checks of poses that need none.
        from mlbatch.poses.stems import stems

        return stems(self.points_m, self.time_s, self.origin_m)


# Clouds of windows that follow each other.
Place = Sequence[Cloud]


@dataclass(eq=False, repr=False)
class State:
    """The unknowns.

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


class Level(NamedTuple):
    """How surfaces are matched: edge of cells, least cosine between normals, most distance.

    points: most of a cloud that are used, about; doubled: how many sizes of cells are used besides,
    each of twice the edge.
    """

    edge_m: float
    parallel: float
    most_m: float
    points: int = 1 << 40
    doubled: int = 0


FINE = Level(0.5, 0.97, 0.15)
LEVELS = (Level(2.0, 0.9, 1.0, 20_000), Level(1.0, 0.94, 0.4, 40_000), FINE)
# How often lidars are moved to where stems say.
_MOST_VOTES = 3
# Of a search from afar. Few beams give planes in large cells only, ground among plants in small
# ones only.
_SEARCH = (
    Level(1.0, 0.9, 1.0, 20_000, 1),
    Level(0.5, 0.94, 0.4, 40_000, 1),
    Level(0.25, 0.97, 0.15, 60_000, 3),
)
# Steps of all places before the last level, which need not settle.
_MIDDLE_STEPS = 6
# Of a search that ended badly: turns about z that others begin with; places that these look at;
# steps of each before the best is chosen; surfaces that agree; how many more make a start better.
_TURNS_RAD = np.deg2rad([-20.0, -10.0, 0.0, 10.0, 20.0])
_MOST_TRIED = 4
_TRIAL_STEPS = 5
_AGREES = Level(1.0, 0.94, 0.1)
_MORE = 1.05


class Rows(NamedTuple):
    """Equations of a place: m distances in standard deviations.

    jacobian: (m, poses + 6); noise: (m, poses + 6), its error by the noise of normals; residual:
    (m,); block: (m,); pair: (m, 2), lidars.
    """

    jacobian: F64Array
    noise: F64Array
    residual: F64Array
    block: I64Array
    pair: I64Array

    @property
    def scale(self) -> float:
        """Spread of the residuals; 1 or more."""
        middle = len(self.residual) // 2
        if not middle:
            return 1.0
        # Noise of real scenes exceeds that of the points.
        # `np.median` imports 20 ms of masked arrays.
        return max(1.0, 1.4826 * float(np.partition(np.abs(self.residual), middle)[middle]))


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """A prior for all lidars but the first without surfaces, as by their motion.

    state: corrections and delays; information: of each of these lidars (7, 7), inverse covariance
    of a shift at the body origin, m, a turn, rad, and the delay, s.
    """

    state: State
    information: Sequence[F64Array]

    def off(self, state: State) -> F64Array:
        """How far a state is from it (lidars - 1, 7)."""
        rows = []
        for lidar in range(1, len(state.corrections)):
            late_s = state.delay_s[lidar] - self.state.delay_s[lidar]
            off = move_between(self.state.corrections[lidar], state.corrections[lidar])
            rows.append(np.append(off, late_s))
        return np.array(rows)


class Problem:
    """Least squares over places.

    Unknowns: 6 for each lidar but the first (shift in m, turn in rad, body frame), its delay if
    `delays`, then 6 for each place.
    """

    def __init__(
        self,
        places: Sequence[Place],
        lidars: int,
        *,
        delays: bool = False,
        known: Known | None = None,
    ) -> None:
        self.places = places
        self.lidars = lidars
        self.each = 7 if delays else 6
        self.poses = self.each * (lidars - 1)
        self._known = known

    def known(self, state: State) -> tuple[F64Array, F64Array]:
        """Information (poses, poses) that is known before, and its slope (poses,) at a state."""
        information, slope = np.zeros((self.poses, self.poses)), np.zeros(self.poses)
        if self._known is not None:
            for number, off in enumerate(self._known.off(state)):
                at = slice(self.each * number, self.each * (number + 1))
                part = self._known.information[number][: self.each, : self.each]
                information[at, at] = part
                slope[at] = np.matmul(part, off[: self.each])
        return information, slope

    def clouds(self, place: int, state: State, edge_m: float) -> list[Planes]:
        """Planes of the clouds of a place, moved to its instant."""
        return [sizes[0] for sizes in self.planes(place, state, Level(edge_m, 0.0, 0.0))]

    def planes(self, place: int, state: State, level: Level) -> list[list[Planes]]:
        """Planes of each cloud of a place and size of cells, moved to the instant of the place."""
        found: list[list[Planes]] = []
        for cloud in self.places[place]:
            # An odd step takes all beams in turn.
            step = -(-len(cloud.points_m) // level.points) | 1
            points_m, time_s = at_instant(cloud, state, state.twists[place], step)
            sizes = [Moments.of_points(points_m, time_s, level.edge_m)]
            for _ in range(level.doubled):
                sizes.append(sizes[-1].doubled())
            found.append([moments.planes() for moments in sizes])
        return found

    def stems(self, place: int, state: State) -> list[Stems | None]:
        """Stems of the clouds of a place, moved to its instant."""
        found: list[Stems | None] = []
        for cloud in self.places[place]:
            seen, pose = cloud.stems, state.corrections[cloud.lidar]
            if seen is None:
                found.append(None)
                continue
            time_s = seen.time_s + state.delay_s[cloud.lidar]
            axis_m = moved(_corrected(seen.axis_m, pose), time_s, state.twists[place])
            along = np.matmul(pose.rotation, seen.along)
            found.append(replace(seen, axis_m=axis_m, along=along, time_s=time_s))
        return found

    def rows(self, state: State, level: Level) -> list[Rows]:
        """All equations at a state, by place."""
        return [
            self.place_rows(number, state, level, self.planes(number, state, level))
            for number in range(len(self.places))
        ]

    def place_rows(
        self, number: int, state: State, level: Level, surfaces: Sequence[Sequence[Planes]]
    ) -> Rows:
        """The equations of a place with its planes."""
        place = self.places[number]
        uprights = self.stems(number, state)
        parts, pairs = [], []
        for first, second in combinations(range(len(place)), 2):
            found = [
                distances(*sizes, level.parallel, level.most_m)
                for sizes in zip(surfaces[first], surfaces[second], strict=True)
            ]
            one, other = uprights[first], uprights[second]
            if one is not None and other is not None:
                from mlbatch.poses.stems import stem_distances

                found.append(stem_distances(one, other, level.parallel, level.most_m))
            parts += found
            pairs += [(place[first].lidar, place[second].lidar)] * sum(map(len, found))
        pair = np.array(pairs, np.int64).reshape(-1, 2)
        return self._rows(pair, joined(parts), state.twists[number])

    def _rows(self, pair: I64Array, found: Distances, twist: F64Array) -> Rows:
        """Equations of distances between the clouds of lidars (m, 2)."""
        weight = 1.0 / found.sigma_m[:, None]
        sector = np.arctan2(found.at_m[:, 1], found.at_m[:, 0]) * (_SECTORS / (2 * np.pi))
        ring = np.log(np.hypot(found.at_m[:, 0], found.at_m[:, 1]) + 1.0) / np.log(_RING)
        return Rows(
            self._jacobian(pair, found, found.normal, twist) * weight,
            self._jacobian(pair, found, found.tilt, twist) * weight,
            found.distance_m / found.sigma_m,
            np.floor(sector).astype(np.int64) * 100 + np.floor(ring).astype(np.int64),
            pair,
        )

    def _jacobian(
        self, pair: I64Array, found: Distances, normal: F64Array, twist: F64Array
    ) -> F64Array:
        jacobian = np.zeros((len(found), self.poses + 6))
        lever = np.concatenate([normal, np.cross(found.at_m, normal)], axis=1)
        for lidar in range(1, self.lidars):
            at = self.each * (lidar - 1)
            sign = (pair == lidar) @ [-1.0, 1.0]
            jacobian[:, at : at + 6] = sign[:, None] * lever
            if self.each == 7:
                jacobian[:, at + 6] = sign * np.matmul(lever, twist)
        apart_s = found.time_s[:, 1] - found.time_s[:, 0]
        jacobian[:, self.poses :] = lever * apart_s[:, None]
        return jacobian


def at_instant(
    cloud: Cloud, state: State, twist: F64Array, step: int = 1
) -> tuple[F64Array, F64Array]:
    """Every so many of the points of a cloud, moved to the instant of its place; their times."""
    time_s = cloud.time_s[::step] + state.delay_s[cloud.lidar]
    # What follows is faster column by column.
    points_m = np.asfortranarray(cloud.points_m[::step])
    points_m = _corrected(points_m, state.corrections[cloud.lidar])
    return moved(points_m, time_s, twist), time_s


def _corrected(points_m: F64Array, pose: Pose) -> F64Array:
    if pose is ORIGIN:
        return points_m
    found: F64Array = np.matmul(pose.rotation, points_m.T)
    found += pose.position_m[:, None]
    columns: F64Array = found.T
    return columns


def moved(points_m: F64Array, time_s: F64Array, twist: F64Array) -> F64Array:
    """Points (n, 3) moved by a constant twist (6,) over their times (n,)."""
    if not twist.any() or not len(points_m):
        return points_m
    turn = skew(twist[None, 3:])[0]
    speed = np.matmul(turn, points_m.T) + twist[:3, None]
    # The exponential as its series: turns of 0.3 rad leave 1e-6 of a distance.
    most = float(np.abs(time_s).max()) * float(np.linalg.norm(twist[3:]))
    terms = next(n for n in range(1, 6) if n == 5 or most ** (n + 1) < _SERIES)
    term = [speed]
    for order in range(2, terms + 1):
        term.append(np.matmul(turn / order, term[-1]))
    found = term.pop()
    found *= time_s
    for lower in reversed(term):
        found += lower
        found *= time_s
    found += points_m.T
    columns: F64Array = found.T
    return columns


class Solution(NamedTuple):
    """Outcome.

    covariance: (poses, poses) of the corrections, twists eliminated, m and rad; weak: (poses, w),
    unit directions (a turn counts 10 m a rad) that the scene does not determine, in which the
    covariance is that of 1 m; matched: of each pair of lidars, distances that were used.
    """

    state: State
    covariance: F64Array
    weak: F64Array
    matched: dict[tuple[int, int], int]


def solve(problem: Problem, state: State, level: Level, most_steps: int = 25) -> Solution:
    """Damped Gauss-Newton from a state, with surfaces matched anew in each step."""
    equations = _Equations(problem, problem.rows(state, level), state)
    before, longer = np.zeros(problem.poses), 1.0
    for _ in range(most_steps):
        step = equations.step()
        # Surfaces that come into reach one after the other draw lidars on by short equal steps.
        poses = step[: problem.poses] / equations.units
        size = float(np.linalg.norm(poses) * np.linalg.norm(before))
        is_along = level.most_m >= _FAR_M and poses @ before > _ALONG * size
        longer = min(_LONGER * longer, _MOST_LONGER) if is_along else 1.0
        before = poses
        step[: problem.poses] *= longer
        state = _after(problem, state, step)
        equations = _Equations(problem, problem.rows(state, level), state)
        if level.most_m <= FINE.most_m:
            # What nothing fixes has no end.
            _, weak = equations.determined()
            poses -= np.matmul(weak, np.matmul(weak.T, poses))
            step[: problem.poses] = poses * equations.units
        if _is_small(problem, step, max(1.0, level.most_m / FINE.most_m) ** 2):
            break
    covariance, weak = equations.determined()
    return Solution(state, covariance, weak, equations.matched())


def estimate(
    problem: Problem,
    rows: Sequence[Rows],
    state: State,
    steps: int = 3,
    most_sigma_m: float | None = None,
) -> Solution:
    """Steps from a state with rows that were matched there, and residuals that change linearly."""
    equations = _Equations(problem, rows, state)
    for _ in range(steps):
        step = equations.step()
        state = _after(problem, state, step)
        twists = step[problem.poses :].reshape(-1, 6)
        rows = [
            part._replace(
                residual=part.residual
                + np.matmul(part.jacobian, np.concatenate([step[: problem.poses], twist])),
            )
            for part, twist in zip(rows, twists, strict=True)
        ]
        equations = _Equations(problem, rows, state)
    covariance, weak = equations.determined(most_sigma_m)
    return Solution(state, covariance, weak, equations.matched())


def find_poses(
    places: Sequence[Place],
    lidars: int,
    *,
    delays: bool = False,
    guess: State | None = None,
    known: Known | None = None,
) -> Solution:
    """Solve for the poses of all lidars, coarse to fine.

    guess: corrections and delays to start with, else the poses that the points were converted with;
    up to 20 degrees and 1 m off.
    """
    state = State.start(lidars, len(places))
    if guess is not None:
        state = replace(guess, twists=state.twists)
    problem = Problem(places, lidars, known=known)
    afar, *_, fine = _SEARCH
    # A few places say where lidars are, about.
    step = -(-len(places) // _MOST_TRIED)
    few = Problem(places[::step], lidars, known=known)
    near = State(state.corrections, state.twists[::step], state.delay_s)
    for _ in range(_MOST_VOTES):
        near = solve(few, near, afar).state
        if not _follow_votes(few, near):
            break
    state = State(near.corrections, state.twists, near.delay_s)
    for level in _SEARCH[step == 1 : -1]:
        state = solve(problem, state, level, _MIDDLE_STEPS).state
    return solve(Problem(places, lidars, delays=delays, known=known), state, fine)


def better_start(places: Sequence[Place], end: State) -> State | None:
    """A start from which more surfaces agree than where a search ended, or None.

    A floor draws lidars to itself at any turn about z, and with them beyond the reach of walls.
    """
    step = -(-len(places) // _MOST_TRIED)
    problem = Problem(places[::step], len(end.corrections))
    best = State(end.corrections, end.twists[::step], end.delay_s)
    first = most = _agreeing(problem, best)
    for lidar in range(1, problem.lidars):
        tried = []
        for turn_rad in _TURNS_RAD.tolist():
            rotation = exp_rotation(np.array([[0.0, 0.0, turn_rad]]))[0]
            corrections = list(best.corrections)
            corrections[lidar] = after_move(corrections[lidar], Pose(rotation, np.zeros(3)))
            start = State(corrections, best.twists, best.delay_s)
            state = solve(problem, start, _SEARCH[0], _TRIAL_STEPS).state
            tried.append((_agreeing(problem, state), -abs(turn_rad), state))
        # Only the most promising one is worth a whole search.
        *_, state = max(tried, key=lambda one: one[:2])
        state = solve(problem, state, _SEARCH[0]).state
        agreeing = _agreeing(problem, state)
        if agreeing > most:
            best, most = state, agreeing
    if most <= _MORE * first:
        return None
    return best


def _agreeing(problem: Problem, state: State) -> int:
    """Number of surfaces and stems of different lidars that agree."""
    return sum(
        int((rows.pair[:, 0] != rows.pair[:, 1]).sum()) for rows in problem.rows(state, _AGREES)
    )


def move_between(one: Pose, other: Pose) -> F64Array:
    """The motion (6,) that leads from a correction to another, m and rad."""
    turn = np.matmul(other.rotation, one.rotation.T)
    shift_m = other.position_m - np.matmul(turn, one.position_m)
    return np.concatenate([shift_m, log_rotation(turn[None])[0]])


def after_move(pose: Pose, move: Pose) -> Pose:
    """A correction, and then a motion."""
    return Pose(
        np.matmul(move.rotation, pose.rotation),
        np.matmul(move.rotation, pose.position_m) + move.position_m,
    )


def _follow_votes(problem: Problem, state: State) -> bool:
    """Move each lidar to where its stems meet the others'; return whether one was moved."""
    from mlbatch.poses.stems import best_move

    followed = False
    for lidar in range(1, problem.lidars):
        sides = []
        for number, place in enumerate(problem.places):
            found = zip(place, problem.stems(number, state), strict=True)
            # A cloud of each lidar is enough.
            first = {cloud.lidar: stems for cloud, stems in reversed([*found]) if stems is not None}
            mine = [stems for other, stems in first.items() if other == lidar]
            sides.append((mine, [stems for other, stems in first.items() if other != lidar]))
        move = best_move(sides)
        if move is not ORIGIN:
            followed = True
            state.corrections[lidar] = after_move(state.corrections[lidar], move)
    return followed


def _is_small(problem: Problem, step: F64Array, factor: float) -> bool:
    six = np.abs(step[: problem.poses].reshape(-1, problem.each))
    twists = np.abs(step[problem.poses :].reshape(-1, 6))
    small = (six[:, :3] < factor * _SMALL_M).all() and (six[:, 3:6] < factor * _SMALL_RAD).all()
    small &= (twists[:, :3] < np.sqrt(factor) * _SMALL_MPS).all()
    small &= (twists[:, 3:] < np.sqrt(factor) * _SMALL_RADPS).all()
    return bool(small)


def _shortened(step: F64Array, shift: float, turn: float) -> F64Array:
    """Steps (k, 6 or 7), each within the longest shift and turn."""
    ratio = np.maximum(
        np.linalg.norm(step[:, :3], axis=1) / shift, np.linalg.norm(step[:, 3:6], axis=1) / turn
    )
    found: F64Array = step / np.maximum(ratio, 1.0)[:, None]
    return found


def _after(problem: Problem, state: State, step: F64Array) -> State:
    """The state after a step (u,)."""
    corrections = list(state.corrections)
    delay_s = state.delay_s.copy()
    parts = _shortened(step[: problem.poses].reshape(-1, problem.each), _LONGEST_M, _LONGEST_RAD)
    for lidar, part in enumerate(parts, 1):
        move = Pose(exp_rotation(part[None, 3:6])[0], part[:3])
        corrections[lidar] = after_move(corrections[lidar], move)
        if problem.each == 7:
            delay_s[lidar] += part[6]
    twists = _shortened(step[problem.poses :].reshape(-1, 6), _LONGEST_MPS, _LONGEST_RADPS)
    return State(corrections, state.twists + twists, delay_s)


class _Equations:
    """Normal equations of rows, with robust weights; the twist of each place is eliminated."""

    def __init__(self, problem: Problem, rows: Sequence[Rows], state: State) -> None:
        self.problem = problem
        self._rows = rows
        self._twists = state.twists
        self._information, self._slope = problem.known(state)
        self._prior = np.array([_SPEED_MPS**-2.0] * 3 + [_TURN_RADPS**-2.0] * 3)
        self.units = np.ones(problem.poses)
        for lidar in range(problem.lidars - 1):
            at = problem.each * lidar
            self.units[at + 3 : at + 6] = 1.0 / _LEVER_M
        self._residual = [part.residual / part.scale for part in rows]
        # Share of each residual in the kernel.
        self._off = [(residual / KERNEL) ** 2 for residual in self._residual]

    def step(self) -> F64Array:
        """Change of all unknowns."""
        size = self.problem.poses
        damped = _STEP_M**-2.0 / self.units**2
        normal, gradient = np.diag(damped) + self._information, self._slope.copy()
        lever = np.array([1.0] * 3 + [_LEVER_M] * 3)
        kept = []
        for part, residual, off, twist in zip(
            self._rows, self._residual, self._off, self._twists, strict=True
        ):
            jacobian = part.jacobian / part.scale
            weight = 1.0 / (1.0 + off)
            slope = np.matmul(jacobian.T, weight * residual)
            square = _product(jacobian, weight)
            # Where normals show nothing but their noise, steps would be a random walk.
            square += _CALM * _product(part.noise / part.scale, weight)
            slope[size:] += self._prior * twist
            square[size:, size:] += np.diag(self._prior + (lever / _STEP_MPS) ** 2)
            ratio = np.linalg.solve(square[size:, size:], square[size:, :size]).T
            normal += square[:size, :size] - np.matmul(ratio, square[size:, :size])
            gradient += slope[:size] - np.matmul(ratio, slope[size:])
            kept.append((square, slope))
        poses = -np.linalg.solve(normal, gradient) if size else gradient
        twists = [
            -np.linalg.solve(square[size:, size:], slope[size:] + square[size:, :size] @ poses)
            for square, slope in kept
        ]
        return np.concatenate([poses, *twists])

    def matched(self) -> dict[tuple[int, int], int]:
        """Number of distances by pair of lidars."""
        if not self._rows:
            return {}
        pair = np.concatenate([part.pair for part in self._rows])
        pairs, counts = np.unique(pair, axis=0, return_counts=True)
        return {(int(a), int(b)): int(n) for (a, b), n in zip(pairs, counts, strict=True)}

    def determined(self, most_sigma_m: float | None = None) -> tuple[F64Array, F64Array]:
        """Covariance of the poses, and the directions that are not determined.

        Normals are not exact, which adds information in directions that nothing shows. The errors
        of the two normals of a distance are independent: the product of both is free of them.
        """
        size = self.problem.poses
        most_m = most_sigma_m or _MOST_SIGMA_M
        if not size:
            return np.zeros((0, 0)), np.zeros((0, 0))
        known_before = self._information * self.units * self.units[:, None]
        plain, true = known_before.copy(), known_before.copy()
        scores, levers, noises, blocks = [], [], [], []
        for part, residual, off in zip(self._rows, self._residual, self._off, strict=True):
            jacobian, noise = part.jacobian / part.scale, part.noise / part.scale
            # Derivative of the kernel, which is below its weight.
            slope = (1.0 - off) / (1.0 + off) ** 2
            # What a change of the poses does to the twist, by the weights of the steps.
            weighted = _product(jacobian, 1.0 / (1.0 + off))
            twist = weighted[size:, size:] + np.diag(self._prior)
            ratio = np.linalg.solve(twist, weighted[size:, :size])
            pose = jacobian[:, :size] - np.matmul(jacobian[:, size:], ratio)
            wrong = noise[:, :size] - np.matmul(noise[:, size:], ratio)
            pose, wrong = pose * self.units, wrong * self.units
            plain += _product(pose, slope)
            true += _product(pose, slope) - _product(wrong, slope)
            scores.append(pose * (residual / (1.0 + off))[:, None])
            levers.append(pose * np.sqrt(np.abs(slope))[:, None])
            noises.append(wrong * np.sqrt(np.abs(slope))[:, None])
            blocks.append(part.block)
        block = np.concatenate(blocks)
        score, lever, noise = map(np.concatenate, (scores, levers, noises))
        known, axes = np.linalg.eigh(true)
        share = known / np.maximum(np.einsum("ik,ij,jk->k", axes, plain, axes), 1e-12)
        seen = (known > most_m**-2.0) & (share > _TRUE_SHARE)
        # Sums of a block count as one observation (sandwich).
        _, number = np.unique(block, return_inverse=True)
        count = int(number.max()) + 1 if len(number) else 0
        inverse = np.where(seen, 1.0 / np.where(seen, known, 1.0), 0.0)
        summed = np.zeros((count, size))
        np.add.at(summed, number, np.matmul(score, axes))
        summed *= inverse
        covariance = np.matmul(summed.T, summed) * (count / max(1.0, count - size))
        before = np.matmul(np.matmul(axes.T, known_before), axes)
        covariance += before * inverse * inverse[:, None]
        by_block = np.zeros((count, size))
        np.add.at(by_block, number, np.matmul(lever, axes) ** 2 - np.matmul(noise, axes) ** 2)
        total = by_block.sum(axis=0)
        if most_sigma_m is None:
            effective = total**2 / np.maximum((by_block**2).sum(axis=0), 1e-12)
            seen &= (effective >= _FEWEST_BLOCKS) | (np.diag(before) > _MOST_SIGMA_M**-2.0)
        else:
            # No better than without the strongest block.
            rest = np.maximum(total - by_block.max(axis=0, initial=0.0), 1e-12)
            spare = np.maximum(0.0, 1.0 / rest - np.diag(covariance))
            covariance += np.diag(np.where(seen, spare, 0.0))
        seen &= np.diag(covariance) < most_m**2
        covariance[~seen] = 0.0
        covariance[:, ~seen] = 0.0
        covariance += np.diag(np.where(seen, 0.0, _UNKNOWN_M**2))
        to_units = axes * self.units[:, None]
        floor = np.where(self.units == 1.0, _FLOOR_M, _FLOOR_RAD)
        found = np.matmul(np.matmul(to_units, covariance), to_units.T) + np.diag(floor**2)
        return found, axes[:, ~seen]


def _product(rows: F64Array, weight: F64Array) -> F64Array:
    found: F64Array = np.matmul((rows * weight[:, None]).T, rows)
    return found
