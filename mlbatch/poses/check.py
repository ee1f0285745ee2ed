"""Whether the surfaces that two lidars see fit, with the poses of a run.

Distances between surfaces in all places, two windows that follow each other each, give one estimate
of the corrections that the poses need, with its covariance. A residual is proven only if it
stays without any single place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import log_rotation
from mlbatch.poses.solve import (
    LEVELS,
    Cloud,
    Level,
    Place,
    Problem,
    Rows,
    Solution,
    State,
    estimate,
    solve,
)
from mlbatch.poses.surfaces import Planes, shared_cells
from mlbatch.reports.poses import (
    EXCHANGED,
    LIMIT_DEG,
    LIMIT_MM,
    MEASURED,
    MISFIT,
    NOT_CHECKED,
    OFF,
    RADIANS,
    PairFigures,
)

LIMIT_M = LIMIT_MM / 1000.0
LIMIT_RAD = float(np.deg2rad(LIMIT_DEG))
# Beyond these, surfaces are matched with others, and figures are chance.
_MOST_M = 0.4
_MOST_RAD = float(np.deg2rad(3.0))
# Standard deviations by which it has to be above, and of what is determined at all.
_PROOF = 4.0
_MOST_SIGMA_M = 0.015
_MOST_SIGMA_RAD = float(np.deg2rad(0.15))
# Places that agree, at least.
_LEAST_PLACES = 2
# Places are compared until so many were; enough if all is clear, or nothing is in common.
_MOST_PLACES = 6
_CLEAR_PLACES = 2
# Places that are kept, to try other poses on.
_KEPT = 3
# Where fewer distances were matched in a place, more points and sizes of cells are used.
_FEW_SURFACES = 40
# Directions that planes do not determine, from which on stems are looked for.
_WEAK = 2
# Surfaces in common in a place, and distances between two lidars, that are chance.
_STRAY = 3
_CHANCE = 12
# Surfaces in common below which nothing is said, and the share of them that fits with good poses.
_LEAST_SURFACES = 12
_MISFIT = 0.5
_FITS = 0.8
# Turns by which what is 10 m away moves as far, as in `solve`.
_LEVER_M = 10.0
_SCALE = np.array([1.0, 1.0, 1.0, _LEVER_M, _LEVER_M, _LEVER_M])
# Least standard deviations, for errors that are not modelled.
_FLOOR_M = 0.001
_FLOOR_RAD = float(np.deg2rad(0.005))
_COARSE, _MIDDLE, _ = LEVELS
# How surfaces are matched, and where few are: in cells of three sizes.
_LIGHT = (_MIDDLE, 0)
_RICH = (Level(0.25, _MIDDLE.parallel, _MIDDLE.most_m, doubled=2), 2)
# How often surfaces of a place are matched, with the motion so far.
_MOST_MATCHES = 3
# Motion between windows, in about this time, beyond which one step is too little, m.
_BETWEEN_S = 0.1
_FAST_M = 0.05
_LINEAR_M = 0.5
# Steps at each level where something seems to be off.
_STEPS = 8
# An axis is named if the direction is within 25 degrees of it.
_ALONG_AXIS = 0.9


class _Shared(NamedTuple):
    """Surfaces of two lidars: in both, in the one that has fewer, that fit."""

    both: int
    fewer: int
    fit: int

    @classmethod
    def of(cls, first: Planes, second: Planes) -> _Shared:
        """Count the surfaces of two clouds of one window."""
        left, right = shared_cells(first, second)
        apart_m = second.mean_m[right] - first.mean_m[left]
        cosine = np.abs((first.normal[left] * second.normal[right]).sum(axis=1))
        distance_m = np.abs((first.normal[left] * apart_m).sum(axis=1))
        fits = (cosine >= _MIDDLE.parallel) & (distance_m <= _MIDDLE.most_m)
        fewer = min(len(first.key), len(second.key))
        return cls(len(left), fewer, int(np.count_nonzero(fits)))

    def plus(self, other: _Shared) -> _Shared:
        """The surfaces of this and of another window."""
        return _Shared(*map(sum, zip(self, other, strict=True)))

    @property
    def is_misfit(self) -> bool:
        """Whether there are enough, and they do not fit."""
        return self.both >= _LEAST_SURFACES and self.fit < _FITS * self.both


class Begun(NamedTuple):
    """A place with its first window only: motion, planes, and surfaces that lidars share."""

    first: Place
    state: State
    surfaces: list[list[Planes]]
    shared: list[_Shared]


class _Estimate(NamedTuple):
    """Corrections (u,), six of each lidar but the first, turns by `_LEVER_M`; covariance: (u, u);
    weak: number of directions that are not determined."""

    value: F64Array
    covariance: F64Array
    weak: int


class PoseComparison:
    """Takes places, says how the surfaces of each two lidars fit."""

    def __init__(
        self,
        names: Sequence[str],
        body_from_sensor: Sequence[F64Array],
        as_radians: Sequence[F64Array] | None = None,
        *,
        tries_others: bool = True,
    ) -> None:
        """body_from_sensor: (4, 4) of each lidar, m, as the points are converted.

        as_radians: poses if angles were meant as radians, where they may have been.
        """
        self._names = names
        self._poses = body_from_sensor
        self._as_radians = as_radians
        self._tries_others = tries_others
        self._pairs = list(combinations(range(len(names)), 2))
        self._shared = [_Shared(0, 0, 0)] * len(self._pairs)
        # Places so far; in some of them lidars have nothing in common.
        self.places = 0
        self._places: list[Place] = []
        self._rows: list[Rows] = []
        # Corrections and twists that the rows were matched with.
        self._state = State.start(len(names), 0)
        self._joined: _Estimate | None = None
        self._is_misfit = False
        # Whether planes of some points were too little.
        self._needs_stems = False
        self._needs_all = False
        # Whether more points of a window would pay.
        self.needs_more = False

    @property
    def is_settled(self) -> bool:
        """Whether more places would add nothing."""
        if self.places >= _MOST_PLACES:
            return True
        if self.places < _CLEAR_PLACES:
            return False
        pairs = self._measured()
        if all(pair.surfaces <= _STRAY * self.places for pair in pairs):
            return True
        return self._are_clear(pairs) and (not _is_any_wrong(pairs) or self._stays_wrong())

    def add(self, place: Place) -> None:
        """Compare the clouds of a place: a cloud of each lidar in a window, then in the next."""
        begun = self.begin(place[: len(self._names)])
        if begun is not None:
            self.complete(begun, place[len(self._names) :])

    def begin(self, first: Place) -> Begun | None:
        """Begin a place with a cloud of each lidar; None: the next window would add nothing."""
        state = State.start(len(self._names), 1)
        # A vehicle hardly changes its velocity from place to place.
        if self._rows:
            state.twists[:] = self._state.twists[-1:]
        surfaces = self._planes(first, state)
        shared = self._count(surfaces)
        if any(one.both > _STRAY for one in shared) or self._may_be_mistaken(first):
            return Begun(first, state, surfaces, shared)
        self._count_place(shared)
        return None

    def complete(self, begun: Begun, second: Place) -> None:
        """Complete a place with the next window."""
        first, state, surfaces, shared = begun
        self._is_misfit |= any(one.is_misfit for one in shared)
        self._count_place(shared)
        place = [*first, *second]
        self._joined = None
        self._state.twists = np.vstack([self._state.twists, state.twists])
        self._places.append(self._used(place))
        self._match(surfaces + self._planes(second, state))
        if self._joined is None:
            # Nothing is in common; stems would add nothing either.
            return
        across = _across(self._rows[-1])
        if self._joined.weak >= _WEAK and not self._needs_stems:
            self._needs_stems = True
            self._places[-1] = self._used(place)
            self._match()
        self._needs_all |= across < _FEW_SURFACES
        pairs = self._measured()
        self.needs_more = _is_any_wrong(pairs) or not self._are_clear(pairs)

    def _count_place(self, shared: Sequence[_Shared]) -> None:
        """Count the surfaces of a place that is complete."""
        both = zip(self._shared, shared, strict=True)
        self._shared = [so_far.plus(more) for so_far, more in both]
        self.places += 1

    def _planes(self, clouds: Place, state: State) -> list[list[Planes]]:
        return Problem([clouds], len(self._names)).planes(0, state, self._level[0])

    def _count(self, surfaces: Sequence[Sequence[Planes]]) -> list[_Shared]:
        """Surfaces that each two lidars share in a window."""
        counted = self._level[1]
        return [
            _Shared.of(surfaces[one][counted], surfaces[other][counted])
            for one, other in self._pairs
        ]

    def _used(self, place: Place) -> Place:
        """A place with what is needed of it."""
        return place if self._needs_stems else [replace(one, origin_m=None) for one in place]

    @property
    def _level(self) -> tuple[Level, int]:
        """How surfaces are matched, and which size of cells is counted."""
        return _RICH if self._needs_all else _LIGHT

    def _match(self, surfaces: Sequence[Sequence[Planes]] | None = None) -> None:
        """Match the surfaces of the last place with its motion, and estimate with all places.

        surfaces: by the motion so far, if they are known.
        """
        problem = Problem(self._places[-1:], len(self._names))
        level = self._level[0]
        for left in reversed(range(_MOST_MATCHES)):
            state = replace(self._state, twists=self._state.twists[-1:])
            rows = problem.place_rows(0, state, level, surfaces or problem.planes(0, state, level))
            self._rows[len(self._places) - 1 :] = [rows]
            if _across(rows) <= _CHANCE:
                return
            solution = self._solved()
            twist = solution.state.twists[-1]
            step_m = float(np.abs(twist - state.twists).max()) * _BETWEEN_S
            if not left or step_m <= _FAST_M:
                break
            self._state.twists[-1], surfaces = twist, None
        self._joined = _estimate(solution)

    def _solved(self, without: int | None = None) -> Solution:
        """The corrections by all places, or by all but one."""
        used = [number for number in range(len(self._rows)) if number != without]
        state = replace(self._state, twists=self._state.twists[used])
        rows = [self._rows[number] for number in used]
        problem = Problem([], len(self._names))
        return estimate(problem, rows, state, most_sigma_m=_MOST_SIGMA_M)

    def figures(self) -> tuple[PairFigures, ...]:
        """Return the outcome of each pair."""
        if not self._tries_others:
            return self._measured()
        self._rematch()
        found = self._measured()
        return tuple(map(self._with_cause, self._pairs, found))

    def _rematch(self) -> None:
        """Match surfaces anew where something seems to be off: one linear step may be too short."""
        if self._joined is None or not (self._is_misfit or _seems_off(self._joined)):
            return
        if all(self._is_far_off(pair) for pair in self._shared if pair.both):
            # What does not fit at all is not measured.
            return
        problem, level = Problem(self._places, len(self._names)), self._level[0]
        if self._is_misfit:
            self._state = solve(problem, self._state, _COARSE, _STEPS).state
        self._state = solve(problem, self._state, level, _STEPS).state
        self._rows = problem.rows(self._state, level)
        self._joined = _estimate(self._solved())

    def _stays_wrong(self) -> bool:
        """Whether poses are proven to be wrong if surfaces are matched anew, too."""
        before = self._state, self._rows, self._joined
        self._rematch()
        found = _is_any_wrong(self._measured())
        self._state, self._rows, self._joined = before
        return found

    def _with_cause(self, key: tuple[int, int], pair: PairFigures) -> PairFigures:
        """Figures with the mistake that explains them, if one does."""
        if pair.outcome == MEASURED and not pair.undetermined:
            return pair
        for cause, poses in self._others(key):
            if self._fits(key, poses, is_whole=not pair.is_wrong):
                # That they fit in all directions is proof, too.
                outcome = pair.outcome if pair.is_wrong else MISFIT
                return pair._replace(outcome=outcome, reason="", fits_with=cause)
        return pair

    def _others(self, key: tuple[int, int]) -> Iterator[tuple[str, Sequence[F64Array]]]:
        """Mistakes that two lidars may suffer from, and the poses without them."""
        one, other = key
        exchanged = list(self._poses)
        exchanged[one], exchanged[other] = self._poses[other], self._poses[one]
        yield EXCHANGED, exchanged
        if self._as_radians is not None:
            yield RADIANS, self._as_radians

    def _may_be_mistaken(self, first: Place) -> bool:
        """Whether lidars that share nothing in the first window may do so without a mistake."""
        if self.places or not self._tries_others:
            return False
        for key in self._pairs:
            for _, poses in self._others(key):
                clouds = self._with_poses(first, key, poses)
                if self._alone(key, poses).begin(clouds) is not None:
                    return True
        return False

    def _alone(self, key: tuple[int, int], poses: Sequence[F64Array]) -> PoseComparison:
        """A comparison of two lidars alone: others would cost more and say little."""
        names, chosen = [self._names[lidar] for lidar in key], [poses[lidar] for lidar in key]
        return PoseComparison(names, chosen, tries_others=False)

    def _with_poses(
        self, clouds: Place, key: tuple[int, int], poses: Sequence[F64Array]
    ) -> list[Cloud]:
        """Clouds of two lidars as if they had been converted with other poses."""
        moves = {lidar: poses[lidar] @ np.linalg.inv(self._poses[lidar]) for lidar in key}
        found = []
        for cloud in clouds:
            if cloud.lidar in key:
                turn, shift_m = moves[cloud.lidar][:3, :3], moves[cloud.lidar][:3, 3]
                points_m = np.matmul(cloud.points_m, turn.T) + shift_m
                origin_m = cloud.origin_m
                if origin_m is not None:
                    origin_m = np.matmul(turn, origin_m) + shift_m
                found.append(Cloud(key.index(cloud.lidar), points_m, cloud.time_s, origin_m))
        return found

    def _measured(self) -> tuple[PairFigures, ...]:
        if self._joined is None and self._rows:
            self._joined = _estimate(self._solved())
        return tuple(map(self._figures, self._pairs, self._shared))

    @staticmethod
    def _are_clear(pairs: Sequence[PairFigures]) -> bool:
        """Whether each pair is proven to be wrong, or to be right in all directions."""
        return all(
            pair.is_wrong or (pair.is_known and pair.is_within(_PROOF) and not pair.undetermined)
            for pair in pairs
        )

    def _figures(self, key: tuple[int, int], pair: _Shared) -> PairFigures:
        joined = self._joined
        names = self._names[key[0]], self._names[key[1]]
        if not pair.both:
            return PairFigures(names, NOT_CHECKED, "the lidars see nothing in common")
        figures = PairFigures(
            names,
            NOT_CHECKED,
            places=self.places,
            surfaces=pair.both,
            overlap_percent=round(100 * pair.both / pair.fewer, 1),
            fit_percent=round(100 * pair.fit / pair.both, 1),
        )
        if pair.both < _LEAST_SURFACES * min(self.places, _LEAST_PLACES):
            return figures._replace(reason=f"they have only {pair.both} surfaces in common")
        if self._is_far_off(pair):
            return figures._replace(outcome=MISFIT)
        if joined is None:
            return figures._replace(reason="what they see in common determines no direction")
        shift = self._part(key, joined, turn=False)
        turn = self._part(key, joined, turn=True)
        if shift.size is None and turn.size is None:
            return figures._replace(reason="what they see in common determines no direction")
        is_off = shift.is_proven or turn.is_proven
        if is_off and ((shift.size or 0.0) > _MOST_M or (turn.size or 0.0) > _MOST_RAD):
            return figures._replace(outcome=MISFIT)
        if not is_off and (shift.is_beyond or turn.is_beyond):
            reason = "what is seen in one place contradicts the others"
            if len(self._rows) < _LEAST_PLACES:
                reason = "one place alone does not prove that they are apart"
            return figures._replace(reason=reason)
        shift_mm, shift_deviation_mm = shift.rounded(1000.0, 1)
        turn_deg, turn_deviation_deg = turn.rounded(float(np.rad2deg(1.0)), 3)
        return figures._replace(
            outcome=OFF if is_off else MEASURED,
            shift_mm=shift_mm,
            shift_deviation_mm=shift_deviation_mm,
            turn_deg=turn_deg,
            turn_deviation_deg=turn_deviation_deg,
            undetermined=(
                *(f"shift along {axis}" for axis in shift.undetermined),
                *(f"turn about {axis}" for axis in turn.undetermined),
            ),
        )

    def _is_far_off(self, pair: _Shared) -> bool:
        """Whether so few surfaces fit that the poses cannot be measured."""
        return pair.fit < _MISFIT * pair.both and self.places >= _LEAST_PLACES

    def _part(self, key: tuple[int, int], joined: _Estimate, *, turn: bool) -> _Part:
        """Shift or turn of the second lidar of a pair, at its place."""
        to_part = self._matrix(key, turn=turn)
        value = np.matmul(to_part, joined.value)
        covariance = np.matmul(np.matmul(to_part, joined.covariance), to_part.T)
        most, limit = (_MOST_SIGMA_RAD, LIMIT_RAD) if turn else (_MOST_SIGMA_M, LIMIT_M)
        floor = _FLOOR_RAD if turn else _FLOOR_M
        variance, axes = np.linalg.eigh(covariance)
        known = variance <= most**2
        part = _Part(undetermined=tuple(map(_axis_name, axes.T[~known])))
        if not known.any():
            return part
        determined = np.matmul(axes[:, known], np.matmul(axes[:, known].T, value))
        part.size = float(np.linalg.norm(determined))
        along = determined / part.size if part.size > floor else axes[:, known][:, -1]
        part.sigma = max(floor, float(np.sqrt(along @ covariance @ along)))
        part.is_beyond = part.size - _PROOF * part.sigma > limit
        if part.is_beyond:
            part.is_proven = self._agree(np.matmul(along, to_part), limit, most)
        return part

    def _agree(self, along: F64Array, limit: float, most: float) -> bool:
        """Whether a residual along a direction of the corrections (u,) rests on no single place."""
        if len(self._rows) < _LEAST_PLACES:
            return False
        for number in range(len(self._rows)):
            rest = _estimate(self._solved(number))
            if float(along @ rest.covariance @ along) > (2 * most) ** 2:
                return False
            if float(along @ rest.value) < limit / 2:
                return False
        return True

    def _matrix(self, key: tuple[int, int], *, turn: bool) -> F64Array:
        """From corrections (u,) to shift, m, or turn, rad, of the second lidar at its place."""
        size = 6 * (len(self._names) - 1)
        found = np.zeros((3, size))
        x, y, z = self._poses[key[1]][:3, 3]
        # A turn about the body's origin shifts the lidar by turn x place.
        lever = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        six = np.hstack([np.zeros((3, 3)), np.eye(3)] if turn else [np.eye(3), lever]) / _SCALE
        for lidar, sign in zip(key, (-1.0, 1.0), strict=True):
            if lidar:
                found[:, 6 * (lidar - 1) : 6 * lidar] += sign * six
        return found

    def _fits(self, key: tuple[int, int], poses: Sequence[F64Array], *, is_whole: bool) -> bool:
        """Whether surfaces of two lidars fit with other poses.

        is_whole: all directions have to be determined.
        """
        if len(self._places) < _LEAST_PLACES:
            return False
        comparison = self._alone(key, poses)
        for place in self._places[:_KEPT]:
            comparison.add(self._with_poses(place, key, poses))
            if comparison._is_misfit or not comparison._rows:
                return False
        (figures,) = comparison.figures()
        return (
            figures.outcome == MEASURED
            and figures.shift_mm is not None
            and figures.turn_deg is not None
            and figures.fit_percent >= 100 * _FITS
            and figures.is_within(_PROOF)
            and not (is_whole and figures.undetermined)
        )


@dataclass(eq=False, repr=False)
class _Part:
    """Length of a shift or turn in the directions that are determined, m or rad."""

    size: float | None = None
    sigma: float = 0.0
    is_beyond: bool = False
    is_proven: bool = False
    undetermined: tuple[str, ...] = ()

    def rounded(self, unit: float, digits: int) -> tuple[float | None, float | None]:
        """Length and standard deviation in a unit; None without a direction."""
        if self.size is None:
            return None, None
        return round(unit * self.size, digits), round(unit * self.sigma, digits)


def _is_any_wrong(pairs: Sequence[PairFigures]) -> bool:
    return any(pair.is_wrong for pair in pairs)


def _across(rows: Rows) -> int:
    """Number of distances between surfaces of two lidars."""
    return int(np.count_nonzero(np.diff(rows.pair)))


def _estimate(solution: Solution) -> _Estimate:
    """The estimate of a solution."""
    corrections = solution.state.corrections[1:]
    scale = np.tile(_SCALE, len(corrections))
    rotations = np.stack([one.rotation for one in corrections])
    shifts = np.stack([one.position_m for one in corrections])
    value = np.hstack([shifts, log_rotation(rotations)]).ravel() * scale
    covariance = solution.covariance * scale[:, None] * scale
    covariance = (covariance + covariance.T) / 2
    return _Estimate(value, covariance, solution.weak.shape[1])


def _seems_off(estimate: _Estimate) -> bool:
    """Whether a linear estimate is near a limit, or beyond."""
    variance, axes = np.linalg.eigh(estimate.covariance)
    along = np.abs(np.matmul(axes.T, estimate.value))
    is_off = along > np.maximum(LIMIT_M / 2, 3 * np.sqrt(variance))
    # Beyond, one linear step says nothing.
    return bool(is_off.any() or np.abs(estimate.value).max() > _LINEAR_M)


def _axis_name(direction: F64Array) -> str:
    """A direction in the body frame in words."""
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) >= _ALONG_AXIS:
        return "xyz"[axis]
    x, y, z = direction * np.sign(direction[axis])
    return f"({x:.2f}, {y:.2f}, {z:.2f})"
