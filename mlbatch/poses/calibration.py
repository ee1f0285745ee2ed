"""Poses of the lidars of a rig, from places that several of them see; refused where they are not
determined.

Poses are solved on two thirds of the places. On the others they are measured: how far surfaces of
two lidars are apart before and after, and which poses these places alone would give.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import combinations

import numpy as np

from mlbatch.arrays import F32Array, F64Array
from mlbatch.errors import RecordingError
from mlbatch.frames.transforms import compose, from_rpy_deg, rpy_deg
from mlbatch.motion.registration import Pose
from mlbatch.motion.se3 import log_rotation, skew
from mlbatch.poses.from_motion import MotionPoses
from mlbatch.poses.places import Places
from mlbatch.poses.solve import (
    FINE,
    Known,
    Place,
    Problem,
    Solution,
    State,
    at_instant,
    better_start,
    estimate,
    find_poses,
    move_between,
    solve,
)
from mlbatch.poses.surfaces import distances, shared_cells
from mlbatch.poses.turning import ImuRotation
from mlbatch.reports.json_records import to_json
from mlbatch.units import MM_PER_M, RAD_PER_DEG

# How far a guess may be off; what is found beyond, with some reserve, is no refinement of it.
MOST_OFF_M = 1.0
MOST_OFF_DEG = 20.0
_RESERVE = 1.5
# Surfaces that two lidars must share.
FEWEST_MATCHES = 60
# Cells in which surfaces are compared, m; what agrees: least cosine of normals, most distance, m.
_EDGE_M = 1.0
_PARALLEL = 0.94
_AGREES_M = 0.1
# Share of the surfaces in common that agree, at least: a floor agrees at a wrong yaw, too.
_LEAST_AGREEING = 0.8
# Places that were left out may give poses that differ by this, or by four standard deviations.
_MOST_APART_M = 0.015
_MOST_APART_DEG = 0.1
# A turn of 1 rad counts as this far in `Solution.weak`, m.
_LEVER_M = 10.0
# An axis of the body is open if this share of it is.
_IN_DIRECTIONS = 0.5
# A delay is known if its standard deviation is below, s.
_MOST_DELAY_SIGMA_S = 0.002
# Shorter delays do not move poses by more than they may be off, s.
_LEAST_DELAY_S = 0.002
# A machine that is slower is at rest.
_AT_REST_MPS, _AT_REST_RADPS = 0.05, 0.01
# Digits of poses that are written: micrometres, and degrees.
_DIGITS = 6
MS_PER_S = 1000.0
SCHEMA = "mlbatch.calibration/1"
# Says what is done: a calibration takes minutes.
STAGES = logging.getLogger("mlbatch.calibrate")


@dataclass(frozen=True, slots=True, eq=False)
class LidarPose:
    """The pose of a lidar.

    body_from_sensor: (4, 4), m; is_fixed: of the first lidar, which stays where it was; sigma_mm:
    (3,), standard deviation of its origin along x, y, z of the body; sigma_deg: (3,), of turns
    about them; moved_mm, turned_deg: from the guess; delay_ms: to add to its timestamps, 0 unless
    asked for.
    """

    name: str
    body_from_sensor: F64Array
    is_fixed: bool
    sigma_mm: F64Array
    sigma_deg: F64Array
    moved_mm: float = 0.0
    turned_deg: float = 0.0
    delay_ms: float = 0.0
    delay_sigma_ms: float = 0.0


@dataclass(frozen=True, slots=True)
class Agreement:
    """Surfaces of two lidars on the places that were left out.

    matched: pieces of surfaces that both see and that agree; share: of those in the cells that
    both see; apart_mm: median of their distances, NaN without any.
    """

    matched: int
    share: float
    apart_mm: float


@dataclass(frozen=True, slots=True)
class LidarPair:
    """Two lidars: their surfaces with the guess and with the poses that were found."""

    first: str
    second: str
    before: Agreement
    after: Agreement


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One place that was left out: points (n, 3) of each lidar, m, body frame."""

    before: tuple[F32Array, ...]
    after: tuple[F32Array, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Poses of all lidars, and how well they fit.

    places: number that the poses were solved on; held_out: number that they were measured on;
    different: places between which the machine moved; windows: of the recording; steps: windows
    whose motion was used (--from-motion); view: a picture, None of poses from motion alone.
    level: what the IMU of the first lidar says of its pose, or ""; imus: of the recording.
    """

    lidars: tuple[LidarPose, ...]
    pairs: tuple[LidarPair, ...]
    places: int
    held_out: int
    different: int
    windows: int
    view: View | None
    steps: int = 0
    level: str = ""
    imus: tuple[ImuRotation, ...] = ()

    def title(self) -> str:
        """One line on the source of the poses."""
        source = (
            f"{self.places} places, measured on {self.held_out} others, of {self.windows} windows"
        )
        if not self.places:
            source = (
                f"by motion alone, {self.steps} windows; no surfaces in common to measure it on"
            )
        return (
            f"{source}; {self.lidars[0].name} stays where it is; standard deviations along and "
            "about x, y, z of the body"
        )

    def rows(self) -> list[list[str]]:
        """The table of lidars; row 0 is the head."""
        has_delay = any(lidar.delay_sigma_ms for lidar in self.lidars)
        head = ["lidar", "x, y, z m", "roll, pitch, yaw deg", "moved mm", "turned deg"]
        head += ["+- mm", "+- deg", *(["delay ms"] if has_delay else [])]
        return [head, *(_row(lidar, has_delay=has_delay) for lidar in self.lidars)]

    def pair_rows(self) -> list[list[str]]:
        """The table of pairs of lidars; row 0 is the head."""
        head = ["pair", "surfaces", "agree before", "agree after", "apart before mm"]
        rows = [
            [
                f"{pair.first}, {pair.second}",
                str(pair.after.matched),
                f"{100 * pair.before.share:.0f} %",
                f"{100 * pair.after.share:.0f} %",
                f"{pair.before.apart_mm:.1f}",
                f"{pair.after.apart_mm:.1f}",
            ]
            for pair in self.pairs
        ]
        return [[*head, "apart after mm"], *rows]

    def imu_rows(self) -> list[list[str]]:
        """The table of IMUs whose rotation is known, empty without any; row 0 is the head."""
        head = ["imu", "roll, pitch, yaw deg", "+- deg", "off deg", "late ms"]
        rows = [_imu_row(imu) for imu in self.imus if not imu.refusal]
        return [head, *rows] if rows else []

    def notes(self) -> list[str]:
        """Refusals of IMUs, and the tilt of the first lidar by its IMU."""
        refused: dict[str, list[str]] = {}
        for imu in self.imus:
            if imu.refusal:
                refused.setdefault(imu.refusal.removeprefix(imu.name), []).append(imu.name)
        imus = [f"{', '.join(names)}{reason}" for reason, names in refused.items()]
        return [self.level, *imus] if self.level else imus

    def as_json(self) -> dict[str, object]:
        """The document of `--json`."""
        keys = "places held_out different windows steps level imus lidars pairs"
        return {"schema": SCHEMA, **{key: _as_json(getattr(self, key)) for key in keys.split()}}


def _as_json(value: object) -> object:
    """A record or a value of it; None for what is not known, since JSON has no NaN."""
    if isinstance(value, tuple):
        return [_as_json(one) for one in value]
    if is_dataclass(value):
        return {one.name: _as_json(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, float | np.ndarray) and not np.isfinite(value).all():
        return None
    return to_json(value)


def _row(lidar: LidarPose, *, has_delay: bool) -> list[str]:
    origin, angles = lidar.body_from_sensor[:3, 3].tolist(), rpy_deg(lidar.body_from_sensor)
    cells = [lidar.name, numbers(origin, 4), numbers(angles, 3)]
    if lidar.is_fixed:
        return [*cells, "-", "-", "-", "-", *(["-"] if has_delay else [])]
    cells += [f"{lidar.moved_mm:.1f}", f"{lidar.turned_deg:.3f}"]
    cells += [numbers(lidar.sigma_mm.tolist(), 1), numbers(lidar.sigma_deg.tolist(), 3)]
    return [*cells, *([f"{lidar.delay_ms:.2f} +- {lidar.delay_sigma_ms:.2f}"] if has_delay else [])]


def _imu_row(imu: ImuRotation) -> list[str]:
    off = f"{imu.off_deg:.2f}" if np.isfinite(imu.off_deg) else "-"
    late = "-"
    if np.isfinite(imu.late_ms):
        late = f"{imu.late_ms:.1f} +- {imu.late_sigma_ms:.1f}"
    return [imu.name, _angles(imu.body_from_imu), numbers(imu.sigma_deg.tolist(), 2), off, late]


def _angles(rotation: F64Array) -> str:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return numbers(rpy_deg(pose), 2)


def imu_note(imu: ImuRotation) -> str:
    """An IMU in a comment of a rig."""
    return (
        f"{imu.name}: rotation_rpy_deg [{_angles(imu.body_from_imu)}] in the body frame, standard "
        f"deviations {numbers(imu.sigma_deg.tolist(), 2)} degrees"
    )


def numbers(values: Sequence[float], digits: int) -> str:
    """Numbers with as many decimals, by commas; no -0."""
    return ", ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)


def calibrated(
    places: Places,
    names: Sequence[str],
    poses: Sequence[F64Array],
    *,
    delays: bool = False,
    guess: State | None = None,
    known: Known | None = None,
) -> Calibration:
    """Refine poses (4, 4) body_from_sensor that the clouds of places were converted with.

    delays: also solve for the delay of each lidar; guess: corrections to begin with, else none;
    known: what counts as surfaces do.
    Raises RecordingError with the reason where the recording does not determine them.
    """
    _refuse_few(places, names)
    begin = guess or State.start(len(names), 0)
    fitted = places.fitted()

    def found_from(start: State) -> Solution:
        STAGES.info("solving for the poses of %d lidars in %d places", len(names), len(fitted))
        return find_poses(fitted, len(names), delays=delays, guess=start, known=known)

    found = found_from(begin)
    try:
        return _measured(places, names, poses, begin, found, known, delays=delays)
    except RecordingError:
        STAGES.info("refused; looking for a start from which more surfaces agree")
        better = better_start(fitted, found.state)
        if better is None:
            raise
    return _measured(places, names, poses, begin, found_from(better), known, delays=delays)


def _measured(
    places: Places,
    names: Sequence[str],
    poses: Sequence[F64Array],
    begin: State,
    found: Solution,
    known: Known | None,
    *,
    delays: bool,
) -> Calibration:
    """Return the poses found from a guess, measured on the places that were left out."""
    fitted, held_out = places.fitted(), places.held_out()
    _refuse_unseen(found, names)
    _refuse_undetermined(found, names, delays=delays)
    if not delays:
        _refuse_late(Problem(fitted, len(names), delays=True, known=known), found, names)
    guessed = _corrected_poses(poses, begin)
    refined = _corrected_poses(poses, found.state)
    _refuse_far(names, guessed, refined)
    STAGES.info("measuring the poses in %d places that were left out", len(held_out))
    again = find_poses(held_out, len(names), guess=found.state)
    twists = again.state.twists
    before = _agreements(held_out, replace(begin, twists=twists))
    after = _agreements(held_out, replace(found.state, twists=twists))
    pairs = tuple(
        LidarPair(names[a], names[b], before[a, b], after[a, b])
        for a, b in combinations(range(len(names)), 2)
        if before[a, b].matched or after[a, b].matched
    )
    _refuse_disagreement(pairs)
    _refuse_apart(found, again, names, refined)
    different = _different(found.state.twists)
    # Places with one view are not independent.
    doubt = max(1.0, len(fitted) / different, _disagreement(found, again, refined))
    return Calibration(
        _lidar_poses(found, names, guessed, refined, doubt, delays=delays),
        pairs,
        len(fitted),
        len(held_out),
        different,
        places.windows,
        _view(held_out, begin, found.state, twists),
    )


def motion_poses(first: F64Array, motion: MotionPoses) -> list[F64Array]:
    """Poses (4, 4) by motion, relative to that of the first lidar."""
    found = [first]
    for pose in motion.poses[1:]:
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = pose.first_from_lidar.rotation, pose.first_from_lidar.position_m
        found.append(rounded(compose(first, own)))
    return found


def known_by_motion(
    first: F64Array, motion: MotionPoses, moved: Sequence[F64Array], guess: State
) -> Known:
    """What motion says; first: (4, 4), of the first lidar; moved, guess: poses and state by motion.

    Of lidars whose clocks differ it says the delay alone.
    """
    turned = np.kron(np.eye(2), first[:3, :3])
    information = []
    for pose, found in zip(moved[1:], motion.poses[1:], strict=True):
        part = np.zeros((7, 7))
        is_late = abs(found.late_s) > max(_LEAST_DELAY_S, 3.0 * found.late_sigma_s)
        if not (found.refusal or is_late):
            at = np.matmul(turned.T, _at(pose[:3, 3]))
            part[:6, :6] = np.matmul(np.matmul(at.T, np.linalg.inv(found.covariance)), at)
        if np.isfinite(found.late_s):
            part[6, 6] = found.late_sigma_s**-2.0
        information.append(part)
    return Known(guess, information)


def by_motion(
    names: Sequence[str], poses: Sequence[F64Array], motion: MotionPoses, windows: int
) -> Calibration:
    """Poses (4, 4) that motion alone determines; windows: of the recording."""
    lidars = [fixed(names[0], poses[0])]
    turned = np.kron(np.eye(2), poses[0][:3, :3])
    for name, pose, found in zip(names[1:], poses[1:], motion.poses[1:], strict=True):
        covariance = np.matmul(np.matmul(turned, found.covariance), turned.T)
        sigma = np.sqrt(np.diag(covariance))
        sigma_mm, sigma_deg = MM_PER_M * sigma[:3], sigma[3:] / RAD_PER_DEG
        lidars.append(LidarPose(name, pose, False, sigma_mm, sigma_deg))
    return Calibration(tuple(lidars), (), 0, 0, 0, windows, None, min(motion.steps))


# -- figures --------------------------------------------------------------------------------------


def _lidar_poses(
    found: Solution,
    names: Sequence[str],
    guessed: Sequence[F64Array],
    refined: Sequence[F64Array],
    doubt: float,
    *,
    delays: bool,
) -> tuple[LidarPose, ...]:
    """Poses with standard deviations; doubt: factor of their variances."""
    each = 7 if delays else 6
    lidars = [fixed(names[0], refined[0])]
    for number in range(1, len(names)):
        at = each * (number - 1)
        covariance = doubt * found.covariance[at : at + each, at : at + each]
        shift, turn = _spread_at(covariance, refined[number][:3, 3])
        moved_m, turned_rad = between(guessed[number], refined[number])
        lidars.append(
            LidarPose(
                names[number],
                refined[number],
                False,
                MM_PER_M * shift,
                turn / RAD_PER_DEG,
                MM_PER_M * moved_m,
                turned_rad / RAD_PER_DEG,
                MS_PER_S * float(found.state.delay_s[number]),
                MS_PER_S * float(np.sqrt(covariance[6, 6])) if delays else 0.0,
            )
        )
    return tuple(lidars)


def fixed(name: str, pose: F64Array) -> LidarPose:
    """The first lidar, whose pose (4, 4) all others are relative to."""
    return LidarPose(name, pose, True, np.zeros(3), np.zeros(3))


def _corrected_poses(poses: Sequence[F64Array], state: State) -> list[F64Array]:
    """Poses (4, 4) after the corrections of a state, the first one as it is."""
    pairs = zip(poses[1:], state.corrections[1:], strict=True)
    return [poses[0], *(rounded(corrected(pose, by)) for pose, by in pairs)]


def corrected(pose: F64Array, correction: Pose) -> F64Array:
    """A pose (4, 4) after a correction."""
    found = np.eye(4)
    found[:3, :3] = np.matmul(correction.rotation, pose[:3, :3])
    found[:3, 3] = np.matmul(correction.rotation, pose[:3, 3]) + correction.position_m
    return found


def rounded(pose: F64Array) -> F64Array:
    """A pose (4, 4) with the digits that are written."""
    origin = [round(value, _DIGITS) + 0.0 for value in pose[:3, 3].tolist()]
    angles = [round(value, _DIGITS) + 0.0 for value in rpy_deg(pose)]
    return from_rpy_deg(origin, angles)


def between(one: F64Array, other: F64Array) -> tuple[float, float]:
    """Distance of the origins of two poses (4, 4), m, and the angle between them, rad."""
    turn = log_rotation(np.matmul(other[:3, :3], one[:3, :3].T)[None])[0]
    return float(np.linalg.norm(other[:3, 3] - one[:3, 3])), float(np.linalg.norm(turn))


def _at(position_m: F64Array) -> F64Array:
    """Matrix (6, 6) from a shift at the body origin and a turn to those at a position (3,)."""
    found = np.eye(6)
    found[:3, 3:] = -skew(position_m[None])[0]
    return found


def _spread_at(covariance: F64Array, position_m: F64Array) -> tuple[F64Array, F64Array]:
    """Standard deviations of a shift at a position, m, and of a turn, rad; of (6 or 7, ...)."""
    there = _at(position_m)
    moved = np.matmul(np.matmul(there, covariance[:6, :6]), there.T)
    deviation = np.sqrt(np.maximum(np.diag(moved), 0.0))
    return deviation[:3], deviation[3:]


def _agreements(places: Sequence[Place], state: State) -> dict[tuple[int, int], Agreement]:
    """How surfaces of each pair of lidars agree in places."""
    lidars = len(state.corrections)
    problem = Problem(places, lidars)
    shared = dict.fromkeys(combinations(range(lidars), 2), 0)
    apart_m: dict[tuple[int, int], list[F64Array]] = {pair: [] for pair in shared}
    for number, place in enumerate(places):
        surfaces = problem.clouds(number, state, _EDGE_M)
        for first, second in combinations(range(len(place)), 2):
            a, b = sorted((place[first].lidar, place[second].lidar))
            if a == b:
                continue
            shared[a, b] += len(shared_cells(surfaces[first], surfaces[second])[0])
            found = distances(surfaces[first], surfaces[second], _PARALLEL, MOST_OFF_M)
            apart_m[a, b].append(np.abs(found.distance_m))
    return {pair: _agreement(shared[pair], np.concatenate(apart_m[pair])) for pair in shared}


def _agreement(shared: int, apart_m: F64Array) -> Agreement:
    matched = int((apart_m <= _AGREES_M).sum())
    middle_m = float(np.median(apart_m)) if len(apart_m) else float("nan")
    return Agreement(matched, matched / max(1, shared), MM_PER_M * middle_m)


def _differences(
    found: Solution, again: Solution, poses: Sequence[F64Array]
) -> list[tuple[F64Array, F64Array]]:
    """How far two solutions place each lidar but the first apart, and its covariance.

    (6,): shift at the lidar, m, turn, rad; what `again` does not determine is left out.
    """
    differences = []
    units = np.array([1.0] * 3 + [1.0 / _LEVER_M] * 3)
    size = len(found.covariance) // (len(poses) - 1)
    for number in range(1, len(poses)):
        off = move_between(found.state.corrections[number], again.state.corrections[number])
        at, at_again = size * (number - 1), 6 * (number - 1)
        for axis in again.weak[at_again : at_again + 6].T:
            off = off - units * axis * float(axis @ (off / units))
        covariance = (
            found.covariance[at : at + 6, at : at + 6]
            + again.covariance[at_again : at_again + 6, at_again : at_again + 6]
        )
        there = _at(poses[number][:3, 3])
        differences.append(
            (np.matmul(there, off), np.matmul(np.matmul(there, covariance), there.T))
        )
    return differences


def _different(twists: F64Array) -> int:
    """Number of places (k, 6) between which the machine moved."""
    speed, turn = np.linalg.norm(twists[:, :3], axis=1), np.linalg.norm(twists[:, 3:], axis=1)
    rests = (speed < _AT_REST_MPS) & (turn < _AT_REST_RADPS)
    return len(rests) - int((rests[1:] & rests[:-1]).sum())


def _disagreement(found: Solution, again: Solution, poses: Sequence[F64Array]) -> float:
    """Mean squared difference of two solutions in variances, of the worst lidar."""
    worst = 0.0
    for off, covariance in _differences(found, again, poses):
        worst = max(worst, float(off @ np.linalg.solve(covariance, off)) / len(off))
    return worst


# -- refusals -------------------------------------------------------------------------------------


class Undetermined(RecordingError):
    """Surfaces that do not determine the poses; their motion may."""


def _refused(expected: str, found: str, remedy: str) -> RecordingError:
    return RecordingError(f"calibrate: expected {expected}, found {found}; {remedy}")


def _undetermined(expected: str, found: str, remedy: str) -> Undetermined:
    return Undetermined(str(_refused(expected, found, remedy)))


def _refuse_few(places: Places, names: Sequence[str]) -> None:
    if places.fitted() and places.held_out():
        return
    lacking = ", ".join(
        f"{name} is missing from {count}"
        for name, count in zip(names, places.lacking, strict=True)
        if count
    )
    raise _refused(
        "two places or more, each two windows that follow each other with points of every lidar",
        f"{len(places.kept)} in {places.windows} windows{f' ({lacking})' if lacking else ''}",
        "record for longer, or leave out the lidar that sent nothing (--only)",
    )


def _refuse_unseen(found: Solution, names: Sequence[str]) -> None:
    """Refuse lidars that no chain of common surfaces joins with the first one."""
    joined = {0}
    for _ in names:
        for (a, b), count in found.matched.items():
            if count >= FEWEST_MATCHES and (a in joined or b in joined):
                joined |= {a, b}
    for number, name in enumerate(names):
        if number not in joined:
            raise _undetermined(
                f"surfaces that {name} and {names[0]} both see",
                "none, or too few, that fit together",
                f"correct the guess if it is more than {MOST_OFF_DEG:g} degrees or {MOST_OFF_M:g} "
                "m off; lidars whose views never meet need --from-motion, and a recording in which "
                "the machine drives and turns",
            )


def _refuse_late(problem: Problem, found: Solution, names: Sequence[str]) -> None:
    """Refuse poses that make up for timestamps that are late."""
    seems = estimate(problem, problem.rows(found.state, FINE), found.state)
    # One match may be too short.
    if not any(late for *_, late in _delays(seems, names, 0.5)):
        return
    late = solve(problem, found.state, FINE)
    for name, delay, sigma, is_late in _delays(late, names):
        if is_late:
            raise _refused(
                f"timestamps of {name} that agree with those of {names[0]}",
                f"a delay of {-MS_PER_S * delay:.1f} ms (+- {MS_PER_S * sigma:.1f}), which poses "
                "without it would hide",
                "give --time-offset",
            )


def _delays(
    found: Solution, names: Sequence[str], share: float = 1.0
) -> Iterator[tuple[str, float, float, bool]]:
    """Delay and standard deviation of each lidar but the first, s, and whether it is proven.

    share: of the deviations that a proof needs.
    """
    sigma_s = np.sqrt(np.diag(found.covariance))[6::7]
    delay_s = found.state.delay_s[1:]
    for name, delay, sigma in zip(names[1:], delay_s.tolist(), sigma_s.tolist(), strict=True):
        least_s = share * max(_LEAST_DELAY_S, 5.0 * sigma)
        yield name, delay, sigma, sigma < _MOST_DELAY_SIGMA_S / share and abs(delay) > least_s


def _refuse_undetermined(found: Solution, names: Sequence[str], *, delays: bool) -> None:
    each = 7 if delays else 6
    directions = _open_directions(found.weak, names, each)
    if delays:
        sigma_s = np.sqrt(np.diag(found.covariance))[6::7]
        for name, sigma in zip(names[1:], sigma_s.tolist(), strict=True):
            if sigma > _MOST_DELAY_SIGMA_S and f"{name}: its delay" not in directions:
                directions.append(f"{name}: its delay")
    if directions:
        raise _undetermined(
            "surfaces that fix the poses in every direction",
            f"none that fix {'; '.join(directions)}",
            _record_instead(directions),
        )


def _open_directions(weak: F64Array, names: Sequence[str], each: int) -> list[str]:
    """Words for directions of the poses (u, w): by axes of the body, if they can be."""
    # How much of each axis lies in the directions.
    share = (weak**2).sum(axis=1)
    axes = np.eye(len(weak))[share > _IN_DIRECTIONS]
    if len(axes) < weak.shape[1]:
        axes = weak.T
    return list(dict.fromkeys(_direction(axis, names, each) for axis in axes))


def _direction(axis: F64Array, names: Sequence[str], each: int) -> str:
    """Words for a direction of the poses (u,)."""
    parts = axis.reshape(-1, each)
    lidar = int(np.argmax((parts**2).sum(axis=1)))
    shift, turn = parts[lidar, :3], parts[lidar, 3:6]
    name = names[lidar + 1]
    rigid = float((parts[lidar, :6] ** 2).sum())
    if each == 7 and parts[lidar, 6] ** 2 > rigid:
        return f"{name}: its delay"
    if float(shift @ shift) >= float(turn @ turn):
        return f"{name}: a shift along {_axis(shift)} of the body"
    return f"{name}: a turn about {_axis(turn)} of the body"


def _axis(vector: F64Array) -> str:
    """x, y or z, or the direction in numbers."""
    unit = vector / np.linalg.norm(vector)
    largest = int(np.argmax(np.abs(unit)))
    if abs(unit[largest]) > 0.9:
        return "xyz"[largest]
    return f"({', '.join(f'{value:.2f}' for value in (unit * np.sign(unit[largest])).tolist())})"


def _record_instead(directions: Sequence[str]) -> str:
    """Advice which scene to record so that directions are fixed."""
    needed = {
        "a shift along z": "a floor that both see",
        "a shift": "a corner, a wall across, a stop at a junction",
        "a turn about z": "walls or trunks some metres away",
        "a turn": "a floor and walls some metres away",
        "its delay": "turns of the machine while it is near walls",
    }
    found = dict.fromkeys(
        next(what for key, what in needed.items() if f": {key}" in direction)
        for direction in directions
    )
    return (
        f"also record {', and '.join(found)}, seen by both lidars at the same time, or correct a "
        "guess that is far off"
    )


def _refuse_far(
    names: Sequence[str], guessed: Sequence[F64Array], refined: Sequence[F64Array]
) -> None:
    for name, before, after in zip(names, guessed, refined, strict=True):
        moved_m, turned_rad = between(before, after)
        turned_deg = turned_rad / RAD_PER_DEG
        if moved_m > _RESERVE * MOST_OFF_M or turned_deg > _RESERVE * MOST_OFF_DEG:
            raise _refused(
                f"a guess of {name} within {MOST_OFF_DEG:g} degrees and {MOST_OFF_M:g} m",
                f"poses that fit {turned_deg:.0f} degrees and {moved_m:.1f} m away, which may be "
                "another wall",
                "correct the guess, or give --from-motion",
            )


def _refuse_disagreement(pairs: Sequence[LidarPair]) -> None:
    """Refuse poses that do not fit on the places that were left out."""
    for pair in pairs:
        before, after = pair.before, pair.after
        who = f"{pair.first} and {pair.second}"
        if after.matched >= FEWEST_MATCHES and after.share < _LEAST_AGREEING:
            raise _refused(
                f"surfaces of {who} that agree on places that were left out",
                f"{100 * after.share:.0f} % of them",
                "correct the guess, or record where less moves",
            )
        if after.share < before.share - 0.02 or (
            after.matched <= before.matched and after.apart_mm > 1.1 * before.apart_mm + 1.0
        ):
            raise _refused(
                f"poses that fit {who} better than the guess on places that were left out",
                f"surfaces {after.apart_mm:.1f} mm apart, before {before.apart_mm:.1f} mm",
                "record other places, or keep the guess",
            )


def _refuse_apart(
    found: Solution, again: Solution, names: Sequence[str], poses: Sequence[F64Array]
) -> None:
    """Refuse poses that the places that were left out contradict."""
    for name, (off, covariance) in zip(names[1:], _differences(found, again, poses), strict=True):
        bound = 4.0 * np.sqrt(np.diag(covariance))
        bound[:3] += _MOST_APART_M
        bound[3:] += _MOST_APART_DEG * RAD_PER_DEG
        if (np.abs(off) > bound).any():
            shift_mm = MM_PER_M * float(np.linalg.norm(off[:3]))
            turn_deg = float(np.linalg.norm(off[3:])) / RAD_PER_DEG
            raise _refused(
                f"one pose of {name} from all places",
                f"two that are {shift_mm:.0f} mm and {turn_deg:.2f} degrees apart",
                "record more places, where less moves",
            )


# -- picture --------------------------------------------------------------------------------------


def _view(places: Sequence[Place], start: State, found: State, twists: F64Array) -> View:
    """The clouds of the place in the middle of some, moved to one instant."""
    number = len(places) // 2
    lidars = range(len(found.corrections))

    def points(state: State) -> tuple[F32Array, ...]:
        return tuple(
            np.concatenate(
                [
                    at_instant(cloud, state, twists[number])[0].astype(np.float32)
                    for cloud in places[number]
                    if cloud.lidar == lidar
                ]
            )
            for lidar in lidars
        )

    return View(points(start), points(found))
