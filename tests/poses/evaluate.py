"""Errors of `find_poses` over simulated rigs, guesses and scenes; run by hand.

python -m tests.poses.evaluate FOLDER make [SCENE...]      simulate, once
python -m tests.poses.evaluate FOLDER run GUESSES [SCENE...]  print the table
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import yaml

import mlbatch
from mlbatch.arrays import F64Array
from mlbatch.motion.registration import Pose
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.solve import Cloud, Solution, find_poses
from mlbatch.simulate.recording import write_recording
from mlbatch.simulate.scenario import read_scenario

SCENARIOS = Path(mlbatch.__file__).parent / "simulate" / "scenarios"
STANDSTILL_S, DURATION_S = 1.0, 4.0
# Largest error of a guess.
MOST_M, MOST_DEG = 1.0, 20.0
# What is required: median, worst; mm, degrees.
FARTHEST_M = 60.0


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
# Scenes that do not determine all: unit directions of shift and turn (rad) that are not seen, of a
# lidar against the first, body frame along the world's.
DEGENERATE = {"corridor": CORRIDOR, "plane": PLANE, "wall": WALL}
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
    elif scene == "apart":
        found = yaml.safe_load((SCENARIOS / "room.yaml").read_text())
    else:
        found = yaml.safe_load((SCENARIOS / f"{scene}.yaml").read_text())
    low = scene in ("room", "street", "apart", *DEGENERATE)
    sensors = rigs(low, 40.0 if scene == HARVESTER else 80.0)[rig]
    if scene == HARVESTER:
        for row in sensors:
            row["divergence_deg"] = 0.35
    if scene == "street":
        for row in sensors:
            at = row["extrinsics"]["translation_m"]  # type: ignore[index]
            row["extrinsics"]["translation_m"] = [at[0], at[1], at[2] + 1.0]  # type: ignore[index]
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
    stored: dict[str, F64Array] = {}
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
    """Places of a recording, converted with a wrong rig; wrong: motions of the lidars' points."""

    places: list[list[Cloud]]
    wrong: list[Pose]


def origins(folder: Path, scene: str, rig: int) -> list[F64Array]:
    """Where the lidars are, m."""
    read = yaml.safe_load((folder / f"{scene}-{rig + 2}" / "scenario.yaml").read_text())
    return [np.array(row["extrinsics"]["translation_m"]) for row in read["sensors"]]


def places_of(folder: Path, scene: str, rig: int, numbers: list[int]) -> list[list[Cloud]]:
    """Places at the true poses: two windows from each of the numbers, without the machine."""
    box = MACHINE if scene == HARVESTER else np.zeros((2, 3))
    origin_m = origins(folder, scene, rig)
    with np.load(folder / f"{scene}-{rig + 2}.npz") as stored:
        found = []
        for number in numbers:
            instant_ns = int(stored[f"window_{number}"][1])
            clouds = []
            for at, lidar in product((number, number + 1), range(rig + 2)):
                points_m = stored[f"xyz_{at}_{lidar}"].astype(np.float64)
                kept = ((points_m < box[0]) | (points_m > box[1])).any(axis=1)
                time_s = (stored[f"time_{at}_{lidar}"] - instant_ns) * 1e-9
                clouds.append(Cloud(lidar, points_m[kept], time_s[kept], origin_m[lidar]))
            found.append(clouds)
        return found


def guesses(
    places: list[list[Cloud]], lidars: int, count: int, share: float, seed: int
) -> Iterator[Case]:
    """Cases with errors of each lidar but the first up to the share of the most."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        wrong = [Pose(np.eye(3), np.zeros(3))]
        for _ in range(lidars - 1):
            axis, way = rng.normal(size=(2, 3))
            axis *= np.deg2rad(MOST_DEG) * share * rng.uniform(0.3, 1) / np.linalg.norm(axis)
            way *= MOST_M * share * rng.uniform(0.3, 1) / np.linalg.norm(way)
            wrong.append(Pose(exp_rotation(axis[None])[0], way))
        yield Case(
            [
                [
                    Cloud(
                        cloud.lidar,
                        _moved(cloud.points_m, wrong[cloud.lidar]),
                        cloud.time_s,
                        None
                        if cloud.origin_m is None
                        else _moved(cloud.origin_m, wrong[cloud.lidar]),
                    )
                    for cloud in place
                ]
                for place in places
            ],
            wrong,
        )


def _moved(points_m: F64Array, pose: Pose) -> F64Array:
    found: F64Array = np.matmul(points_m, pose.rotation.T) + pose.position_m
    return found


def errors(case: Case, solution: Solution) -> F64Array:
    """Error of each lidar but the first: (lidars - 1, 6), m and rad, as a left motion."""
    found = []
    for wrong, correction in zip(case.wrong[1:], solution.state.corrections[1:], strict=True):
        turn = np.matmul(correction.rotation, wrong.rotation)
        shift = np.matmul(correction.rotation, wrong.position_m) + correction.position_m
        found.append(np.concatenate([shift, log_rotation(turn[None])[0]]))
    return np.array(found)


def run(folder: Path, scene: str, rig: int, count: int, share: float, first: int) -> None:
    """Print the errors of a recording, over guesses and choices of places."""
    lidars = rig + 2
    shift, turn, inside, weak, seconds = [], [], [], [], 0.0
    for seed in range(first, first + count):
        rng = np.random.default_rng(seed)
        numbers = [
            int(rng.integers(1, 8)),
            *(int(n) for n in rng.integers([12, 19, 26], [19, 26, 37])),
        ]
        places = places_of(folder, scene, rig, numbers)
        for case in guesses(places, lidars, 1, share, 1000 * rig + seed):
            began = time.process_time()
            solution = find_poses(case.places, lidars)
            seconds += time.process_time() - began
            error = errors(case, solution)
            free = solution.weak.shape[1]
            weak.append(free)
            sigma = np.sqrt(np.diag(solution.covariance)).reshape(-1, 6)
            print(
                f"  {scene}-{lidars} seed {seed} at {numbers} weak {free} rms {solution.rms:.2f}",
                f"{'' if solution.converged else 'not converged '}mm",
                np.round(1e3 * np.linalg.norm(error[:, :3], axis=1), 1),
                "deg",
                np.round(np.rad2deg(np.linalg.norm(error[:, 3:], axis=1)), 3),
                "z",
                np.round(np.abs(error / sigma).max(axis=1), 1),
                flush=True,
            )
            if free:
                continue
            shift += list(1e3 * np.linalg.norm(error[:, :3], axis=1))
            turn += list(np.rad2deg(np.linalg.norm(error[:, 3:], axis=1)))
            inside += list((np.abs(error) <= 2 * sigma).ravel())
    if shift:
        print(
            f"{scene}-{lidars}: {count} guesses, {sum(1 for w in weak if not w)} determined, "
            f"mm {np.median(shift):.2f} {max(shift):.2f}, "
            f"deg {np.median(turn):.4f} {max(turn):.4f}, "
            f"2 sigma {100 * np.mean(inside):.0f} %, {seconds / count:.1f} s"
        )
    else:
        print(f"{scene}-{lidars}: none of {count} determined, {seconds / count:.1f} s")


def main(arguments: list[str]) -> None:
    """Simulate or run."""
    folder, what, *rest = arguments
    if what == "make":
        for scene in rest or [*SCENES, *DEGENERATE, "apart"]:
            for rig in range(3):
                make(Path(folder), scene, rig)
    else:
        count, share, first, *scenes = rest
        for name in scenes:
            scene, _, lidars = name.rpartition("-")
            run(Path(folder), scene, int(lidars) - 2, int(count), float(share), int(first))


if __name__ == "__main__":
    main(sys.argv[1:])
