"""Errors of `poses_from_motion` over simulated recordings and mountings; run by hand.

python -m tests.poses.evaluate_motion MOUNTINGS REC.mcap...   with REC.rig.yaml next to each

Points are turned into sensor frames of any mounting: the first one as it is, the others at random.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import mlbatch
from mlbatch.arrays import F64Array
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.from_motion import (
    MotionPose,
    MotionWindow,
    poses_from_motion,
)
from mlbatch.poses.solve import Cloud
from mlbatch.rig.rig import read_rig

# What is required of a pose that is not refused, mm and degrees.
MOST_MM, MOST_DEG = 20.0, 0.1


def windows_of(
    recording: Path, turns: list[F64Array], poses: list[F64Array]
) -> Iterator[MotionWindow]:
    """Windows of a recording, each lidar in its sensor frame, turned; poses: (4, 4), filled."""
    rig = recording.with_suffix(".rig.yaml")
    for scan in mlbatch.scans(
        recording, rig=rig, min_range=1.5, max_range=60.0, no_pose_check=True
    ):
        if not poses:
            poses.extend(_poses(scan, turns))
        middle_ns = (scan.end_ns - scan.start_ns) // 2
        time_s = (scan.time_ns.astype(np.int64) - middle_ns) / 1e9
        clouds = []
        for lidar, pose in enumerate(poses):
            rows = scan.lidar_id == lidar
            off_m = scan.xyz[rows].astype(np.float64) - pose[:3, 3]
            clouds.append(Cloud(lidar, off_m @ pose[:3, :3], time_s[rows]))
        yield MotionWindow(scan.start_ns, scan.end_ns, clouds)


def _poses(scan: mlbatch.Scan, turns: list[F64Array]) -> Iterator[F64Array]:
    for sensor, turn in zip(scan.info.sensors, turns, strict=True):
        pose = np.array(sensor.body_from_sensor, np.float64)
        pose[:3, :3] = pose[:3, :3] @ turn
        yield pose


def line(found: MotionPose, true: F64Array) -> str:
    """Errors of a pose, its standard deviations, and what it says."""
    pose = found.first_from_lidar
    shift_mm = 1000.0 * (pose.position_m - true[:3, 3])
    turn_deg = np.degrees(log_rotation((pose.rotation @ true[:3, :3].T)[None])[0])
    sigma = found.sigma
    states = "refused" if found.refusal else "start" if found.undetermined else "pose"
    size_mm, size_deg = np.linalg.norm(shift_mm), np.linalg.norm(turn_deg)
    is_false = states == "pose" and (size_mm > MOST_MM or size_deg > MOST_DEG)
    sigma_mm, sigma_deg = 1000.0 * np.linalg.norm(sigma[:3]), np.degrees(np.linalg.norm(sigma[3:]))
    return (
        f"{states:8}{size_mm:8.1f} mm {size_deg:7.3f} deg"
        f"   sd {sigma_mm:.1f} mm {sigma_deg:.3f} deg{'  FALSE' if is_false else ''}"
    )


def main() -> None:
    """Print a line for each recording, mounting and lidar."""
    mountings, *recordings = sys.argv[1:]
    for recording in map(Path, recordings):
        names = [sensor.name for sensor in read_rig(recording.with_suffix(".rig.yaml")).sensors]
        for seed in range(int(mountings)):
            draw = np.random.default_rng(seed).normal(size=(len(names), 3)) * (2.0 if seed else 0.0)
            poses: list[F64Array] = []
            begin_s = time.process_time()
            found = poses_from_motion(windows_of(recording, list(exp_rotation(draw)), poses), names)
            used_s = time.process_time() - begin_s
            for name, one, pose in zip(names[1:], found.poses[1:], poses[1:], strict=True):
                true = np.linalg.inv(poses[0]) @ pose
                print(
                    f"{recording.stem:20} {seed} {name:8}{line(one, true)}  "
                    f"{len(found.middle_ns)} windows {used_s:.0f} s CPU",
                    flush=True,
                )
                for words in (*one.undetermined, one.refusal):
                    if words:
                        print(f"    {words}")


if __name__ == "__main__":
    main()
