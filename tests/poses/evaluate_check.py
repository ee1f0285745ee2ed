"""How often the check of poses is right, on recordings with known poses; run by hand.

python -m tests.poses.evaluate_check FOLDER RUNS [NAME...]

FOLDER: simulated NAME.mcap with NAME.rig.yaml. Runs begin at other times, with faults in turn, each
with the true rig, which may give no warning `pose`, and with the second lidar 5 cm or 0.5 degrees
off in a random direction.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from mlbatch.discovery.discover import SensorSelection
from mlbatch.faults import parse_fault
from mlbatch.motion.se3 import exp_rotation
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.time_limits import limits_of
from mlbatch.reports.poses import PoseFigures

FAULTS = ("", "drop:*:5%", "reorder:*:3%", "dup:*:2%", "bitflip:*:1%", "truncate:*:1%")
STEP_S, RUN_S = 0.2, 1.8


def checked(recording: Path, rig: Path, start_s: float, fault: str, seed: int) -> PoseFigures:
    """The check of a part of a recording."""
    start, end, _ = limits_of("start", f"+{start_s:.1f}s", "end", f"+{start_s + RUN_S:.1f}s")
    job = Job((recording,), SensorSelection(rig=rig), start=start, end=end, fault_seed=seed)
    with contextlib.suppress(OSError):
        job = replace(job, faults=(parse_fault(fault),) if fault else ())
    run = Conversion(job)
    for _ in run.scans():
        pass
    return run.poses


def moved_rig(rig: Path, kind: str, rng: np.random.Generator) -> Path:
    """A rig whose second lidar is off; kind: shift or turn."""
    content = yaml.safe_load(rig.read_text())
    pose = content["sensors"][1]["extrinsics"]
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    if kind == "shift":
        pose["translation_m"] = [float(v) for v in pose["translation_m"] + 0.05 * axis]
    else:
        roll, pitch, yaw = np.deg2rad(pose["rotation_rpy_deg"])
        about = np.array([[0, 0, yaw], [0, pitch, 0], [roll, 0, 0]])
        turns = exp_rotation(np.vstack([np.deg2rad(0.5) * axis, about]))
        rotation = turns[0] @ turns[1] @ turns[2] @ turns[3]
        del pose["rotation_rpy_deg"]
        pose["matrix"] = np.block(
            [[rotation, np.array(pose.pop("translation_m"))[:, None]], [0, 0, 0, 1]]
        ).tolist()
    target = rig.with_name(f"{rig.name.split('.')[0]}.off.rig.yaml")
    target.write_text(yaml.safe_dump(content))
    return target


def main() -> None:
    """Print counts by scene."""
    folder, runs, names = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    rng = np.random.default_rng(1)
    for name in names or sorted(path.stem for path in folder.glob("*.mcap")):
        recording, rig = folder / f"{name}.mcap", folder / f"{name}.rig.yaml"
        counts: Counter[str] = Counter()
        for number in range(runs):
            start_s = STEP_S * (number % 20)
            for kind in ("true", "shift", "turn"):
                used = rig if kind == "true" else moved_rig(rig, kind, rng)
                fault = FAULTS[number % len(FAULTS)]
                pairs = checked(recording, used, start_s, fault, number).pairs
                is_wrong = any(pair.is_wrong for pair in pairs)
                counts[f"{kind} {'warned' if is_wrong else pairs[0].outcome}"] += 1
                if is_wrong == (kind == "true"):
                    print(name, number, kind, fault, start_s, [one.describe() for one in pairs])
        print(name, dict(sorted(counts.items())), flush=True)


if __name__ == "__main__":
    main()
