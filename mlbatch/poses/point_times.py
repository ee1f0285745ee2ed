"""Which reading of the times of decoded clouds fits what the lidars see in motion.

A driver states neither whether the header is the start or the end of a sweep nor whether times
count on from it or back to it, and its clock may be late. Points that are moved by a wrong time
land at a wrong place. The order of the times within a sweep shows in the motion of one lidar alone:
in the wrong one its sweeps agree worse with those before. The time between two lidars is solved for
with the motion, by the surfaces that both see. A time that all lidars share changes nothing and
stays unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.motion.estimate import VelocityEstimator
from mlbatch.motion.registration import ORIGIN, ColumnCloud, Pose
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.solve import (
    FINE,
    KERNEL,
    LEVELS,
    Cloud,
    Level,
    Place,
    Problem,
    State,
    after_move,
    moved,
)
from mlbatch.poses.surfaces import distances
from mlbatch.units import NS_PER_S

# Verdicts.
FITS = "fits"
DIFFERS = "differs"
MOVED = "moved"
OPEN = "not decided"
# Orders of the times within a sweep: as read, opposite, or all points at one time.
AS_READ, OPPOSITE, AT_ONCE = 1, -1, 0

# What moves less from one sweep to the next shows no time, m; turns count at this distance, m.
_LEAST_MOTION_M = 0.08
_FAR_M = 5.0
# Sweeps that move, of a lidar whose order is decided; those that are read in both orders, with the
# first ones, whose map is not complete.
_FEWEST_SWEEPS = 12
_MOST_SWEEPS = 40
_UNSETTLED = 6
# The order whose residual is smaller: by how many standard errors, by which factor, and in which
# share of the sweeps.
_PROVEN = 5.0
_FACTOR = 1.2
_SHARE = 0.7

# Instants at which two lidars are compared; those that decide from which delay it begins.
_SPOTS = 8
_FIRST_SPOTS = 4
_FEWEST_SPOTS = 4
_DELAYS_S = np.arange(-5, 6) * 0.03
_STARTS = 3
# How well poses of a rig are known: m, rad; and the motion at a spot: m/s, rad/s.
_POSE_SIGMA = np.repeat([0.03, np.deg2rad(0.5)], 3)
_TWIST_SIGMA = np.repeat([0.15, 0.03], 3)
_MOST_POSE_SIGMAS = 3.0
# Surfaces that are compared; distances at which they agree by half, m.
_SEEN = Level(1.0, 0.94, 1.0)
_NEAR_M = 0.15
_CLOSE_M = 0.02
# Surfaces of two lidars that agree, a spot.
_FEWEST_SHARED = 15.0
# A delay with a larger standard deviation is not known; errors of the model of motion, s.
_MOST_SIGMA_S = 0.004
_FLOOR_S = 0.0005
_SIGMAS = 4.0
_STEPS = 4


@dataclass(frozen=True, slots=True)
class OrderFit:
    """Whether the points of a lidar were measured in the order of their times within a sweep.

    verdict: FITS, DIFFERS (in the opposite one), MOVED (points fit as if all were measured at one
    time) or OPEN, for a reason; residual_m: from each sweep to those before, as read, in the
    opposite order and at one time; sweep_s: length of a sweep.
    """

    verdict: str
    reason: str = ""
    residual_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sweep_s: float = 0.0


@dataclass(frozen=True, slots=True)
class DelayFit:
    """How far the times of a lidar are late against those of the reference lidar.

    verdict: FITS (not late), DIFFERS or OPEN, for a reason; late_s, sigma_s: s, and its standard
    deviation; residual_m: between surfaces of both, as read and without the delay.
    """

    verdict: str
    reason: str = ""
    late_s: float = 0.0
    sigma_s: float = 0.0
    residual_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Motion of a lidar by its own sweeps, one entry a sweep.

    middle_ns: (n,) int64; residual_m: (n,), to the sweeps before, NaN where they did not match;
    at_ns: (m,) int64 and twists: (m, 6), where the motion is known.
    """

    middle_ns: I64Array
    residual_m: F64Array
    at_ns: I64Array
    twists: F64Array

    def twist(self, instant_ns: I64Array) -> F64Array:
        """Twists (k, 6) at instants (k,), m/s and rad/s."""
        from_ns = int(self.at_ns[0])
        return np.stack(
            [np.interp(instant_ns - from_ns, self.at_ns - from_ns, one) for one in self.twists.T],
            axis=1,
        )

    def step_m(self, sweep_s: float) -> F64Array:
        """How far points move from one sweep to the next (n,)."""
        if not len(self.at_ns):
            return np.zeros(len(self.middle_ns))
        return _steps_m(self.twist(self.middle_ns)) * sweep_s


# -- one lidar -------------------------------------------------------------------------------------


def track(sweeps: Sequence[Cloud], order: int = AS_READ) -> Track:
    """Motion by sweeps that follow each other, with an order of the times within each."""
    estimator = VelocityEstimator()
    residual_m, at_ns, twists = [], [], []
    before_ns = 0
    for sweep in sweeps:
        middle_ns = sweep.instant_ns
        cloud = ColumnCloud.of_points(sweep.points_m, sweep.time_s * order)
        found = estimator.add(cloud, middle_ns, round(sweep.span_s * NS_PER_S))
        residual_m.append(np.nan if found.residual_m is None else found.residual_m)
        if found.velocity is not None and before_ns:
            # The velocity of a sweep is that from the one before.
            at_ns.append((before_ns + middle_ns) // 2)
            twists.append(found.velocity)
        before_ns = middle_ns
    return Track(
        np.array([sweep.instant_ns for sweep in sweeps], np.int64),
        np.array(residual_m),
        np.array(at_ns, np.int64),
        np.array(twists).reshape(-1, 6),
    )


def fit_order(sweeps: Sequence[Cloud], as_read: Track) -> OrderFit:
    """Compare the order of the times within the sweeps of one lidar with the opposite one."""
    # The seam may face the sky.
    sweep_s = float(np.percentile([sweep.span_s for sweep in sweeps], 90)) if sweeps else 0.0
    moves = as_read.step_m(sweep_s) >= _LEAST_MOTION_M
    if not len(as_read.at_ns):
        return OrderFit(OPEN, "the lidar sees too little to follow its motion", sweep_s=sweep_s)
    if np.count_nonzero(moves) < _FEWEST_SWEEPS:
        return OrderFit(OPEN, "it stands, or hardly moves", sweep_s=sweep_s)
    part = _liveliest(moves)
    residual_m = np.stack(
        [track(sweeps[part], order).residual_m for order in (AS_READ, OPPOSITE, AT_ONCE)]
    )
    kept = moves[part] & np.isfinite(residual_m).all(axis=0)
    kept[:_UNSETTLED] = False
    if np.count_nonzero(kept) < _FEWEST_SWEEPS - _UNSETTLED:
        return OrderFit(OPEN, "too few sweeps match those before them", sweep_s=sweep_s)
    return _decided_order(residual_m[:, kept], sweep_s)


def _liveliest(moves: BoolArray) -> slice:
    """The part of so many sweeps in which most of them move."""
    length = min(_MOST_SWEEPS, len(moves))
    sums = np.concatenate([[0], np.cumsum(moves)])
    first = int(np.argmax(sums[length:] - sums[:-length]))
    return slice(first, first + length)


def _decided_order(residual_m: F64Array, sweep_s: float) -> OrderFit:
    """By residuals (3, n) as read, in the opposite order and at one time."""
    as_read, opposite, at_once = residual_m
    verdict, reason = OPEN, "no order fits clearly better"
    if _is_better(at_once, as_read) and _is_better(at_once, opposite):
        verdict, reason = MOVED, ""
    elif _is_better(as_read, opposite):
        verdict, reason = FITS, ""
    elif _is_better(opposite, as_read):
        verdict, reason = DIFFERS, ""
    read_m, back_m, once_m = np.median(residual_m, axis=1).tolist()
    return OrderFit(verdict, reason, (read_m, back_m, once_m), sweep_s)


def _is_better(one_m: F64Array, other_m: F64Array) -> bool:
    """Whether residuals (n,) are proven to be smaller than others of the same sweeps."""
    # Sweeps that follow each other share their map.
    blocks = np.array_split(other_m - one_m, max(2, len(one_m) // 2))
    change_m = np.array([block.mean() for block in blocks])
    error_m = change_m.std(ddof=1) / np.sqrt(len(change_m))
    is_clear = np.median(other_m) >= _FACTOR * np.median(one_m)
    is_usual = np.mean(change_m > 0) >= _SHARE
    return bool(is_clear and is_usual and change_m.mean() >= _PROVEN * error_m)


# -- two lidars ------------------------------------------------------------------------------------


class _Solution:
    """Least squares for the delay of the second of two lidars, its pose and the motion at spots.

    Pose and motion are nearly known. sigma_s: of the delay, if surfaces in one sector are one
    observation.
    """

    def __init__(self, places: Sequence[Place], twists: F64Array) -> None:
        self._problem = Problem(places, 2, delays=True)
        self._known = twists
        self._sigma = np.concatenate([_POSE_SIGMA, [1.0], np.tile(_TWIST_SIGMA, len(twists))])
        self.sigma_s = np.inf

    def solve(self, state: State, level: Level) -> State:
        """Some steps of Gauss-Newton; surfaces are matched anew in each."""
        for _ in range(_STEPS):
            state = self._after(state, self._step(state, level))
        return state

    def _step(self, state: State, level: Level) -> F64Array:
        """Change of pose, delay and twists (7 + 6 k,)."""
        size = len(self._sigma)
        pose = state.corrections[1]
        off = np.concatenate([pose_off(pose), state.delay_s[1:], *(state.twists - self._known)])
        normal = np.diag(self._sigma**-2.0)
        gradient = off * self._sigma**-2.0
        scores: dict[int, F64Array] = {}
        for place, rows in enumerate(self._problem.rows(state, level)):
            columns = np.concatenate([np.arange(7), 7 + 6 * place + np.arange(6)])
            residual = rows.residual / rows.scale
            jacobian = rows.jacobian / rows.scale
            weighted = jacobian / (1.0 + (residual / KERNEL) ** 2)[:, None]
            normal[np.ix_(columns, columns)] += np.matmul(weighted.T, jacobian)
            by_row = weighted * residual[:, None]
            gradient[columns] += by_row.sum(axis=0)
            for block in np.unique(rows.block).tolist():
                score = scores.setdefault(block, np.zeros(size))
                score[columns] += by_row[rows.block == block].sum(axis=0)
        inverse = np.linalg.inv(normal)
        variance = sum(float(np.dot(inverse[6], score)) ** 2 for score in scores.values())
        self.sigma_s = float(np.sqrt(max(variance, inverse[6, 6])))
        found: F64Array = -np.matmul(inverse, gradient)
        return found

    @staticmethod
    def _after(state: State, step: F64Array) -> State:
        pose = state.corrections[1]
        move = Pose(exp_rotation(step[None, 3:6])[0], step[:3])
        return State(
            [ORIGIN, after_move(pose, move)],
            state.twists + step[7:].reshape(-1, 6),
            state.delay_s + np.array([0.0, step[6]]),
        )


def pose_off(pose: Pose) -> F64Array:
    """Shift and turn of a correction (6,), m and rad."""
    return np.concatenate([pose.position_m, log_rotation(pose.rotation[None])[0]])


@dataclass(frozen=True, slots=True, eq=False)
class TimedLidar:
    """Sweeps of a lidar in order of time, and whether their times run back within each."""

    sweeps: Sequence[Cloud]
    is_back: bool

    def nearest(self, instant_ns: int) -> Sequence[Cloud]:
        """Two sweeps in a row around an instant."""
        middle_ns = np.array([sweep.instant_ns for sweep in self.sweeps])
        after = int(np.clip(np.searchsorted(middle_ns, instant_ns), 1, len(middle_ns) - 1))
        return self.sweeps[after - 1 : after + 1]


class _Pair:
    """Two lidars at some instants, with the motion there."""

    def __init__(
        self, lidars: tuple[TimedLidar, TimedLidar], instants_ns: I64Array, motion: Track
    ) -> None:
        self.lidars = lidars
        self.instants_ns = instants_ns.tolist()
        self.twists = motion.twist(instants_ns)
        step_ns = NS_PER_S // 10
        ends = motion.twist(instants_ns - step_ns), motion.twist(instants_ns + step_ns)
        self.changes = (ends[1] - ends[0]) / 0.2

    def places(self, late_s: float, spots: Sequence[int]) -> list[list[Cloud]]:
        """Clouds of both without the delay, moved by the change of the motion."""
        places = []
        for spot in spots:
            place = []
            for number, lidar in enumerate(self.lidars):
                late_ns = round(late_s * NS_PER_S) if number else 0
                instant_ns = self.instants_ns[spot] + late_ns
                for sweep in lidar.nearest(instant_ns):
                    order = OPPOSITE if lidar.is_back else AS_READ
                    time_s = sweep.time_s * order + (sweep.instant_ns - instant_ns) / NS_PER_S
                    points_m = moved(sweep.points_m, time_s**2 / 2, self.changes[spot])
                    place.append(Cloud(number, points_m, time_s))
            places.append(place)
        return places

    def start(self, spots: Sequence[int]) -> State:
        """Poses and motion as known, without a delay."""
        state = State.start(2, len(spots))
        state.twists = self.twists[spots].copy()
        return state


def fit_delay(reference: TimedLidar, lidar: TimedLidar, motion: Track, sweep_s: float) -> DelayFit:
    """Measure how late the times of a lidar are; motion: of the reference; poses must be known."""
    instants_ns = _instants(reference, lidar, motion, sweep_s)
    if len(instants_ns) < _FEWEST_SPOTS:
        return DelayFit(OPEN, "they move too little while both send")
    pair = _Pair((reference, lidar), instants_ns, motion)
    every = list(range(len(instants_ns)))
    lively = np.argsort(-_steps_m(pair.twists), kind="stable")[:_FIRST_SPOTS].tolist()
    start = pair.start(lively)
    tried = []
    for late_s in _DELAYS_S.tolist():
        agreed = _Agreement(pair.places(late_s, lively), start, _NEAR_M)
        tried.append((agreed.total, late_s))
    as_read = _Agreement(pair.places(0.0, every), pair.start(every), _CLOSE_M)
    # A search may end at another delay than the best one.
    found, best = _solved(pair, max(tried)[1], as_read)
    for _, late_s in sorted(tried, reverse=True)[1:_STARTS]:
        if found.verdict != OPEN:
            break
        other, agreed_others = _solved(pair, late_s, as_read)
        if other.verdict != OPEN and agreed_others > best:
            return other
    return found


def _solved(pair: _Pair, late_s: float, as_read: _Agreement) -> tuple[DelayFit, float]:
    """The delay that is found from a first one, and the number of surfaces that then agree."""
    every = list(range(len(pair.twists)))
    state = pair.start(every)
    for level in (LEVELS[1], FINE, FINE):
        solution = _Solution(pair.places(late_s, every), pair.twists)
        state = solution.solve(state, level)
        # Sweeps are chosen anew around the instants.
        change_s = -float(state.delay_s[1])
        late_s += change_s
        state.delay_s[1] = 0.0
    sigma_s = float(np.hypot(solution.sigma_s, _FLOOR_S))
    solved = _Agreement(pair.places(late_s, every), state, _CLOSE_M)
    reason, verdict = "", FITS if abs(late_s) <= _SIGMAS * sigma_s else DIFFERS
    # Of times that fit, surfaces agree as well either way.
    is_worse = verdict == DIFFERS and solved.total < as_read.total
    if solved.shared < _FEWEST_SHARED * len(every):
        reason, late_s, sigma_s = "they see too little in common", 0.0, 0.0
    elif (np.abs(pose_off(state.corrections[1])) > _MOST_POSE_SIGMAS * _POSE_SIGMA).any():
        reason = "their poses do not fit"
    elif abs(change_s) > sigma_s or sigma_s > _MOST_SIGMA_S or is_worse:
        reason = "motion and what both see do not determine it"
    residual_m = as_read.residual_m, solved.residual_m
    fit = DelayFit(OPEN if reason else verdict, reason, late_s, sigma_s, residual_m)
    return fit, solved.total


def _steps_m(twists: F64Array) -> F64Array:
    found: F64Array = np.linalg.norm(twists[:, :3], axis=1) + _FAR_M * np.linalg.norm(
        twists[:, 3:], axis=1
    )
    return found


def _instants(reference: TimedLidar, lidar: TimedLidar, motion: Track, sweep_s: float) -> I64Array:
    """Instants in the middle of sweeps of the reference, most of them in motion."""
    margin_ns = round(2.5 * sweep_s * NS_PER_S)
    ends = [(one.sweeps[0].instant_ns, one.sweeps[-1].instant_ns) for one in (reference, lidar)]
    first_ns = max(first for first, _ in ends) + margin_ns
    last_ns = min(last for _, last in ends) - margin_ns
    is_inside = (motion.middle_ns >= first_ns) & (motion.middle_ns <= last_ns)
    is_inside &= np.isfinite(motion.residual_m)
    moves = is_inside & (motion.step_m(sweep_s) >= _LEAST_MOTION_M)
    rows = np.flatnonzero(moves)
    if not len(rows):
        return np.zeros(0, np.int64)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, _SPOTS).round().astype(np.int64))]
    # At rest poses are seen without the delay.
    still = np.flatnonzero(is_inside & ~moves)[-1:]
    found: I64Array = motion.middle_ns[np.union1d(rows, still)]
    return found


class _Agreement:
    """Surfaces that agree in a state of a problem.

    total: their number; shared: those of both lidars; residual_m: between these.
    """

    def __init__(self, places: Sequence[Place], state: State, near_m: float) -> None:
        problem = Problem(places, 2)
        self.total = self.shared = 0.0
        apart_m = []
        for number, place in enumerate(places):
            surfaces = problem.clouds(number, state, _SEEN.edge_m)
            for first, second in combinations(range(len(place)), 2):
                found = distances(surfaces[first], surfaces[second], _SEEN.parallel, _SEEN.most_m)
                square = found.distance_m**2
                weight = float((1.0 / (1.0 + square / (found.sigma_m**2 + near_m**2))).sum())
                self.total += weight
                if place[first].lidar != place[second].lidar:
                    self.shared += weight
                    apart_m.append(square)
        square = np.concatenate(apart_m) if apart_m else np.zeros(0)
        self.residual_m = float(np.sqrt(square.mean())) if len(square) else 0.0
