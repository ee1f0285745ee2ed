"""Lidar-inertial odometry on batches of one and two lidars, in N slices per window, in two forests.

    python casestudy.py --seeds 3            # `make casestudy`

docs/does-it-help.md describes method, figures and results. Cells that are finished are kept.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import yaml
from evaluation import Array, Track, at_times, read_tum, relative_errors
from inertial import Cloud, Imu, Odometry
from results import median_interval, statement

import mlbatch.simulate

SCENARIOS = ("forest-easy", "forest-hard")
SLICES = (1, 5, 10, 15)
LIDARS = ("one", "two")
RATE_HZ = 10
# Both scenarios: standstill, and where their IMU is in the body frame (without rotation).
STANDSTILL_S = 2.0
IMU_IN_BODY_M = np.array([0.0, 0.0, 1.2])
BEGIN_S = 1.6
# The machine, m, body frame: chassis and cabin, which both lidars see, and what is removed.
MACHINE = (
    {"centre_m": [0.0, 0.0, 0.95], "size_m": [4.4, 2.1, 0.9]},
    {"centre_m": [-0.4, 0.0, 1.85], "size_m": [1.8, 1.5, 0.9]},
)
EGO_BOX = "-2.5,-1.2,0.4,2.5,1.2,3.2"
# Constant, as of a small unit that was not calibrated: rad/s and m/s2.
IMU_BIAS = {"gyro_bias": [0.01, -0.006, 0.004], "accel_bias": [0.06, -0.04, 0.05]}
# Part of the settings by which cells are kept: change it with the method.
METHOD = "3"


@dataclass(frozen=True, slots=True)
class Cell:
    """A run: lidars of LIDARS; with_truth: the floor."""

    scenario: str
    lidars: str
    slices: int
    with_truth: bool

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.lidars}-{self.slices}-{'floor' if self.with_truth else 'odometry'}"


@dataclass(frozen=True, slots=True)
class Drift:
    """RMSE of relative errors over 1 s; end: position error in % of the path.

    nodes: of the graph; unmatched: of these, by the IMU alone.
    """

    rpe_m: float
    rpe_deg: float
    end_percent: float
    path_m: float
    cpu_s: float
    nodes: int
    unmatched: int


def main() -> None:
    """Run all cells that are missing, then print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("build/casestudy"))
    parser.add_argument("--seeds", type=int, default=3, help="forests of each kind [3]")
    parser.add_argument("--duration", type=float, default=10.0, help="with 2 s at rest, s [10]")
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    parser.add_argument("--slices", nargs="+", type=int, default=SLICES, help="[1 5 10 15]")
    options = parser.parse_args()
    found: dict[Cell, dict[int, Drift]] = {}
    for seed in range(1, options.seeds + 1):
        for scenario in options.scenarios:
            for cell, drift in _world(scenario, seed, options):
                found.setdefault(cell, {})[seed] = drift
    _write_csv(options.output / "casestudy.csv", found)
    lines = _tables(found, options)
    (options.output / "casestudy.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))


# -- cells ----------------------------------------------------------------------------------------


def _world(scenario: str, seed: int, options: argparse.Namespace) -> Iterator[tuple[Cell, Drift]]:
    """Yield the cells of one forest."""
    folder = options.output / f"{scenario}-{seed:02d}"
    folder.mkdir(parents=True, exist_ok=True)
    settings = {
        "method": METHOD,
        "scenario": scenario,
        "seed": seed,
        "duration_s": options.duration,
        "gtsam": version("gtsam"),
    }
    recording = folder / "drive.pcap"
    for slices in options.slices:
        scans = folder / f"scans-{slices}"
        for lidars in LIDARS:
            for with_truth in (False, True):
                cell = Cell(scenario, lidars, slices, with_truth)
                path = folder / f"{cell.name}.json"
                drift = _kept(path, settings)
                if drift is None:
                    if not recording.exists():
                        _simulate(scenario, seed, options.duration, recording)
                    if not scans.exists():
                        _convert(recording, scans, slices)
                    drift = _run(cell, folder, scans)
                    kept = {"settings": settings, "drift": asdict(drift)}
                    path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
                    print(f"{folder.name}: {cell.name}: {drift}", flush=True)
                yield cell, drift
        shutil.rmtree(scans, ignore_errors=True)
    recording.unlink(missing_ok=True)


def _kept(path: Path, settings: dict[str, object]) -> Drift | None:
    if not path.exists():
        return None
    kept = json.loads(path.read_text(encoding="utf-8"))
    return Drift(**kept["drift"]) if kept["settings"] == settings else None


def _simulate(scenario: str, seed: int, duration_s: float, recording: Path) -> None:
    """Simulate a forest of the package, with a machine that lidars see and a biased IMU."""
    shipped = Path(mlbatch.simulate.__file__).parent / "scenarios" / f"{scenario}.yaml"
    content = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    content["body"] = list(MACHINE)
    content["imu"].update(IMU_BIAS)
    place = recording.with_name("drive.yaml")
    place.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    words = ("--seed", seed, "--duration", duration_s, "--overwrite")
    _mlbatch("simulate", place, "-o", recording, "-q", *words)


def _convert(recording: Path, scans: Path, slices: int) -> None:
    rig = recording.with_name("drive.rig.yaml")
    words = ("--rate", RATE_HZ, "--slices", slices, "--exclude-box", EGO_BOX, "--min-range", 1)
    partial = scans.with_name("converting")
    _mlbatch("convert", recording, "--rig", rig, "-o", partial, *words, "--overwrite", "-q")
    partial.rename(scans)


def _mlbatch(*words: object) -> None:
    done = subprocess.run([sys.executable, "-m", "mlbatch", *map(str, words)], check=False)
    if done.returncode:
        raise SystemExit(f"casestudy: `mlbatch {words[0]}` failed with exit code {done.returncode}")


def _run(cell: Cell, folder: Path, scans: Path) -> Drift:
    begin = time.process_time()
    truth = _moved_to_imu(read_tum(folder / "drive.truth.tum"))
    imu = _read_imu(folder / "drive.imu.csv")
    start_s = float(truth.stamp_s[0])
    clouds = [one for one in _clouds(scans, cell) if one[0] >= start_s + BEGIN_S - 1e-9]
    odometry = Odometry(imu, clouds[0][0], truth if cell.with_truth else None)
    poses = [odometry.add(cloud) for _, cloud in clouds]
    track = Track(np.array([cloud.end_s for _, cloud in clouds]), np.array(poses))
    move, turn, end, path_m = _drift(track, truth, start_s)
    cpu_s = time.process_time() - begin
    return Drift(move, turn, end, path_m, cpu_s, len(poses), odometry.unmatched)


def _clouds(scans: Path, cell: Cell) -> Iterator[tuple[float, Cloud]]:
    """Yield start and cloud of each slice, in the frame of the IMU."""
    names = [tuple(map(int, path.stem.split("-"))) for path in scans.glob("[0-9]*.npz")]
    for name in sorted(names):
        file = "-".join([f"{name[0]:06d}", *map(str, name[1:])]) + ".npz"
        with np.load(scans / file) as scan:
            kept = scan["lidar_id"] == 0 if cell.lidars == "one" else slice(None)
            cloud = Cloud(
                int(scan["end_ns"]) / 1e9,
                scan["xyz"][kept].astype(np.float64) - IMU_IN_BODY_M,
                scan["column"][kept].astype(np.int64),
                scan["column_stamp_ns"] / 1e9,
            )
            start_s = int(scan["start_ns"]) / 1e9
        yield start_s, cloud


def _moved_to_imu(track: Track) -> Track:
    poses = track.poses.copy()
    poses[:, :3, 3] += poses[:, :3, :3] @ IMU_IN_BODY_M
    return Track(track.stamp_s, poses)


def _read_imu(path: Path) -> Imu:
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    return Imu(table[:, 0] / 1e9, table[:, 1:4], table[:, 4:7])


def _drift(track: Track, truth: Track, start_s: float) -> tuple[float, float, float, float]:
    """Errors at the ends of whole windows, so at the same times for every N, since the rest."""
    whole = np.abs(track.stamp_s * RATE_HZ - np.round(track.stamp_s * RATE_HZ)) < 1e-4
    whole &= (track.stamp_s >= start_s + STANDSTILL_S) & (track.stamp_s <= truth.stamp_s[-1])
    own = Track(track.stamp_s[whole], track.poses[whole])
    reference = at_times(truth, own.stamp_s)
    move, turn = relative_errors(own, reference, RATE_HZ)
    path_m = float(np.sqrt((np.diff(reference.poses[:, :3, 3], axis=0) ** 2).sum(axis=1)).sum())
    error = np.linalg.inv(_whole_move(reference)) @ _whole_move(own)
    end = 100.0 * float(np.sqrt((error[:3, 3] ** 2).sum())) / path_m
    return move, turn, end, path_m


def _whole_move(track: Track) -> Array:
    moved: Array = np.linalg.inv(track.poses[0]) @ track.poses[-1]
    return moved


# -- tables ---------------------------------------------------------------------------------------


def _write_csv(path: Path, found: dict[Cell, dict[int, Drift]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["scenario", "lidars", "slices", "run", "seed", *Drift.__dataclass_fields__])
        for cell, seeds in found.items():
            run = "floor" if cell.with_truth else "odometry"
            for seed, drift in seeds.items():
                values = [f"{value:.6g}" for value in asdict(drift).values()]
                rows.writerow([cell.scenario, cell.lidars, cell.slices, run, seed, *values])


def _tables(found: dict[Cell, dict[int, Drift]], options: argparse.Namespace) -> list[str]:
    lines = [
        statement([options.seeds]),
        "",
        "| forest | lidars | N | RPE, mm | its floor, mm | RPE, degrees | its floor, degrees "
        "| end drift, % | its floor, % |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for scenario in options.scenarios:
        for lidars in LIDARS:
            for slices in options.slices:
                own = found[Cell(scenario, lidars, slices, False)]
                floor = found[Cell(scenario, lidars, slices, True)]
                cells = [scenario.removeprefix("forest-"), lidars, str(slices)]
                for key, scale, digits in (
                    ("rpe_m", 1000.0, 1),
                    ("rpe_deg", 1.0, 3),
                    ("end_percent", 1.0, 2),
                ):
                    cells += [_cell(run, key, scale, digits) for run in (own, floor)]
                lines.append(f"| {' | '.join(cells)} |")
    runs = [drift for seeds in found.values() for drift in seeds.values()]
    alone = max(runs, key=lambda one: (one.unmatched - 1) / one.nodes)
    lines += [
        "",
        "Nodes by the IMU alone, after the first (its map is empty): in no run more than "
        f"{alone.unmatched - 1} of {alone.nodes}.",
    ]
    lines += ["", *_ratios(found, options, "rpe_m", "relative position error")]
    lines += ["", *_ratios(found, options, "end_percent", "end drift")]
    return lines


def _ratios(
    found: dict[Cell, dict[int, Drift]], options: argparse.Namespace, key: str, title: str
) -> list[str]:
    """Two lidars against one, and N slices against whole windows, by seed."""
    lines = [
        f"| forest | N | {title}, two lidars / one | smaller in | two lidars, N / 1 | one lidar, "
        "N / 1 |",
        "|---|---|---|---|---|---|",
    ]
    first = options.slices[0]
    for scenario in options.scenarios:
        for slices in options.slices:
            one, two = (found[Cell(scenario, lidars, slices, False)] for lidars in LIDARS)
            wholes = [found[Cell(scenario, lidars, first, False)] for lidars in LIDARS]
            ratios = _by_seed(two, one, key)
            cells = [scenario.removeprefix("forest-"), str(slices), _interval(ratios, 2)]
            cells.append(f"{sum(ratio < 1.0 for ratio in ratios)} of {len(ratios)}")
            for own, whole in ((two, wholes[1]), (one, wholes[0])):
                cells.append("1" if slices == first else _interval(_by_seed(own, whole, key), 2))
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def _by_seed(above: dict[int, Drift], below: dict[int, Drift], key: str) -> list[float]:
    return [getattr(above[seed], key) / getattr(below[seed], key) for seed in above]


def _cell(runs: dict[int, Drift], key: str, scale: float, digits: int) -> str:
    return _interval([scale * getattr(one, key) for one in runs.values()], digits)


def _interval(values: list[float], digits: int) -> str:
    median, low, high, _ = median_interval(values)
    if len(values) == 1:
        return f"{median:.{digits}f}"
    return f"{median:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


if __name__ == "__main__":
    main()
