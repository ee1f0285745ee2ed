"""Errors of a trajectory against the truth, by evo, at the time offset that suits it best."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from evo.core import metrics
from evo.core.trajectory import PoseTrajectory3D
from evo.core.units import Unit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

Array: TypeAlias = NDArray[np.float64]
# Offsets that are tried, s: a scan lasts 0.1 s, joined sweeps nearly 0.2 s.
OFFSETS_S = np.arange(-150, 151, 5) / 1000.0
RELATIVE_OVER_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Poses (n, 4, 4) of the body at times (n,), s."""

    stamp_s: Array
    poses: Array


@dataclass(frozen=True, slots=True)
class Errors:
    """RMSE of relative errors over 1 s, and of positions after alignment.

    offset_s: from the given stamps to those at which the relative errors are least; at_stamp_*:
    relative errors at the given stamps.
    """

    rpe_m: float
    rpe_deg: float
    ape_m: float
    offset_s: float
    at_stamp_rpe_m: float
    at_stamp_rpe_deg: float


def read_tum(path: Path) -> Track:
    """Read a trajectory `time x y z qx qy qz qw` a line."""
    table = np.loadtxt(path, ndmin=2)
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, 3] = table[:, 1:4]
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:8]).as_matrix()
    return Track(table[:, 0], poses)


def write_tum(path: Path, track: Track) -> None:
    """Write a trajectory, times to the microsecond."""
    quaternions = Rotation.from_matrix(track.poses[:, :3, :3]).as_quat()
    table = np.column_stack([track.stamp_s, track.poses[:, :3, 3], quaternions])
    np.savetxt(path, table, fmt=["%.6f"] + ["%.9f"] * 7)


def at_times(track: Track, stamp_s: Array) -> Track:
    """Poses between those of a track: positions linear, rotations by slerp."""
    turn = Slerp(track.stamp_s, Rotation.from_matrix(track.poses[:, :3, :3]))
    poses = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    poses[:, :3, :3] = turn(stamp_s).as_matrix()
    for axis in range(3):
        poses[:, axis, 3] = np.interp(stamp_s, track.stamp_s, track.poses[:, axis, 3])
    return Track(stamp_s, poses)


def compare(estimate: Track, truth: Track, rate_hz: float) -> Errors:
    """Return the errors at the best offset; rate_hz: of the scans."""
    # The same poses for all offsets.
    margin = OFFSETS_S[-1]
    inside = (estimate.stamp_s >= truth.stamp_s[0] + margin) & (
        estimate.stamp_s <= truth.stamp_s[-1] - margin
    )
    if inside.sum() < 2 * rate_hz * RELATIVE_OVER_S:
        raise SystemExit(
            f"odometry: expected {2 * RELATIVE_OVER_S:g} s of poses within the ground truth, found "
            f"{inside.sum()} poses; check that its times are on the clock of the scans"
        )
    own = Track(estimate.stamp_s[inside], estimate.poses[inside])
    frames = max(1, round(rate_hz * RELATIVE_OVER_S))
    tried = [relative_errors(own, at_times(truth, own.stamp_s + by), frames) for by in OFFSETS_S]
    best = int(np.argmin([move * turn for move, turn in tried]))
    reference = _evo(at_times(truth, own.stamp_s + OFFSETS_S[best]))
    aligned = _evo(own)
    aligned.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    given = tried[int(np.argmin(np.abs(OFFSETS_S)))]
    return Errors(*tried[best], _rmse(ape), float(OFFSETS_S[best]), *given)


def relative_errors(own: Track, reference: Track, frames: int) -> tuple[float, float]:
    """Return the RMSE of relative errors over a number of poses: m, degrees."""
    relations = (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg)
    found = []
    for relation in relations:
        rpe = metrics.RPE(relation, float(frames), Unit.frames, all_pairs=True)
        rpe.process_data((_evo(reference), _evo(own)))
        found.append(_rmse(rpe))
    return found[0], found[1]


def _evo(track: Track) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(track.poses), timestamps=track.stamp_s)


def _rmse(metric: metrics.PE) -> float:
    return float(metric.get_statistic(metrics.StatisticsType.rmse))
