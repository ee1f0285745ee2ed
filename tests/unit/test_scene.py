"""The scene of the fixtures, by rays and points worked out by hand; and the files made from it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.builders.scene import Pillar, Rectangle, Scene, Vector, box, hall

# A square of 2 m at x = 4, centred on the x axis.
SHIELD = Scene((Rectangle((4.0, -1.0, -1.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0), 10),))
PILLAR = Scene((Pillar(x=5.0, y=0.0, radius=1.0, height=2.0, reflectivity=10),))


def cast_one(scene: Scene, origin: Vector, direction: Vector) -> float:
    ray = np.array([direction]) / math.sqrt(sum(part**2 for part in direction))
    return float(scene.cast(np.array([origin]), ray)[0])


@pytest.mark.parametrize(
    ("scene", "origin", "direction", "wanted"),
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
        # The pillar at (6.5, 4.5) stands 2 m before the wall at y = 7.
        pytest.param(hall(), (6.5, 0, 2), (0, 1, 0), 4.1, id="left front pillar"),
        # 2 m along the ramp's foot it is 2 * 1.5 / 4 = 0.75 m high.
        pytest.param(hall(), (9, 0, 3), (0, 0, -1), 2.25, id="ramp"),
        pytest.param(hall(), (3, -5, 3), (0, 0, -1), 2.0, id="top of the crate"),
        pytest.param(hall(), (0, -5, 0.5), (1, 0, 0), 2.5, id="side of the crate"),
    ],
)
def test_ray_meets_what_geometry_says(
    scene: Scene, origin: Vector, direction: Vector, wanted: float
) -> None:
    assert cast_one(scene, origin, direction) == pytest.approx(wanted, abs=1e-12)


def test_rays_are_cast_each_for_itself() -> None:
    origins = np.zeros((3, 3))
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.8, 0.0, 0.6]])
    # The third meets the plane x = 4 at z = 3, above the shield.
    assert SHIELD.cast(origins, directions).tolist() == [4.0, math.inf, math.inf]
    assert SHIELD.surface_hit(origins, directions).tolist() == [0, -1, -1]


@pytest.mark.parametrize(
    ("scene", "point", "wanted"),
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
def test_distance_to_a_surface(scene: Scene, point: Vector, wanted: float) -> None:
    assert scene.distance_to_surfaces(np.array([point])).tolist() == pytest.approx([wanted])


def test_box_is_closed_but_for_its_bottom() -> None:
    crate = Scene(box((0.0, 0.0, 0.0), (2.0, 4.0, 6.0), 10))
    inside = np.tile([0.5, 1.5, 2.5], (6, 1))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    assert crate.cast(inside, axes).tolist() == [1.5, 2.5, 3.5, 0.5, 1.5, math.inf]


def test_every_hit_lies_on_a_surface() -> None:
    turn = np.linspace(0.0, 2.0 * math.pi, 500, endpoint=False)
    rise = np.linspace(-1.5, 1.5, 500)
    directions = np.stack(
        [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1
    )
    origins = np.tile([0.2, 0.9, 2.4], (500, 1))
    distance = hall().cast(origins, directions)
    hit = np.isfinite(distance)
    points = origins[hit] + distance[hit, None] * directions[hit]
    assert hit.sum() > 300
    assert hall().distance_to_surfaces(points).max() < 1e-12
