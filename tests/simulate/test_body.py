"""The machine itself in a simulated recording: lidars see it, and nothing that is behind it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import mlbatch
from mlbatch.arrays import F64Array
from tests.builders.simulated import at_true_poses, distance_to_scene, record, scenario_text

# Body frame: 1.2 x 0.8 x 0.4 m, turned by 90 degrees, and a mast behind the lidar.
PARTS = """\
body:
  - {centre_m: [0.2, 0.1, -0.5], size_m: [0.8, 1.2, 0.4], yaw_deg: 90}
  - {centre_m: [-0.6, 0, 0.2], size_m: [0.2, 0.2, 0.8], reflectivity: 20}
"""
# Without rotation: low and high corners.
CORNERS = (
    (np.array([-0.4, -0.3, -0.7]), np.array([0.8, 0.5, -0.3])),
    (np.array([-0.7, -0.1, -0.2]), np.array([-0.5, 0.1, 0.6])),
)
LIDAR_M = np.array([0.2, 0.1, 0.4])
ONE = (
    "  - {name: one, model: OS0-32, columns: 512, noise_m: 0,"
    " extrinsics: {translation_m: [0.2, 0.1, 0.4], rotation_rpy_deg: [0, 0, 30]}}\n"
)


def to_parts(points_m: F64Array) -> F64Array:
    """Distances (n,) from the surfaces of the parts."""
    found = []
    for low, high in CORNERS:
        past = np.maximum(low - points_m, points_m - high)
        outside = np.linalg.norm(np.maximum(past, 0), axis=1)
        found.append(np.where(outside > 0, outside, -past.max(axis=1)))
    return np.asarray(np.min(found, axis=0))


def test_points_are_on_the_scene_or_on_the_machine_and_never_behind_it(tmp_path: Path) -> None:
    recorded = record(tmp_path, scenario_text(ONE, more=PARTS))
    parts = scene = 0
    for scan in recorded.scans():
        own = scan.xyz.astype(np.float64)
        time_ns = np.add(scan.time_ns, scan.start_ns, dtype=np.int64)
        world = at_true_poses(own, time_ns, recorded.truth)
        time_s = (time_ns - recorded.scenario.start_ns) / 1e9
        away = distance_to_scene(recorded.scenario.scene, world, time_s)
        assert np.minimum(away, to_parts(own)).max() < 0.005
        parts += int((to_parts(own) < 0.005).sum())
        scene += int((away < 0.005).sum())
        # On the way to a point there is nothing of the machine: 40 mm inside its surfaces, since
        # beams of this model begin up to 36 mm from the middle.
        for share in np.linspace(0.02, 1.0, 60):
            place = LIDAR_M + share * (own - LIDAR_M)
            for low, high in CORNERS:
                assert not ((place > low + 0.04) & (place < high - 0.04)).all(axis=1).any()
    # 32 beams of -45 to 45 degrees: the mast is 15 degrees wide, the box 0.7 m below is 45 degrees
    # down at its edges only.
    assert parts > 1000
    assert scene > 10_000


def test_an_excluded_box_removes_the_machine_and_counts_it(tmp_path: Path) -> None:
    recorded = record(tmp_path, scenario_text(ONE, more=PARTS))
    # 50 mm around both parts.
    around = (-0.75, -0.35, -0.75, 0.85, 0.55, 0.65)
    mlbatch.convert(
        recorded.path, rig=recorded.rig, output=tmp_path / "scans", exclude_boxes=[around]
    )
    report = json.loads((tmp_path / "scans" / "report.json").read_text())
    assert report["sensors"][0]["points"]["box"] > 300
    for path in (tmp_path / "scans").glob("[0-9]*.npz"):
        with np.load(path) as scan:
            assert to_parts(scan["xyz"].astype(np.float64)).min() > 0.045
