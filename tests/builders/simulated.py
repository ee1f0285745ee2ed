"""Simulated recordings in tests: scenarios, ground truth, distances of points from the scene.

Distances are computed here in closed form from the surfaces, poses from the TUM file: nothing of
the ray casting or of the trajectory is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mlbatch
from mlbatch.arrays import F64Array, I64Array
from mlbatch.outputs.scan import Scan
from mlbatch.simulate.recording import write_recording
from mlbatch.simulate.scenario import Scenario, read_scenario
from mlbatch.simulate.scene import Boxes, Rectangles, Scene, Stems

# A room with things in it, one of which moves; the rig turns and moves at 1 m/s.
MOTION = """\
motion:
  waypoints:
    - [0, -1.0, -0.5, 1.2, 10]
    - [1, 0.0, -0.3, 1.25, 60]
    - [2, 0.8, 0.4, 1.2, 140]
    - [3, 0.2, 1.2, 1.15, 200]
  sway:
    - {coordinate: roll, amplitude: 4, frequency_hz: 1.3}
    - {coordinate: pitch, amplitude: 3, frequency_hz: 0.9, phase_deg: 50}
"""
ROOM = """\
scene:
  boxes:
    - {centre_m: [0, 0, 2], size_m: [14, 11, 4], reflectivity: 90}
    - {centre_m: [4, 2, 0.6], size_m: [1.5, 1.0, 1.2], yaw_deg: 20, reflectivity: 40}
    - {centre_m: [-4, -4, 1], size_m: [2, 0.8, 2], velocity_mps: [2.5, 0.4, 0], reflectivity: 130}
  stems:
    - {base_m: [3, -3, 0], height_m: 3, radius_m: 0.3, reflectivity: 150}
    - {base_m: [-3, 3, 0], height_m: 2.5, radius_m: 0.4, top_radius_m: 0.1, reflectivity: 70}
  rectangles:
    - {corner_m: [5, -4, 0], along_m: [1, 0, 1], across_m: [0, 3, 0], reflectivity: 60}
"""

# Distances of stems up to which they are computed, m; far above every tolerance.
NEAR_M = 1.0

HEAD = """\
schema: mlbatch.scenario/1
seed: 7
duration_s: {duration}
truth: {{rate_hz: 1000}}
"""


def scenario_text(
    sensors: str, *, scene: str = ROOM, motion: str = MOTION, duration: float = 0.25, more: str = ""
) -> str:
    """A scenario; sensors: lines of the list."""
    return HEAD.format(duration=duration) + motion + scene + more + "sensors:\n" + sensors


@dataclass(frozen=True)
class Recorded:
    """A scenario and its recording."""

    scenario: Scenario
    path: Path

    @property
    def rig(self) -> Path:
        """The rig file next to it."""
        return self.path.with_name(f"{self.path.stem}.rig.yaml")

    @property
    def truth(self) -> Path:
        """The ground truth next to it."""
        return self.path.with_name(f"{self.path.stem}.truth.tum")

    def scans(self, **options: str | bool) -> list[Scan]:
        """What convert makes of it."""
        found = mlbatch.scans(self.path, rig=self.rig, keep_partial=True, **options)  # type: ignore[arg-type]
        return list(found)


def record(folder: Path, text: str, suffix: str = "pcap") -> Recorded:
    """Simulate a scenario."""
    source = folder / "scenario.yaml"
    source.write_text(text, encoding="utf-8")
    scenario = read_scenario(str(source))
    path = folder / f"drive.{suffix}"
    write_recording(scenario, path)
    return Recorded(scenario, path)


def read_tum(path: Path) -> tuple[I64Array, F64Array]:
    """Times (n,), ns, and rows (n, 7): x, y, z, qx, qy, qz, qw."""
    lines = [line.split() for line in path.read_text().splitlines()]
    seconds = [line[0].split(".") for line in lines]
    time_ns = np.array([int(one) * 10**9 + int(rest) for one, rest in seconds])
    return time_ns, np.array([[float(word) for word in line[1:]] for line in lines])


def at_true_poses(points_m: F64Array, time_ns: F64Array, truth: Path) -> F64Array:
    """Points (n, 3) of the body frame in the world; time_ns: (n,) true time of each."""
    stamps, rows = read_tum(truth)
    # (7, m): coordinates of points are added up fast where each is contiguous.
    poses = np.ascontiguousarray(rows.T)
    after = np.clip(np.searchsorted(stamps, time_ns), 1, len(stamps) - 1)
    share = (time_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
    first, second = poses.take(after - 1, axis=1), poses.take(after, axis=1)
    second[3:] *= np.sign((first[3:] * second[3:]).sum(axis=0))
    pose = first + (second - first) * share
    quaternion = pose[3:] / np.sqrt((pose[3:] ** 2).sum(axis=0))
    vector, scalar = quaternion[:3], quaternion[3]
    points = np.ascontiguousarray(points_m.T)
    twice = 2 * _cross(vector, points)
    moved: F64Array = points + scalar * twice + _cross(vector, twice) + pose[:3]
    return np.ascontiguousarray(moved.T)


def _cross(one: F64Array, other: F64Array) -> F64Array:
    """Cross products of vectors (3, n)."""
    (x, y, z), (u, v, w) = one, other
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def distance_to_scene(scene: Scene, points_m: F64Array, time_s: F64Array) -> F64Array:
    """Distances (n,) of points (n, 3) from the nearest surface at times (n,).

    Stems that are farther than NEAR_M do not count: a forest has thousands.
    """
    found = [np.full(len(points_m), np.inf)]
    stems = [kind for kind in scene.kinds if isinstance(kind, Stems)]
    found += [_to_stems(kind, points_m) for kind in stems]
    for kind in scene.kinds:
        for row in range(len(kind.reflectivity)):
            if isinstance(kind, Boxes):
                found.append(_to_box(kind, row, points_m, time_s))
            elif isinstance(kind, Stems):
                continue
            else:
                found.append(_to_rectangle(kind, row, points_m))
    if scene.terrain is not None:
        # The vertical distance is never less than the distance.
        found.append(np.abs(points_m[:, 2] - scene.terrain.height(points_m[:, :2])))
    return np.asarray(np.min(found, axis=0))


def residuals(recorded: Recorded, scans: Sequence[Scan]) -> F64Array:
    """Distances (p,) of all points from the scene at the true poses, m; clocks of all are equal."""
    found = []
    plan = recorded.scenario.lidars[0]
    start_ns = recorded.scenario.start_ns
    for scan in scans:
        own_ns = scan.time_ns.astype(np.int64) + scan.start_ns - start_ns
        # The clock of the sensor against the true one.
        rate = 1 + plan.clock.drift_ppm * 1e-6
        true_ns: F64Array = np.divide(own_ns - plan.clock.offset_s * 1e9, rate)
        epoch_ns = np.add(true_ns, start_ns)
        world = at_true_poses(scan.xyz.astype(np.float64), epoch_ns, recorded.truth)
        found.append(distance_to_scene(recorded.scenario.scene, world, np.multiply(true_ns, 1e-9)))
    return np.concatenate(found)


def _to_box(kind: Boxes, row: int, points_m: F64Array, time_s: F64Array) -> F64Array:
    since = time_s % kind.repeat_s[row] if np.isfinite(kind.repeat_s[row]) else time_s
    centre, velocity = kind.centre_m[row], kind.velocity_mps[row]
    x, y, z = (points_m[:, axis] - centre[axis] - since * velocity[axis] for axis in range(3))
    cosine, sine = np.cos(kind.yaw_rad[row]), np.sin(kind.yaw_rad[row])
    local = (cosine * x + sine * y, cosine * y - sine * x, z)
    past = [np.abs(one) - size / 2 for one, size in zip(local, kind.size_m[row], strict=True)]
    outside = np.sqrt(sum(np.maximum(one, 0) ** 2 for one in past))
    return np.asarray(np.where(outside > 0, outside, -np.maximum.reduce(past)))


def _to_stems(kind: Stems, points_m: F64Array) -> F64Array:
    """Distances (n,) from the nearest stem within NEAR_M; infinite where there is none."""
    order = np.argsort(points_m[:, 0])
    ordered = points_m[order]
    reach = NEAR_M + np.maximum(kind.radius_m, kind.top_radius_m)
    begins = np.searchsorted(ordered[:, 0], kind.base_m[:, 0] - reach)
    ends = np.searchsorted(ordered[:, 0], kind.base_m[:, 0] + reach)
    nearest = np.full(len(points_m), np.inf)
    for row, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        own = nearest[begin:end]
        np.minimum(own, _to_stem(kind, row, ordered[begin:end]), out=own)
    found = np.empty_like(nearest)
    found[order] = nearest
    return found


def _to_stem(kind: Stems, row: int, points_m: F64Array) -> F64Array:
    local = points_m - kind.base_m[row]
    height = kind.height_m[row]
    share = np.clip(local[:, 2] / height, 0, 1)
    radius = kind.radius_m[row] + share * (kind.top_radius_m[row] - kind.radius_m[row])
    aside = np.hypot(local[:, 0], local[:, 1]) - radius
    found: F64Array = np.hypot(aside, local[:, 2] - share * height)
    return found


def _to_rectangle(kind: Rectangles, row: int, points_m: F64Array) -> F64Array:
    local = points_m - kind.corner_m[row]
    nearest = np.zeros_like(local)
    for edge in (kind.along_m[row], kind.across_m[row]):
        nearest += np.clip(local @ edge / (edge @ edge), 0, 1)[:, None] * edge
    off = local - nearest
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", off, off)))
