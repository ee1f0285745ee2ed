"""Simulated drives whose points are written as decoded clouds, with times in several readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mlbatch
from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.recording import write_recording
from mlbatch.simulate.scenario import read_scenario
from tests.builders.bags import Recorded
from tests.builders.mcaps import write_mcap
from tests.builders.points import CLOUD, Form, cloud_of

SWEEP_NS = 100_000_000
# From the last point of a sweep to its log time.
_DELAY_NS = 4_000_000
NAMES = ("left", "right")
_HEAD = """\
schema: mlbatch.scenario/1
seed: {seed}
duration_s: {duration_s}
truth: {{rate_hz: 100}}
"""
_SENSOR = """\
  - name: {name}
    model: OS1-32
    columns: 512
    phase_deg: {phase_deg:.1f}
    dropout: 0.02
    noise_m: 0.01
    extrinsics: {{translation_m: [{x:.3f}, {y:.3f}, {z:.3f}], rotation_rpy_deg: [{rpy}]}}
"""


@dataclass(frozen=True)
class Reading:
    """How a driver writes the times of a lidar; name: of the case.

    kind: of the field; unit_ns: of its numbers; header: start or end of a sweep; counts: from the
    start (t >= 0), to_end (t <= 0, up to the header), or age (t >= 0, before the end of the sweep);
    delay_ns: the header is that much late; points: the key of the rig, or "".
    """

    name: str
    kind: str = "uint32"
    unit_ns: int = 1
    header: str = "start"
    counts: str = "start"
    delay_ns: int = 0
    points: str = ""


READINGS = (
    Reading("seconds", "float32", 10**9),
    Reading("nanoseconds"),
    Reading("up to the end", "float32", 10**9, "end", "to_end"),
    Reading("header at the end", header="end"),
    Reading("header at the start, rig says end", points="{from: end}"),
    Reading("ages", header="end", counts="age"),
    Reading("20 ms late", delay_ns=20_000_000),
    Reading("97 ms late", delay_ns=97_000_000),
)


@dataclass(frozen=True)
class Drive:
    """Points of each lidar in its frame and their true times, by sweep.

    sweeps: of each lidar, (stamp_ns (n,), points (n, 3), first nanosecond of the sweep); truth:
    file of the true poses.
    """

    sweeps: Sequence[Sequence[tuple[I64Array, F64Array, int]]]
    poses: Sequence[F64Array]
    truth: Path


def scenario(seed: int, *, moving: bool = True, duration_s: float = 4.0) -> str:
    """A yard with boxes, crossed at 2 to 12 m/s with turns, from standstill or not."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(2.0, 12.0) if moving else 0.0
    turn_deg = rng.uniform(-25.0, 25.0) if moving else 0.0
    heading = np.deg2rad(rng.uniform(-180.0, 180.0))
    at = np.zeros(2)
    lines, places = [], []
    times = np.arange(0.0, duration_s + 4.0, 1.0)
    for time_s in times:
        lines.append(
            f"    - [{time_s:g}, {at[0]:.3f}, {at[1]:.3f}, 0.3, {np.rad2deg(heading):.2f}]"
        )
        places.append(at.copy())
        step = speed * rng.uniform(0.8, 1.2)
        heading += np.deg2rad(turn_deg * rng.uniform(0.5, 1.5))
        at = at + step * np.array([np.cos(heading), np.sin(heading)])
    track = np.array(places)
    middle = track[: int(duration_s) + 2].mean(axis=0)
    boxes: list[str] = []
    while len(boxes) < 24:
        centre = middle + rng.uniform(-38.0, 38.0, 2)
        size = rng.uniform([1.5, 1.5, 1.5], [10.0, 8.0, 7.0])
        if np.hypot(*(track - centre).T).min() < 3.5 + np.hypot(size[0], size[1]) / 2:
            continue
        boxes.append(
            f"    - {{centre_m: [{centre[0]:.2f}, {centre[1]:.2f}, {size[2] / 2:.2f}], "
            f"size_m: [{size[0]:.2f}, {size[1]:.2f}, {size[2]:.2f}], "
            f"yaw_deg: {rng.uniform(0, 90):.1f}, reflectivity: 80}}"
        )
    motion = ""
    if moving:
        still_s = rng.choice([0.0, 1.0])
        motion = (
            f"motion:\n  standstill_s: {still_s}\n  waypoints:\n" + "\n".join(lines) + "\n  sway:\n"
            f"    - {{coordinate: pitch, amplitude: {rng.uniform(0, 1):.2f}, frequency_hz: 1.3}}\n"
        )
    low = middle - 90
    scene = (
        "scene:\n  rectangles:\n"
        f"    - {{corner_m: [{low[0]:.1f}, {low[1]:.1f}, 0], along_m: [180, 0, 0], "
        "across_m: [0, 180, 0], reflectivity: 30}\n  boxes:\n" + "\n".join(boxes) + "\n"
    )
    sensors = "sensors:\n"
    for name, side in zip(NAMES, (1.0, -1.0), strict=True):
        x, y, z = rng.uniform([-1.0, 0.3, 1.5], [1.0, 1.0, 2.5])
        rpy = ", ".join(f"{angle:.3f}" for angle in rng.uniform([-15, -15, -180], [15, 15, 180]))
        phase_deg = rng.uniform(0, 360)
        sensors += _SENSOR.format(name=name, phase_deg=phase_deg, x=x, y=side * y, z=z, rpy=rpy)
    return _HEAD.format(seed=seed, duration_s=duration_s) + motion + scene + sensors


def drive(folder: Path, text: str, seed: int = 0) -> Drive:
    """Simulate a scenario and cut the points of each lidar into sweeps at any angle."""
    source = folder / "scenario.yaml"
    source.write_text(text, encoding="utf-8")
    path = folder / "drive.mcap"
    write_recording(read_scenario(str(source)), path, overwrite=True)
    scans = list(mlbatch.scans(path, rig=folder / "drive.rig.yaml", keep_partial=True))
    stamps = np.concatenate([scan.start_ns + scan.time_ns.astype(np.int64) for scan in scans])
    points = np.concatenate([scan.xyz for scan in scans]).astype(np.float64)
    lidar = np.concatenate([scan.lidar_id for scan in scans])
    poses = [sensor.body_from_sensor for sensor in scans[0].info.sensors]
    cut_ns = np.random.default_rng(seed).integers(0, SWEEP_NS, len(poses))
    sweeps = []
    for number, pose in enumerate(poses):
        own = np.flatnonzero(lidar == number)
        own = own[np.argsort(stamps[own], kind="stable")]
        stamp_ns = stamps[own]
        local = np.matmul(points[own] - pose[:3, 3], pose[:3, :3])
        index = (stamp_ns - cut_ns[number]) // SWEEP_NS
        parts = []
        for sweep in np.unique(index)[1:-1].tolist():
            rows = index == sweep
            parts.append((stamp_ns[rows], local[rows], sweep * SWEEP_NS + int(cut_ns[number])))
        sweeps.append(parts)
    return Drive(sweeps, poses, folder / "drive.truth.tum")


def write_clouds(
    folder: Path, moved: Drive, readings: Sequence[Reading], poses: Sequence[F64Array] | None = None
) -> tuple[Path, Path]:
    """An MCAP of decoded clouds, one topic a lidar, and its rig; poses: those of the rig."""
    messages = []
    for name, sweeps, reading in zip(NAMES, moved.sweeps, readings, strict=True):
        for stamp_ns, points_m, start_ns in sweeps:
            body = _cloud(stamp_ns, points_m, start_ns, reading, name)
            log_ns = start_ns + SWEEP_NS + _DELAY_NS + reading.delay_ns
            messages.append(Recorded(f"/{name}/points", CLOUD, log_ns, body))
    messages.sort(key=lambda one: one.log_ns)
    rig = folder / "clouds.yaml"
    rig.write_text(_rig(moved.poses if poses is None else poses, readings), encoding="utf-8")
    return write_mcap(folder / "clouds.mcap", messages), rig


def _cloud(
    stamp_ns: I64Array, points_m: F64Array, start_ns: int, reading: Reading, frame: str
) -> bytes:
    """A PointCloud2."""
    last_ns = int(stamp_ns.max())
    header_ns = start_ns if reading.header == "start" else last_ns
    zero_ns = {"start": start_ns, "to_end": last_ns, "age": last_ns}[reading.counts]
    after_ns = stamp_ns - zero_ns if reading.counts != "age" else zero_ns - stamp_ns
    rows = np.zeros(len(stamp_ns), [*((axis, "f4") for axis in "xyz"), ("t", reading.kind)])
    for column, axis in enumerate("xyz"):
        rows[axis] = points_m[:, column]
    rows["t"] = after_ns / reading.unit_ns if reading.unit_ns > 1 else after_ns
    return cloud_of(rows, header_ns + reading.delay_ns, Form(frame=frame))


def _rig(poses: Sequence[F64Array], readings: Sequence[Reading]) -> str:
    lines = ["body_frame: base_link", "sensors:"]
    for name, pose, reading in zip(NAMES, poses, readings, strict=True):
        matrix = ", ".join("[" + ", ".join(f"{value:.9f}" for value in row) + "]" for row in pose)
        lines += [
            f"  - name: {name}",
            f"    stream: {{topic: /{name}/points}}",
            f"    extrinsics: {{matrix: [{matrix}]}}",
        ]
        if reading.points:
            lines.append(f"    points: {reading.points}")
    return "\n".join(lines) + "\n"
