"""Errors of `calibrated` over simulated rigs, guesses and scenes; run by hand.

python -m tests.poses.evaluate FOLDER make [SCENE...]                   simulate, once
python -m tests.poses.evaluate FOLDER run GUESSES SHARE SEED SCENE...   print rows of the table

SCENE: a name, of all three rigs, or with the number of lidars, as room-3. SHARE: of the largest
error of a guess. Columns: guesses, determined, median mm and degrees, worst mm and degrees, share
within two standard deviations, CPU.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

import mlbatch
from mlbatch.arrays import F64Array
from mlbatch.errors import RecordingError
from mlbatch.frames.transforms import compose, from_rpy_deg
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.calibration import LidarPose, calibrated
from mlbatch.poses.places import KeptPlace, Places
from mlbatch.poses.solve import Cloud
from mlbatch.simulate.recording import write_recording
from mlbatch.simulate.scenario import read_scenario

SCENARIOS = Path(mlbatch.__file__).parent / "simulate" / "scenarios"
STANDSTILL_S, DURATION_S = 1.0, 4.0
# Largest error of a guess.
MOST_M, MOST_DEG = 1.0, 20.0
FARTHEST_M = 60.0
# First windows of places: one at standstill, one between each two of these in motion.
MOVING = np.array([11, 16, 21, 26, 31, 37])


def sensor(name: str, model: str, at: str, **more: object) -> dict[str, object]:
    """A row of a scenario; at: x y z (m) roll pitch yaw (degrees)."""
    six = [float(part) for part in at.split()]
    row: dict[str, object] = {"name": name, "model": model, "dropout": 0.01, **more}
    row["extrinsics"] = {"translation_m": six[:3], "rotation_rpy_deg": six[3:]}
    if model.startswith("OS"):
        row["profile"] = "RNG15_RFL8_NIR8"
    return row


def rigs(low: bool, range_m: float) -> list[list[dict[str, object]]]:
    """Rigs of 2, 3 and 4 lidars; low: on a trolley or car, else on a machine."""
    if low:
        two = [
            sensor("a", "OS1-64", "0.1 0.3 0.6 0 10 80"),
            sensor("b", "VLP-16", "0.2 -0.3 0.7 10 0 -80", phase_deg=133),
        ]
        three = [
            sensor("a", "Pandar64", "0.4 0.0 0.9 0 2 0"),
            sensor("b", "VLP-32C", "-0.4 0.3 0.7 -12 0 120", phase_deg=57),
            sensor("c", "Helios 32", "-0.4 -0.3 0.7 12 0 -120", phase_deg=211),
        ]
    else:
        two = [
            sensor("a", "OS0-64", "0.3 0.95 2.45 0 20 80"),
            sensor("b", "PandarXT-32", "0.3 -0.95 2.45 0 15 -80", phase_deg=133),
        ]
        three = [
            sensor("a", "OS0-64", "0.3 0.95 2.45 0 20 80"),
            sensor("b", "OS0-64", "0.3 -0.95 2.45 0 20 -80", phase_deg=133),
            sensor("c", "Helios 32", "-1.2 0 3.5 0 20 180", phase_deg=211),
        ]
    four = [
        sensor("a", "OS1-64", f"0.5 0.5 {0.7 if low else 2.4} 5 8 40"),
        sensor("b", "PandarXT-32", f"0.5 -0.5 {0.7 if low else 2.4} -5 8 -40", phase_deg=133),
        sensor("c", "RS-32", f"-0.5 0.5 {0.7 if low else 3.6} 5 12 140", phase_deg=57),
        sensor("d", "VLP-32C", f"-0.5 -0.5 {0.7 if low else 3.6} -5 12 -140", phase_deg=211),
    ]
    for row in (*two, *three, *four):
        row["max_range_m"] = range_m
    return [two, three, four]


CORRIDOR = {"boxes": [{"centre_m": [0, 0, 1.5], "size_m": [400, 3, 3]}]}
PLANE = {"rectangles": [{"corner_m": [-200, -200, 0], "along_m": [400, 0, 0],
                         "across_m": [0, 400, 0]}]}  # fmt: skip
# Ground and one wall: along the wall is not determined.
WALL = {
    "rectangles": [
        *PLANE["rectangles"],
        {"corner_m": [-200, 8, 0], "along_m": [400, 0, 0], "across_m": [0, 0, 5]},
    ]
}
# Each lidar in a room of its own, m.
APART_M = 20.0
APART = {"boxes": [{"centre_m": [0, APART_M * n, 2], "size_m": [12, 8, 4]} for n in range(4)]}
# Scenes that do not determine all.
DEGENERATE = {"corridor": CORRIDOR, "plane": PLANE, "wall": WALL, "apart": APART}
HARVESTER = "harvester-hard"
# Of the harvester with its boom, as --exclude-box leaves it out.
MACHINE = np.array([[-2.3, -1.15, 0.4], [6.5, 1.15, 4.5]])
SCENES = ("room", "street", "forest-easy", "forest-hard", HARVESTER)


def scenario(scene: str, rig: int) -> dict[str, object]:
    """The scenario of a scene with one of the rigs, as in its file."""
    if scene in DEGENERATE:
        found: dict[str, object] = {
            "schema": "mlbatch.scenario/1",
            "scene": DEGENERATE[scene],
            "motion": {"waypoints": [[0, 0, 0, 0.6, 0], [4, 3, 0, 0.6, 0], [60, 45, 0, 0.6, 0]]},
        }
    else:
        found = yaml.safe_load((SCENARIOS / f"{scene}.yaml").read_text())
    low = scene in ("room", "street", *DEGENERATE)
    sensors = rigs(low, 40.0 if scene == HARVESTER else 80.0)[rig]
    if scene == HARVESTER:
        for row in sensors:
            row["divergence_deg"] = 0.35
    for number, row in enumerate(sensors):
        x, y, z = row["extrinsics"]["translation_m"]  # type: ignore[index]
        away_m = APART_M * number if scene == "apart" else 0.0
        at = [x, y + away_m, z + (1.0 if scene == "street" else 0.0)]
        row["extrinsics"]["translation_m"] = at  # type: ignore[index]
    found["motion"]["standstill_s"] = STANDSTILL_S  # type: ignore[index]
    found |= {"sensors": sensors, "seed": 100 + rig, "duration_s": DURATION_S}
    found.pop("imu", None)
    return found


def make(folder: Path, scene: str, rig: int) -> None:
    """Simulate, convert with the true poses, and store the points of all windows."""
    target = folder / f"{scene}-{rig + 2}.npz"
    if target.exists():
        return
    work = folder / f"{scene}-{rig + 2}"
    work.mkdir(parents=True, exist_ok=True)
    (work / "scenario.yaml").write_text(yaml.safe_dump(scenario(scene, rig)))
    recording = work / "rec.mcap"
    write_recording(read_scenario(str(work / "scenario.yaml")), recording, overwrite=True)
    stored: dict[str, npt.NDArray[Any]] = {}
    windows = 0
    scans = mlbatch.scans(recording, rig=work / "rec.rig.yaml", min_range=1.5)
    for windows, scan in enumerate(scans, 1):
        for lidar in range(rig + 2):
            rows = np.flatnonzero(scan.lidar_id == lidar)
            near = (scan.xyz[rows].astype(np.float64) ** 2).sum(axis=1) < FARTHEST_M**2
            rows = rows[near]
            name = f"{windows - 1}_{lidar}"
            stored[f"xyz_{name}"] = scan.xyz[rows]
            time_ns = scan.start_ns + scan.time_ns[rows].astype(np.int64)
            stored[f"time_{name}"] = time_ns
        stored[f"window_{windows - 1}"] = np.array([scan.start_ns, scan.end_ns])
    stored["windows"] = np.array(windows)
    np.savez(target, allow_pickle=False, **stored)
    recording.unlink()
    print(target.name, windows, flush=True)


@dataclass(slots=True, eq=False)
class Case:
    """Places of a recording, converted with poses (4, 4) that are wrong; true: those that are."""

    places: Places
    poses: list[F64Array]
    true: list[F64Array]


def true_poses(folder: Path, scene: str, rig: int) -> list[F64Array]:
    """Poses (4, 4) body_from_sensor of the lidars."""
    read = yaml.safe_load((folder / f"{scene}-{rig + 2}" / "scenario.yaml").read_text())
    rows = [row["extrinsics"] for row in read["sensors"]]
    return [from_rpy_deg(row["translation_m"], row["rotation_rpy_deg"]) for row in rows]


def guess(folder: Path, scene: str, rig: int, share: float, seed: int) -> Case:
    """Some places and a guess of each pose but the first, off by up to the share of the most."""
    rng = np.random.default_rng(seed)
    begins = [int(rng.integers(1, 8)), *(int(n) for n in rng.integers(MOVING[:-1], MOVING[1:]))]
    rng = np.random.default_rng(1000 * rig + seed)
    true = true_poses(folder, scene, rig)
    wrong = [np.eye(4)]
    for _ in true[1:]:
        axis, way = rng.normal(size=(2, 3))
        axis *= np.deg2rad(MOST_DEG) * share * rng.uniform(0.3, 1) / np.linalg.norm(axis)
        way *= MOST_M * share * rng.uniform(0.3, 1) / np.linalg.norm(way)
        error = np.eye(4)
        error[:3, :3], error[:3, 3] = exp_rotation(axis[None])[0], way
        wrong.append(error)
    poses = [compose(error, pose) for error, pose in zip(wrong, true, strict=True)]
    box = MACHINE if scene == HARVESTER else np.zeros((2, 3))
    kept = []
    with np.load(folder / f"{scene}-{rig + 2}.npz") as stored:
        for begin in begins:
            start_ns, instant_ns = stored[f"window_{begin}"].tolist()
            clouds = []
            for at, lidar in product((begin, begin + 1), range(rig + 2)):
                points_m = stored[f"xyz_{at}_{lidar}"].astype(np.float64)
                outside = ((points_m < box[0]) | (points_m > box[1])).any(axis=1)
                points_m = points_m[outside] @ wrong[lidar][:3, :3].T + wrong[lidar][:3, 3]
                time_s = (stored[f"time_{at}_{lidar}"][outside] - instant_ns) * 1e-9
                clouds.append(Cloud(lidar, points_m, time_s, poses[lidar][:3, 3]))
            kept.append(KeptPlace(clouds, start_ns, np.zeros(0)))
    return Case(Places(kept, 2 * len(kept), [0] * len(true)), poses, true)


@dataclass(slots=True, eq=False)
class Tally:
    """Errors of poses that were found: mm, degrees, and whether each is within two deviations."""

    runs: int = 0
    determined: int = 0
    seconds: float = 0.0
    shift_mm: list[float] = field(default_factory=list)
    turn_deg: list[float] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)

    def add(self, lidar: LidarPose, true: F64Array) -> str:
        """Count a pose; its errors in words."""
        found = lidar.body_from_sensor
        shift_mm = 1000 * (found - true)[:3, 3]
        turn_deg = np.rad2deg(log_rotation((found[:3, :3] @ true[:3, :3].T)[None])[0])
        off = np.abs([*(shift_mm / lidar.sigma_mm), *(turn_deg / lidar.sigma_deg)])
        self.shift_mm.append(float(np.linalg.norm(shift_mm)))
        self.turn_deg.append(float(np.linalg.norm(turn_deg)))
        self.inside += (off <= 2).tolist()
        return f"{self.shift_mm[-1]:.1f} mm {self.turn_deg[-1]:.3f} deg {off.max():.1f} sd"

    def row(self, name: str) -> str:
        """A row of the table."""
        cells = ["-"] * 5
        if self.inside:
            errors = (self.shift_mm, self.turn_deg)
            middle, worst = [[float(f(part)) for part in errors] for f in (np.median, max)]
            cells = [f"{middle[0]:.1f}", f"{middle[1]:.3f}", f"{worst[0]:.1f}", f"{worst[1]:.3f}"]
            cells.append(f"{100 * np.mean(self.inside):.0f} %")
        each = f"{self.seconds / max(1, self.runs):.1f} s"
        return " | ".join(["", name, str(self.runs), str(self.determined), *cells, each, ""])


def run(folder: Path, scene: str, rig: int, seeds: range, share: float, tally: Tally) -> None:
    """Calibrate a recording from guesses; print the errors or the reason of each refusal."""
    names = "abcd"[: rig + 2]
    for seed in seeds:
        case = guess(folder, scene, rig, share, seed)
        began = time.process_time()
        try:
            found = calibrated(case.places, names, case.poses)
            tally.determined += 1
            pairs = zip(found.lidars[1:], case.true[1:], strict=True)
            words = ", ".join(tally.add(lidar, true) for lidar, true in pairs)
        except RecordingError as err:
            words = str(err)
        tally.runs += 1
        tally.seconds += time.process_time() - began
        print(f"  {scene}-{rig + 2} seed {seed}: {words}", flush=True)


def main(arguments: list[str]) -> None:
    """Simulate or run."""
    folder, what, *rest = arguments
    if what == "make":
        for scene in rest or [*SCENES, *DEGENERATE]:
            for rig in range(3):
                make(Path(folder), scene, rig)
    else:
        count, share, first, *scenes = rest
        seeds = range(int(first), int(first) + int(count))
        for name in scenes:
            scene, _, lidars = name.rpartition("-") if name[-1].isdigit() else (name, "", "")
            tally = Tally()
            for rig in [int(lidars) - 2] if lidars else range(3):
                run(Path(folder), scene, rig, seeds, float(share), tally)
            print(tally.row(name), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
