"""The scene of the fixtures, by rays and points worked out by hand; and the files made from it."""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tests.builders.make_fixtures import FOLDER, main
from tests.builders.scene import Pillar, Rectangle, Scene, Vector, box, hall

DOCS = Path(__file__).resolve().parents[2] / "docs"

# A square of 2 m at x = 4, centred on the x axis.
SHIELD = Scene((Rectangle((4.0, -1.0, -1.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0), 10),))
PILLAR = Scene((Pillar(x=5.0, y=0.0, radius=1.0, height=2.0, reflectivity=10),))


def cast_one(scene: Scene, origin: Vector, direction: Vector) -> float:
    ray = np.array([direction]) / math.sqrt(sum(part**2 for part in direction))
    return float(scene.cast(np.array([origin]), ray)[0])


@pytest.mark.parametrize(
    ("scene", "origin", "direction", "expected"),
    [
        pytest.param(SHIELD, (0, 0, 0), (1, 0, 0), 4.0, id="square on"),
        pytest.param(SHIELD, (0, 0, 0), (4, 0.75, 0), math.hypot(4, 0.75), id="aslant"),
        pytest.param(SHIELD, (0, 0, 0), (4, 1.25, 0), math.inf, id="past its edge"),
        pytest.param(SHIELD, (0, 0, 0), (-1, 0, 0), math.inf, id="behind"),
        pytest.param(SHIELD, (0, 0, 0), (0, 1, 0), math.inf, id="along it"),
        pytest.param(SHIELD, (4, 0, 0), (0, 1, 0), math.inf, id="within its plane"),
        pytest.param(PILLAR, (0, 0, 1), (1, 0, 0), 4.0, id="pillar in the middle"),
        # 0.6 aside of the axis the mantle is sqrt(1 - 0.36) = 0.8 before it.
        pytest.param(PILLAR, (0, 0.6, 1), (1, 0, 0), 4.2, id="pillar off the middle"),
        pytest.param(PILLAR, (0, 1.1, 1), (1, 0, 0), math.inf, id="past the pillar"),
        pytest.param(PILLAR, (0, 0, 2.1), (1, 0, 0), math.inf, id="above the pillar"),
        # Down through the open top: 2 m forward and 1 m down meets the far side at x = 6.
        pytest.param(PILLAR, (4, 0, 2.5), (2, 0, -1), math.sqrt(5), id="pillar from inside"),
        pytest.param(PILLAR, (5, 0, 1), (0, 0, 1), math.inf, id="along the pillar's axis"),
        pytest.param(hall(), (0, 0, 2.5), (-1, 0, 0), 8.0, id="rear wall"),
        pytest.param(hall(), (0, 0, 2.5), (1, 0, 0), 12.0, id="front wall"),
        pytest.param(hall(), (0, 0, 2.5), (0, 0, 1), math.inf, id="open ceiling"),
        pytest.param(hall(), (-3, 0, 2), (0, 0, 1), 3.0, id="closed ceiling"),
        pytest.param(hall(), (0, 0, 2.5), (0, 0, -1), 0.7, id="roof of the machine"),
        pytest.param(hall(), (3, 0, 2.5), (0, 0, -1), 2.5, id="floor"),
        # The pillar at (6.5, 4.5) is 2 m before the wall at y = 7.
        pytest.param(hall(), (6.5, 0, 2), (0, 1, 0), 4.1, id="left front pillar"),
        # 2 m along the ramp's foot it is 2 * 1.5 / 4 = 0.75 m high.
        pytest.param(hall(), (9, 0, 3), (0, 0, -1), 2.25, id="ramp"),
        pytest.param(hall(), (3, -5, 3), (0, 0, -1), 2.0, id="top of the crate"),
        pytest.param(hall(), (0, -5, 0.5), (1, 0, 0), 2.5, id="side of the crate"),
    ],
)
def test_ray_meets_what_geometry_says(
    scene: Scene, origin: Vector, direction: Vector, expected: float
) -> None:
    assert cast_one(scene, origin, direction) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("scene", "point", "expected"),
    [
        pytest.param(SHIELD, (4.25, 0.5, 0.5), 0.25, id="before the square"),
        # 3 m beyond one edge and 4 m off the plane.
        pytest.param(SHIELD, (8, 4, 0), 5.0, id="beyond an edge"),
        pytest.param(SHIELD, (4, 4, -5), 5.0, id="beyond a corner"),
        pytest.param(PILLAR, (5, 1.5, 1), 0.5, id="outside the pillar"),
        pytest.param(PILLAR, (5, 0, 1), 1.0, id="on the pillar's axis"),
        # 3 m aside of the mantle and 4 m above the top.
        pytest.param(PILLAR, (9, 0, 6), 5.0, id="above the pillar"),
    ],
)
def test_distance_to_a_surface(scene: Scene, point: Vector, expected: float) -> None:
    assert scene.distance_to_surfaces(np.array([point])).tolist() == pytest.approx([expected])


def test_box_is_closed_but_for_its_bottom() -> None:
    crate = Scene(box((0.0, 0.0, 0.0), (2.0, 4.0, 6.0), 10))
    inside = np.tile([0.5, 1.5, 2.5], (6, 1))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    assert crate.cast(inside, axes).tolist() == [1.5, 2.5, 3.5, 0.5, 1.5, math.inf]


def test_every_hit_is_on_a_surface() -> None:
    azimuth = np.linspace(0.0, 2.0 * math.pi, 500, endpoint=False)
    rise = np.linspace(-1.5, 1.5, 500)
    directions = np.stack(
        [np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)], axis=1
    )
    origins = np.tile([0.2, 0.9, 2.4], (500, 1))
    distance = hall().cast(origins, directions)
    hit = np.isfinite(distance)
    points = origins[hit] + distance[hit, None] * directions[hit]
    assert hit.sum() > 300
    assert hall().distance_to_surfaces(points).max() < 1e-12


def test_fixture_is_made_again_to_the_byte(tmp_path: Path) -> None:
    main(tmp_path)
    made = sorted(path.name for path in tmp_path.iterdir())
    assert made == ["left.json", "rig.yaml", "right.json", "two_lidars.pcap"]
    for name in made:
        assert digest(tmp_path / name) == digest(FOLDER / name), name


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def run(script: str, *arguments: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(DOCS / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_time_span_picture_is_what_its_script_draws() -> None:
    assert run("time_span.py").stdout == (DOCS / "time_span.svg").read_text()


def test_picture_shows_each_lidar_in_its_colour(tmp_path: Path) -> None:
    side = np.linspace(0.0, 3.0, 50)
    xyz = np.stack([side, side % 0.7, side], axis=1)
    np.savez(
        tmp_path / "000000.npz",
        xyz=np.concatenate([xyz, xyz + 1.0]).astype(np.float32),
        lidar_id=np.repeat([0, 1], 50).astype(np.uint8),
        sensors=np.array(["left", "right"]),
        index=0,
        start_ns=0,
        end_ns=100_000_000,
    )
    assert run("picture.py", tmp_path, tmp_path / "out.png").returncode == 0
    assert (tmp_path / "out.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    # Red, green, blue and opacity from 0 to 1.
    pixels = imread(tmp_path / "out.png").reshape(-1, 4)
    # Orange has more red than blue, cyan more blue than red.
    assert (pixels[:, 0] > pixels[:, 2] + 80 / 255).any()
    assert (pixels[:, 2] > pixels[:, 0] + 80 / 255).any()


def test_picture_of_nothing_is_refused_in_one_line(tmp_path: Path) -> None:
    done = run("picture.py", tmp_path, tmp_path / "out.png")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "expected a folder of npz scans, found none; convert" in done.stderr
