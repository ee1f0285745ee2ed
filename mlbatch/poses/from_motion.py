"""Poses of lidars from the motion of the machine alone, without a guess.

Each lidar measures its own motion from window to window, in its own frame, however it is mounted:
`motion/estimate.py` does, in a frame whose z axis is the most frequent normal of surfaces.
`hand_eye.py` finds the pose that makes these motions one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.estimate import VelocityEstimator
from mlbatch.motion.registration import ORIGIN, ColumnCloud, Pose
from mlbatch.motion.se3 import exp_rotation, exp_transform, log_rotation, rotated
from mlbatch.poses.hand_eye import Steps, hand_eye, known_rows
from mlbatch.poses.solve import Cloud
from mlbatch.poses.surfaces import planes
from mlbatch.poses.turning import Turning, lidar_turns, turning
from mlbatch.units import NS_PER_S

# A map of 2 s drifts by some mm over 8 s.
_MAP_WINDOWS = 20
# Windows before and after one that its motion is interpolated from.
_REACH = 2
# More points per window are thinned; thin trunks need all of 128 beams.
_MOST_POINTS = 130_000
# Cells, m, and least cosine between normals, of the direction that stands for upward.
_UP_EDGE_M = 1.0
_UP_PARALLEL = 0.97
_FEWEST_PLANES = 20
# Fewer steps determine nothing.
_LEAST_STEPS = 30
# Root mean square of a step, m and rad a second; less is standstill.
_LEAST_SPEED = 0.05
_LEAST_TURN = 0.01
# Standard deviations of a pose that can be used as it is: a third of 20 mm and 0.1 degrees.
_MOST_SIGMA_M = 0.007
_MOST_SIGMA_RAD = math.radians(0.035)
# And of a start that surfaces in common can refine, of which a guess may be 1 m and 20 degrees off.
_MOST_START_RAD = math.radians(6.0)
# Beyond, a pose is another one: of chi-squared with six degrees of freedom one in 10^6.
_MOST_SQUARE = 38.0
# Between two clocks.
_MOST_LATE_S = 0.015
_ALONG = math.cos(math.radians(25.0))

_INSTEAD = (
    "drive a figure of eight, over a kerb; or give a guess and calibrate where the lidars see the "
    "same surfaces"
)


@dataclass(frozen=True, slots=True, eq=False)
class MotionWindow:
    """A window [start_ns, end_ns) with a cloud of each lidar, in its sensor frame, times from the
    middle."""

    start_ns: int
    end_ns: int
    clouds: Sequence[Cloud]


@dataclass(frozen=True, slots=True, eq=False)
class MotionPose:
    """Pose of a lidar as its motion gives it.

    first_from_lidar: where nothing determines it, the shift is the shortest one; sigma: (6,),
    standard deviations of shift, m, and turn, rad, in the frame of the first lidar; covariance:
    (6, 6); weak: (6, w), unit directions of a shift or a turn that are known too badly to be used
    without a refinement; undetermined: the same in words; refusal: why there is no pose that a
    refinement could start from, or ""; late_s: of its stamps against the first lidar's, NaN where
    the turns do not show it, with its standard deviation.
    """

    first_from_lidar: Pose
    covariance: F64Array
    weak: F64Array
    undetermined: tuple[str, ...]
    refusal: str
    late_s: float = math.nan
    late_sigma_s: float = math.nan

    @property
    def sigma(self) -> F64Array:
        """Standard deviations (6,)."""
        found: F64Array = np.sqrt(np.diag(self.covariance))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class MotionPoses:
    """Poses of all lidars, the first one at the origin.

    steps: windows whose motion was measured, of each lidar; middle_ns: (k,), of all windows;
    twist: (lidars, k, 6), motion from the middle of the window before in the frame of the lidar,
    m and rad, NaN where it is not known.
    """

    poses: tuple[MotionPose, ...]
    steps: tuple[int, ...]
    middle_ns: I64Array
    twist: F64Array

    @property
    def refusal(self) -> str:
        """Why a pose cannot even be a start, of the first such lidar, or ""."""
        return next((pose.refusal for pose in self.poses if pose.refusal), "")

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Directions of all lidars that need surfaces in common."""
        return tuple(words for pose in self.poses for words in pose.undetermined)


def poses_from_motion(windows: Iterable[MotionWindow], names: Sequence[str]) -> MotionPoses:
    """Poses of lidars in the frame of the first one.

    windows: consecutive ones, each with a cloud for each of `names`; the last ones are held only.
    """
    odometries = [Odometry() for _ in names]
    middle_ns: list[int] = []
    twists: list[list[F64Array]] = []
    for window in windows:
        middle_ns.append((window.start_ns + window.end_ns) // 2)
        twists.append(
            [
                odometry.add(cloud, window.start_ns, window.end_ns)
                for odometry, cloud in zip(odometries, window.clouds, strict=True)
            ]
        )
    # Of the last windows no motion is known.
    twists = twists[_REACH:] + twists[:_REACH]
    twist = np.array(twists).reshape(-1, len(names), 6).transpose(1, 0, 2)
    return poses_of_twists(twist, np.array(middle_ns, np.int64), names)


def poses_of_twists(twist: F64Array, middle_ns: I64Array, names: Sequence[str]) -> MotionPoses:
    """Poses of lidars whose motions (lidars, k, 6) from the middle of each window are known."""
    steps = tuple(int(known_rows(own).sum()) for own in twist)
    first = MotionPose(ORIGIN, np.zeros((6, 6)), np.zeros((6, 0)), (), "")
    others = (
        _pose(twist[0], own, middle_ns, (names[0], name))
        for own, name in zip(twist[1:], names[1:], strict=True)
    )
    return MotionPoses((first, *others), steps, middle_ns, twist)


def contradiction(motion: MotionPoses, poses: Sequence[Pose], names: Sequence[str]) -> str:
    """Why refined poses first_from_lidar are wrong, if the motion proves it, or "".

    Surfaces that look alike match in places that are wrong; what a lidar measures of its own motion
    does not depend on the others.
    """
    rows = zip(motion.poses[1:], poses[1:], names[1:], strict=True)
    for found, refined, name in rows:
        if found.refusal:
            continue
        shift_m = refined.position_m - found.first_from_lidar.position_m
        turn = np.matmul(refined.rotation, found.first_from_lidar.rotation.T)
        turn_rad = log_rotation(turn[None])[0]
        error = np.concatenate([shift_m, turn_rad])
        if float(np.dot(error, np.linalg.solve(found.covariance, error))) > _MOST_SQUARE:
            return (
                f"{name}: expected surfaces and motion that agree, found poses "
                f"{1000.0 * float(np.linalg.norm(shift_m)):.0f} mm and "
                f"{math.degrees(float(np.linalg.norm(turn_rad))):.2f} degrees apart, more than "
                f"their standard deviations explain; {_INSTEAD}"
            )
    return ""


class Odometry:
    """Motion of one lidar in its own frame, whichever way that is turned.

    Velocities change within a window, and lidars see their surfaces at different times of it. So
    the motion is measured twice: with a constant twist in each window, then with the points moved
    by the curve through the motions around it.
    """

    def __init__(self) -> None:
        self._rough = VelocityEstimator(_MAP_WINDOWS)
        self._fine = VelocityEstimator(_MAP_WINDOWS)
        self._upright: F64Array | None = None
        # Windows around the one that is measured next, and their motion from the one before.
        self._around: deque[_Measured] = deque(maxlen=2 * _REACH + 1)

    def add(self, cloud: Cloud, start_ns: int, end_ns: int) -> F64Array:
        """Twist (6,) to the window _REACH windows before, from the one before that one.

        Middle to middle, m and rad; NaN where it is unknown.
        """
        every = -(-len(cloud.time_s) // _MOST_POINTS) or 1
        points_m = np.asarray(cloud.points_m[::every], np.float64)
        if self._upright is None:
            self._upright = _upright(points_m)
        turn = np.eye(3) if self._upright is None else self._upright
        middle_ns, period_ns = (start_ns + end_ns) // 2, end_ns - start_ns
        upright = ColumnCloud.of_points(np.matmul(points_m, turn.T), cloud.time_s[::every])
        velocity = self._rough.add(upright, middle_ns, period_ns).velocity
        self._around.append(_Measured(upright, middle_ns, velocity))
        found = self._measure(period_ns)
        if found is None:
            return np.full(6, np.nan)
        return np.concatenate([np.matmul(part, turn) for part in found.reshape(2, 3)])

    def _measure(self, period_ns: int) -> F64Array | None:
        """Twist to the window in the middle of those around it."""
        if len(self._around) <= 2 * _REACH:
            return None
        window = self._around[_REACH]
        curve = self._curve()
        if curve is None:
            return None
        still = ColumnCloud(
            _moved_along(window.cloud, *curve), np.zeros_like(window.cloud.column), np.zeros(1)
        )
        velocity = self._fine.add(still, window.middle_ns, period_ns).velocity
        gap_s = (window.middle_ns - self._around[_REACH - 1].middle_ns) / NS_PER_S
        return None if velocity is None else velocity * gap_s

    def _curve(self) -> tuple[F64Array, F64Array] | None:
        """Times (n,) of windows from that in the middle, and twists (n, 6) to each.

        Of fewer windows where the motion of one is not known.
        """
        for reach in range(_REACH, 0, -1):
            around = list(self._around)[_REACH - reach : _REACH + reach + 1]
            middles = [window.middle_ns for window in around]
            poses = [ORIGIN]
            for window, gap_ns in zip(around[1:], np.diff(middles), strict=True):
                if window.velocity is None:
                    break
                poses.append(poses[-1].then(window.velocity * (gap_ns / NS_PER_S)))
            else:
                times_s = (np.array(middles) - middles[reach]) / NS_PER_S
                return times_s, np.array([poses[reach].twist_to(pose) for pose in poses])
        return None


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """A window; velocity: (6,), from the one before, m/s and rad/s."""

    cloud: ColumnCloud
    middle_ns: int
    velocity: F64Array | None


def _moved_along(cloud: ColumnCloud, times_s: F64Array, twists: F64Array) -> F64Array:
    """Points of a window at its middle, by the polynomial through twists (n, 6) at times (n,)."""
    powers = np.vander(times_s / times_s[-1], increasing=True)
    factors = np.linalg.solve(powers, twists)
    at = np.vander(cloud.time_s / times_s[-1], len(times_s), increasing=True)
    twist = np.matmul(at, factors)
    rotation, step = exp_transform(twist[:, :3], twist[:, 3:])
    moved: F64Array = rotated(rotation[cloud.column], cloud.points_m) + step[cloud.column]
    return moved


def _upright(points_m: F64Array) -> F64Array | None:
    """Rotation (3, 3) of the most frequent normal of surfaces onto the z axis, or None.

    Of a field or a forest that is the ground's, so that trunks are upright.
    """
    normal = planes(points_m, np.zeros(len(points_m)), _UP_EDGE_M).normal
    if len(normal) < _FEWEST_PLANES:
        return None
    is_parallel = np.abs(np.matmul(normal, normal.T)) > _UP_PARALLEL
    alike = normal[is_parallel[int(is_parallel.sum(axis=1).argmax())]]
    _, axes = np.linalg.eigh(np.matmul(alike.T, alike))
    x, y, z = axes[:, 2]
    # About the axis at right angles to both.
    size = math.hypot(x, y)
    if size < 1e-9:
        return np.eye(3)
    vector = np.array([y, -x, 0.0]) * (math.atan2(size, z) / size)
    turn: F64Array = exp_rotation(vector[None])[0]
    return turn


def _pose(
    first: F64Array, other: F64Array, middle_ns: I64Array, names: tuple[str, str]
) -> MotionPose:
    """Pose of a lidar by its twists (k, 6) and those of the first one."""
    known = known_rows(first) & known_rows(other)
    count = int(known.sum())
    if count < _LEAST_STEPS:
        alone = [int(known_rows(own).sum()) for own in (first, other)]
        return _refused(
            f"{names[1]}: expected {_LEAST_STEPS} windows with the motion of both {names[0]} and "
            f"{names[1]}, found {count} ({alone[0]} and {alone[1]} of {len(known)}); record "
            "longer, where the lidars see walls, cars or trunks around them"
        )
    step_s = float(np.median(np.diff(middle_ns))) / NS_PER_S
    sizes = np.sqrt((first[known] ** 2).mean(axis=0)) / step_s
    speed, turn = (float(np.sqrt((part**2).sum())) for part in (sizes[:3], sizes[3:]))
    if speed < _LEAST_SPEED and turn < _LEAST_TURN:
        return _refused(
            f"{names[1]}: expected a machine that moves, found {speed:.3f} m/s and "
            f"{math.degrees(turn):.2f} degrees/s; {_INSTEAD}"
        )
    found = hand_eye(Steps(first, other, np.zeros(len(first), np.int64)))
    shift, axis = _main_axis(first[known, :3]), _main_axis(first[known, 3:])
    turns = _weak(found.covariance[3:, 3:], _MOST_SIGMA_RAD)
    shifts = _weak(found.covariance[:3, :3], _MOST_SIGMA_M)
    words = [
        f"{names[1]}: turn about {_named(way, shift, 'the direction of travel')} known to "
        f"{math.degrees(sigma):.2g} degrees only; {_INSTEAD}"
        for way, sigma in _named_directions(turns)
    ] + [
        f"{names[1]}: shift along {_named(way, axis, 'the axis of its turns')} known to "
        f"{1000.0 * sigma:.2g} mm only; {_INSTEAD}"
        for way, sigma in _named_directions(shifts)
    ]
    late = turning(first[:, 3:], middle_ns, lidar_turns(other[:, 3:], middle_ns), names[1])
    words += _late(late, names)
    late_s = math.nan if late.late_undetermined else late.delay_s
    worst = max((sigma for _, sigma in turns), default=0.0)
    refusal = ""
    if worst > _MOST_START_RAD:
        refusal = words[len(_named_directions(turns)) - 1]
    elif not found.is_unique:
        refusal = f"{names[1]}: the motion fits poses whose axes lie far apart; {_INSTEAD}"
    weak = [np.concatenate([np.zeros(3), way]) for way, _ in turns]
    weak += [np.concatenate([way, np.zeros(3)]) for way, _ in shifts]
    return MotionPose(
        found.first_from_other,
        found.covariance,
        np.array(weak).reshape(-1, 6).T,
        tuple(words),
        refusal,
        late_s,
        late.delay_sigma_s,
    )


def _late(found: Turning, names: tuple[str, str]) -> list[str]:
    """That the clocks of two lidars differ, which the law of their motions presumes they do not."""
    late_s = found.delay_s
    if found.late_undetermined or abs(late_s) < max(_MOST_LATE_S, 5.0 * found.delay_sigma_s):
        return []
    return [
        f"{names[1]}: expected stamps of the clock of {names[0]}, found turns "
        f"{1000.0 * abs(late_s):.0f} ms {'after' if late_s > 0 else 'before'} those of {names[0]}; "
        "correct its offset_ns in the rig, or synchronise the clocks"
    ]


def _refused(reason: str) -> MotionPose:
    return MotionPose(ORIGIN, np.diag([np.inf] * 6), np.eye(6), (), reason)


def _weak(covariance: F64Array, most: float) -> list[tuple[F64Array, float]]:
    """Unit directions (3,) with their standard deviations above a limit, increasing."""
    variance, axes = np.linalg.eigh(covariance)
    return [
        (axis, math.sqrt(size))
        for axis, size in zip(axes.T, variance, strict=True)
        if size > most**2
    ]


def _named_directions(weak: list[tuple[F64Array, float]]) -> list[tuple[F64Array, float]]:
    """Directions to name: the worst if all are weak."""
    return weak[2:] if len(weak) > 2 else weak


def _main_axis(vectors: F64Array) -> F64Array:
    """Direction (3,) along which vectors (k, 3) are largest."""
    _, axes = np.linalg.eigh(np.matmul(vectors.T, vectors))
    axis: F64Array = axes[:, 2]
    return axis


def _named(way: F64Array, axis: F64Array, name: str) -> str:
    """A direction in the frame of the first lidar, by name if it lies along an axis."""
    x, y, z = way * (1.0 if way[int(np.abs(way).argmax())] > 0.0 else -1.0)
    place = f"({x:.2f}, {y:.2f}, {z:.2f}) in the frame of the first lidar"
    return f"{name}, {place}," if abs(float(np.dot(way, axis))) > _ALONG else f"{place},"
