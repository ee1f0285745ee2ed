"""The case study of the paper on simulated forests: one and two lidars, every N-th scan.

    python casestudy.py                      # `make casestudy`: everything
    python casestudy.py --seeds 1 --duration 40
    python casestudy.py --recordings drives  # write the recordings for other programs, run nothing

docs/does-it-help.md describes method, figures and results. Runs that are finished are kept.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import report
import yaml
from drift import Drift, aligned_poses, drift, on_reference
from evaluation import Array, Track, read_tum, write_tum
from inertial import SCAN_S, Cloud, Diverged, Imu, Odometry
from machine import IMU_IN_BODY_M, MACHINE_BOX
from ndt import Indices

import mlbatch
import mlbatch.simulate

SCENES = ("harvester-easy", "harvester-hard")
RATE_HZ = round(1.0 / SCAN_S)
# Only every N-th scan updates the algorithm; from which scan on, as replicates.
PHASES = {1: (0,), 5: (0, 2), 10: (0, 3, 6), 15: (0, 5, 10)}
LIDARS = ("left", "right", "both")
WINDOW = "window"
# From when on the machine, which stands for 2 s, is followed.
BEGIN_S = 1.6
MIN_RANGE_M = 0.8
# Part of the settings by which runs are kept: change it with the method.
METHOD = "5"


@dataclass(frozen=True, slots=True)
class Run:
    """Lidars of LIDARS, N, first scan; batching: of `mlbatch`."""

    lidars: str
    every: int
    phase: int
    batching: str = WINDOW

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.lidars}-{self.every}-{self.phase}-{self.batching}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a run led to; ended: why it ended early, or empty; unmatched: of its nodes."""

    drift: Drift | None
    ended: str
    nodes: int
    unmatched: int


RUNS = tuple(
    Run(lidars, every, phase)
    for lidars in LIDARS
    for every, phases in PHASES.items()
    for phase in phases
)
# The control that the paper lacks: sweeps of both lidars, joined by the nearest stamp.
CONTROLS = tuple(Run("both", every, 0, "approximate") for every in PHASES)


def main() -> None:
    """Run all that is missing, then print the tables."""
    options = _options()
    if options.recordings is not None:
        _write_recordings(options)
        return
    found: dict[tuple[str, int], dict[Run, Outcome]] = {}
    for seed in range(1, options.seeds + 1):
        for scene in options.scenes:
            found[scene, seed] = _scene(scene, seed, options)
    _write_csv(options.output / "casestudy.csv", found)
    lines = report.tables(found, options.scenes, LIDARS, tuple(PHASES))
    (options.output / "casestudy.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    report.draw(options.output / "casestudy.png", found, options.scenes, LIDARS, tuple(PHASES))
    print("\n".join(lines))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("build/casestudy"))
    parser.add_argument("--seeds", type=int, default=5, help="forests of each kind [5]")
    parser.add_argument("--duration", type=float, default=115.0, help="of each drive, s [115]")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--runs", nargs="+", metavar="NAME", help="some, as left-10-3-window")
    parser.add_argument("--lidar", default="OS0-64", help="model of both [OS0-64]")
    parser.add_argument("--columns", type=int, default=512, help="per revolution [512]")
    parser.add_argument("--recordings", type=Path, help="write recordings to a folder, run nothing")
    parser.add_argument("--evo", action="store_true", help="check each drift with evo")
    return parser.parse_args()


# -- a drive --------------------------------------------------------------------------------------


def _scene(scene: str, seed: int, options: argparse.Namespace) -> dict[Run, Outcome]:
    """Run everything on one drive."""
    folder: Path = options.output / f"{scene}-{seed:02d}"
    folder.mkdir(parents=True, exist_ok=True)
    settings = {
        "method": METHOD, "seed": seed, "duration_s": options.duration, "lidar": options.lidar,
        "columns": options.columns, "gtsam": version("gtsam"),
    }  # fmt: skip
    runs = [run for run in (*RUNS, *CONTROLS) if not options.runs or run.name in options.runs]
    kept = {run: _kept(folder / f"{run.name}.json", settings) for run in runs}
    missing = [run for run, outcome in kept.items() if outcome is None]
    if missing:
        recording = folder / "drive.pcap"
        _simulate(scene, seed, recording, options)
        truth = _moved_to_imu(read_tum(folder / "drive.truth.tum"))
        for batching in dict.fromkeys(run.batching for run in missing):
            own = [run for run in missing if run.batching == batching]
            for run, done, track in _odometry(recording, own, truth):
                kept[run] = done
                if track is not None:
                    write_tum(folder / f"{run.name}.tum", track)
                text = json.dumps({"settings": settings, "outcome": asdict(done)}, indent=1)
                (folder / f"{run.name}.json").write_text(text + "\n", encoding="utf-8")
                print(f"{folder.name}: {run.name}: {report.in_words(done)}", flush=True)
        # The largest file; it depends on scenario and seed only.
        recording.unlink()
    if options.evo:
        truth = _moved_to_imu(read_tum(folder / "drive.truth.tum"))
        for run, outcome in kept.items():
            if outcome is not None and outcome.drift is not None:
                _check_with_evo(folder, run, outcome.drift, truth)
    return {run: outcome for run, outcome in kept.items() if outcome is not None}


def _kept(path: Path, settings: dict[str, object]) -> Outcome | None:
    if not path.exists():
        return None
    kept = json.loads(path.read_text(encoding="utf-8"))
    if kept["settings"] != settings:
        return None
    values = kept["outcome"]
    values["drift"] = None if values["drift"] is None else Drift(**values["drift"])
    return Outcome(**values)


def _odometry(
    recording: Path, runs: Sequence[Run], truth: Track
) -> Iterator[tuple[Run, Outcome, Track | None]]:
    """Run all in lockstep, on one pass over the recording."""
    imu = _read_imu(recording.with_name("drive.imu.csv"))
    begin_s = float(truth.stamp_s[0]) + BEGIN_S
    odometries = {run: Odometry(imu, begin_s) for run in runs}
    tracks: dict[Run, list[tuple[float, Array]]] = {run: [] for run in runs}
    ended = dict.fromkeys(runs, "")
    for number, (cloud, lidar) in enumerate(_clouds(recording, runs[0].batching, begin_s)):
        for run, odometry in odometries.items():
            # The first scan makes the map, whatever the phase.
            if ended[run] or (number and number % run.every != run.phase % run.every):
                continue
            try:
                pose = odometry.add(_of_lidars(cloud, lidar, run.lidars))
            except Diverged as error:
                ended[run] = f"{cloud.end_s - begin_s:.1f} s: {error}"
            else:
                tracks[run].append((cloud.end_s, pose))
    for run, poses in tracks.items():
        # An alignment needs some poses.
        track = None
        if len(poses) > 3:
            track = Track(
                np.array([end for end, _ in poses]), np.array([pose for _, pose in poses])
            )
        found = None if track is None else drift(track, truth)
        yield run, Outcome(found, ended[run], len(poses), odometries[run].unmatched), track


def _clouds(recording: Path, batching: str, begin_s: float) -> Iterator[tuple[Cloud, Indices]]:
    """Yield scans without the machine, frame of the IMU, and the lidar of each point."""
    scans = mlbatch.scans(
        recording,
        rig=recording.with_name("drive.rig.yaml"),
        rate=RATE_HZ,
        min_range=MIN_RANGE_M,
        exclude_boxes=[MACHINE_BOX],
        batching=batching,
    )
    for scan in scans:
        # Fused sweeps end with their last column.
        end_ns = scan.end_ns if batching == WINDOW else int(scan.column_stamp_ns.max())
        end_s = end_ns / 1e9
        if end_s < begin_s + SCAN_S - 1e-6 or scan.column is None:
            continue
        points = scan.xyz.astype(np.float64) - IMU_IN_BODY_M
        column = scan.column.astype(np.int64)
        cloud = Cloud(end_s, points, column, scan.column_stamp_ns / 1e9)
        yield cloud, scan.lidar_id.astype(np.int64)


def _of_lidars(cloud: Cloud, lidar: Indices, lidars: str) -> Cloud:
    if lidars == "both":
        return cloud
    own = lidar == LIDARS.index(lidars)
    return Cloud(cloud.end_s, cloud.points[own], cloud.column[own], cloud.column_s)


def _moved_to_imu(track: Track) -> Track:
    poses = track.poses.copy()
    poses[:, :3, 3] += poses[:, :3, :3] @ np.array(IMU_IN_BODY_M)
    return Track(track.stamp_s, poses)


def _read_imu(path: Path) -> Imu:
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    return Imu(table[:, 0] / 1e9, table[:, 1:4], table[:, 4:7])


def _check_with_evo(folder: Path, run: Run, own: Drift, truth: Track) -> None:
    """Compare with the largest APE of evo, aligned on as many first poses, from files."""
    from evo.core import metrics
    from evo.tools import file_interface

    estimate, reference = on_reference(read_tum(folder / f"{run.name}.tum"), truth)
    for name, track in (("estimate", estimate), ("reference", reference)):
        write_tum(folder / f"evo-{name}.tum", track)
    read = file_interface.read_tum_trajectory_file
    moved, fixed = (read(str(folder / f"evo-{name}.tum")) for name in ("estimate", "reference"))
    moved.align(fixed, n=aligned_poses(reference))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((fixed, moved))
    largest_m = ape.get_statistic(metrics.StatisticsType.max)
    if abs(largest_m - own.six_m) > 1e-3:
        raise SystemExit(
            f"casestudy: {folder.name}: {run.name}: expected the drift of evo, {largest_m:.4f} m, "
            f"found {own.six_m:.4f} m"
        )
    print(f"{folder.name}: {run.name}: {own.six_m:.4f} m, by evo {largest_m:.4f} m")


# -- recordings -----------------------------------------------------------------------------------


def _simulate(scene: str, seed: int, recording: Path, options: argparse.Namespace) -> None:
    """Simulate a drive of the package's scenario, with the lidars of the options."""
    shipped = Path(mlbatch.simulate.__file__).parent / "scenarios" / f"{scene}.yaml"
    content = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    for sensor in content["sensors"]:
        sensor.update(model=options.lidar, columns=options.columns)
    scenario = recording.with_name("drive.yaml")
    scenario.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    words = ("--seed", seed, "--duration", options.duration, "--overwrite", "-q")
    command = [sys.executable, "-m", "mlbatch", "simulate", scenario, "-o", recording, *words]
    done = subprocess.run([str(word) for word in command], check=False)
    if done.returncode:
        raise SystemExit(f"casestudy: `mlbatch simulate` failed with exit code {done.returncode}")


def _write_recordings(options: argparse.Namespace) -> None:
    """Write MCAP recordings with rig, truth and IMU, and SHA256SUMS of all files."""
    sums = []
    for seed in range(1, options.seeds + 1):
        for scene in options.scenes:
            folder: Path = options.recordings / f"{scene}-{seed:02d}"
            folder.mkdir(parents=True, exist_ok=True)
            _simulate(scene, seed, folder / "drive.mcap", options)
            for path in sorted(folder.iterdir()):
                own = hashlib.sha256()
                with path.open("rb") as file:
                    while part := file.read(1 << 20):
                        own.update(part)
                sums.append(f"{own.hexdigest()}  {path.relative_to(options.recordings)}")
            print(f"wrote {folder}", flush=True)
    (options.recordings / "SHA256SUMS").write_text("\n".join(sums) + "\n", encoding="utf-8")


def _write_csv(path: Path, found: dict[tuple[str, int], dict[Run, Outcome]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        drift_keys = tuple(Drift.__dataclass_fields__)
        run_keys = tuple(Run.__dataclass_fields__)
        rows.writerow(["scene", "seed", *run_keys, *drift_keys, "ended", "nodes", "unmatched"])
        for (scene, seed), outcomes in found.items():
            for run, one in outcomes.items():
                drifts = [""] * len(drift_keys)
                if one.drift is not None:
                    drifts = [f"{value:.4f}" for value in asdict(one.drift).values()]
                own = asdict(run).values()
                rows.writerow([scene, seed, *own, *drifts, one.ended, one.nodes, one.unmatched])


if __name__ == "__main__":
    main()
