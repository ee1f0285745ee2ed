"""Run KISS-ICP, unmodified, on scans that are batched in different ways, and compare the results.

    python odometry.py --seeds 8                      # simulated rigs: `make odometry`
    python odometry.py drive.pcap --rig rig.yaml --truth truth.tum -o compared

docs/does-it-help.md describes inputs, results and figures.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import kiss_icp
import numpy as np
import results
import world
from evaluation import Errors, Track, compare, read_tum, write_tum
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP

HERE = Path(__file__).resolve().parent
RATE_HZ = 10
BASE = "windows"


@dataclass(frozen=True, slots=True)
class Variant:
    """A way to batch: options of `mlbatch convert`; slices: scans a window.

    simulated: also run on simulated rigs by default.
    """

    name: str
    options: tuple[str, ...] = ()
    slices: int = 1
    one_lidar: bool = False
    simulated: bool = True


def _joined(policy: str, times: str, name: str, simulated: bool) -> Variant:
    options = ("--batching", policy, "--batching-times", times)
    return Variant(name, options, simulated=simulated)


VARIANTS = (
    Variant(BASE),
    _joined("approximate", "own", "approximate time, times as they come", True),
    _joined("approximate", "common", "approximate time, times corrected", True),
    # With rotors that are 37 ms apart their sets are those of approximate time.
    _joined("latest", "own", "latest sweeps, times as they come", False),
    _joined("latest", "common", "latest sweeps, times corrected", False),
    Variant("one lidar, windows", one_lidar=True),
    Variant("2 slices per window", ("--slices", "2"), slices=2),
)


@dataclass(frozen=True, slots=True)
class Recording:
    """What is compared: packets, rig, and ground truth if there is one."""

    packets: tuple[str, ...]
    rig: Path | None
    truth: Track | None


def main() -> None:
    """Compare variants on simulated rigs, or on one recording."""
    options = _options()
    names = options.variants or [
        one.name for one in VARIANTS if one.simulated or options.recordings
    ]
    chosen = [one for one in VARIANTS if one.name in (BASE, *names)]
    options.output.mkdir(parents=True, exist_ok=True)
    if options.recordings:
        truth = read_tum(options.truth) if options.truth else None
        recording = Recording(tuple(options.recordings), options.rig, truth)
        found, tracks = _compared(recording, chosen, options.output, {})
        per_seed = {name: {0: errors} for name, errors in found.items()}
    else:
        per_seed = {one.name: {} for one in chosen}
        for seed in range(options.first_seed, options.first_seed + options.seeds):
            errors_of, own, own_truth = _simulated(seed, chosen, options)
            for name, errors in errors_of.items():
                per_seed[name][seed] = errors
            if seed == options.first_seed:
                tracks, truth = own, own_truth
    picture = options.output / "odometry.png"
    if truth is None:
        print(f"no ground truth: trajectories in {options.output}/*.tum, nothing is evaluated")
        return
    results.write_csv(options.output / "odometry.csv", per_seed)
    lines = results.table_lines(per_seed, BASE)
    (options.output / "odometry.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    results.draw(picture, per_seed, BASE, tracks, truth)
    print("\n".join(["", *lines, "", f"wrote odometry.csv, .md and .png in {options.output}"]))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recordings", nargs="*", help="of your own; none: simulated rigs")
    parser.add_argument("--rig", type=Path, help="rig file of the recordings")
    parser.add_argument("--truth", type=Path, help="trajectory of the body frame, TUM format")
    parser.add_argument("-o", "--output", type=Path, default=Path("build/odometry"))
    parser.add_argument("--seeds", type=int, default=8, help="simulated rigs [8]")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=9.0, help="of each, s [9]")
    names = ", ".join(f"'{one.name}'" for one in VARIANTS)
    parser.add_argument("--variants", nargs="+", metavar="NAME", help=f"[all] of {names}")
    found = parser.parse_args()
    unknown = set(found.variants or ()) - {one.name for one in VARIANTS}
    if unknown:
        parser.error(f"expected variants of {names}, found {', '.join(sorted(unknown))}")
    return found


# -- one recording --------------------------------------------------------------------------------


def _simulated(
    seed: int, chosen: list[Variant], options: argparse.Namespace
) -> tuple[dict[str, Errors], dict[str, Track], Track]:
    """Simulate a rig and compare variants; what an earlier run has finished is read."""
    folder = options.output / f"seed-{seed:02d}"
    folder.mkdir(parents=True, exist_ok=True)
    settings = {"world": world.WORLD, "seed": seed, "duration_s": options.duration}
    truth_file = folder / "drive.truth.tum"
    recording = folder / "drive.pcap"
    if not truth_file.exists() or any(not _kept(folder, one, settings) for one in chosen):
        world.write_scenario(folder / "drive.yaml", seed, options.duration)
        _mlbatch("simulate", folder / "drive.yaml", "-o", recording, "--overwrite", "-q")
    given = Recording((str(recording),), folder / "drive.rig.yaml", read_tum(truth_file))
    found, tracks = _compared(given, chosen, folder, settings)
    # The largest file; it depends on the scenario and the seed only.
    recording.unlink(missing_ok=True)
    assert given.truth is not None
    return found, tracks, given.truth


def _compared(
    recording: Recording, chosen: list[Variant], folder: Path, settings: dict[str, object]
) -> tuple[dict[str, Errors], dict[str, Track]]:
    """Run all variants; settings: those by which results of simulations are kept."""
    found: dict[str, Errors] = {}
    tracks: dict[str, Track] = {}
    for variant in chosen:
        errors = _kept(folder, variant, settings) if settings else None
        track_file = folder / f"{_file_name(variant)}.tum"
        if errors is None:
            track, cpu_note = _odometry(recording, variant, folder)
            write_tum(track_file, track)
            print(f"{folder.name}: {variant.name}: {cpu_note}", flush=True)
            if recording.truth is not None:
                errors = compare(track, recording.truth, RATE_HZ * variant.slices)
                _keep(folder, variant, settings, errors)
        if errors is not None:
            found[variant.name] = errors
        tracks[variant.name] = read_tum(track_file)
    return found, tracks


def _odometry(recording: Recording, variant: Variant, folder: Path) -> tuple[Track, str]:
    """Convert, and run KISS-ICP on the scans; its poses are those at the end of each scan."""
    scans = folder / "scans"
    rig = ("--rig", recording.rig) if recording.rig else ()
    only: tuple[str, ...] = ()
    if variant.one_lidar:
        only = ("--only", _first_lidar(recording))
    _mlbatch(
        *("convert", *recording.packets, *rig, "-o", scans, "--rate", RATE_HZ, "--format", "npz"),
        *(*variant.options, *only, "--overwrite", "--no-fsync", "-q"),
    )
    # Unmodified, all settings as installed; one thread, so that sums are in the same order.
    config = load_config(None)
    config.registration.max_num_threads = 1
    odometry = KissICP(config)
    stamps, poses = [], []
    empty = 0
    for path in sorted(scans.glob("[0-9]*.npz"), key=_scan_order):
        with np.load(path) as scan:
            xyz, time_ns = scan["xyz"].astype(np.float64), scan["time_ns"].astype(np.float64)
            start_ns = int(scan["start_ns"])
        if len(xyz) == 0:
            empty += 1
            continue
        # KISS-ICP maps the first time to 0 and the last to 1 itself, and moves points to the last.
        odometry.register_frame(xyz, time_ns / 1e9)
        stamps.append((start_ns + int(time_ns.max())) / 1e9)
        poses.append(odometry.last_pose)
    shutil.rmtree(scans)
    note = f"{len(poses)} scans" + (f", {empty} without points left out" if empty else "")
    return Track(np.array(stamps), np.array(poses)), note


def _scan_order(path: Path) -> tuple[int, ...]:
    """Numbers of scan and slice: 000042-10.npz follows 000042-9.npz."""
    return tuple(int(part) for part in path.stem.split("-"))


def _first_lidar(recording: Recording) -> str:
    import mlbatch

    opened = mlbatch.open(*recording.packets, rig=recording.rig)
    return next(iter(opened.sensors))


def _mlbatch(*words: object) -> None:
    """Run a command of mlbatch; its errors are one line on stderr."""
    command = [sys.executable, "-m", "mlbatch", *map(str, words)]
    done = subprocess.run(command, check=False)
    if done.returncode:
        raise SystemExit(f"odometry: `mlbatch {words[0]}` failed with exit code {done.returncode}")


# -- results that are kept ------------------------------------------------------------------------


def _file_name(variant: Variant) -> str:
    return variant.name.replace(",", "").replace(" ", "-")


def _key(variant: Variant, settings: dict[str, object]) -> dict[str, object]:
    own = {"options": list(variant.options), "one_lidar": variant.one_lidar}
    return {**settings, **own, "rate_hz": RATE_HZ, "kiss_icp": kiss_icp.__version__}


def _kept(folder: Path, variant: Variant, settings: dict[str, object]) -> Errors | None:
    """Errors of an earlier run with the same settings."""
    path = folder / f"{_file_name(variant)}.json"
    if not path.exists() or not path.with_suffix(".tum").exists():
        return None
    kept = json.loads(path.read_text(encoding="utf-8"))
    return Errors(**kept["errors"]) if kept["settings"] == _key(variant, settings) else None


def _keep(folder: Path, variant: Variant, settings: dict[str, object], errors: Errors) -> None:
    kept = {"settings": _key(variant, settings), "errors": asdict(errors)}
    path = folder / f"{_file_name(variant)}.json"
    path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
