"""Rays against surfaces: hand-worked hits, and all surfaces tried one after the other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.simulate.rays import Rays
from mlbatch.simulate.scene import Boxes, Rectangles, Scene, Stems, Swing

Vector = tuple[float, float, float]
ONE = np.ones(1)


def stems(*rows: tuple[Vector, float, float, float]) -> Stems:
    base, height, radius, top = zip(*rows, strict=True)
    table = [np.array(part, np.float64) for part in (base, height, radius, top)]
    return Stems(table[0], table[1], table[2], table[3], ONE)


def boxes(
    centre: Vector, size: Vector, yaw_deg: float = 0, velocity: Vector = (0, 0, 0),
    repeat_s: float = math.inf,
) -> Boxes:  # fmt: skip
    return Boxes(
        np.array([centre], np.float64),
        np.array([size], np.float64),
        np.radians([yaw_deg]),
        np.array([velocity], np.float64),
        np.array([repeat_s]),
        ONE,
    )


def square(corner: Vector, along: Vector, across: Vector) -> Rectangles:
    edges = [np.array([part], np.float64) for part in (corner, along, across)]
    return Rectangles(edges[0], edges[1], edges[2], ONE)


def cast_one(
    kind: Stems | Boxes | Rectangles, origin: Vector, direction: Vector, time_s: float = 0
) -> float:
    ray = np.array([direction]) / math.hypot(*direction)
    rays = Rays.of(np.array([origin], np.float64), ray, np.array([time_s], np.float64))
    return float(Scene((kind,)).cast(rays, 1000.0)[0][0])


PILLAR = stems(((5, 0, 0), 2, 1, 1))
# Its radius falls from 1 to 0 over 2 m.
CONE = stems(((5, 0, 0), 2, 1, 0))
CRATE = boxes((4, 0, 1), (2, 2, 2))
SHIELD = square((4, -1, -1), (0, 2, 0), (0, 0, 2))


@pytest.mark.parametrize(
    ("kind", "origin", "direction", "expected"),
    [
        pytest.param(SHIELD, (0, 0, 0), (1, 0, 0), 4.0, id="square on"),
        pytest.param(SHIELD, (0, 0, 0), (4, 0.75, 0), math.hypot(4, 0.75), id="aslant"),
        pytest.param(SHIELD, (0, 0, 0), (4, 1.25, 0), math.inf, id="past its edge"),
        pytest.param(SHIELD, (0, 0, 0), (-1, 0, 0), math.inf, id="behind"),
        pytest.param(PILLAR, (0, 0, 1), (1, 0, 0), 4.0, id="pillar in the middle"),
        pytest.param(PILLAR, (0, 0.6, 1), (1, 0, 0), 4.2, id="pillar off the middle"),
        pytest.param(PILLAR, (0, 0, 2.1), (1, 0, 0), math.inf, id="above the pillar"),
        pytest.param(
            PILLAR, (4, 0, 2.5), (2, 0, -1), math.sqrt(5), id="from above to the far side"
        ),
        # Half way up the cone's radius is 0.5.
        pytest.param(CONE, (0, 0, 1), (1, 0, 0), 4.5, id="cone"),
        # Along x = t, z = t / 8: radius 1 - t / 16 = 5 - t at t = 64 / 15.
        pytest.param(CONE, (0, 0, 0), (8, 0, 1), 64 / 15 * math.hypot(1, 1 / 8), id="cone aslant"),
        pytest.param(CRATE, (0, 0, 1), (1, 0, 0), 3.0, id="box"),
        pytest.param(CRATE, (4, 0, 1), (1, 0, 0), 1.0, id="box from inside"),
        pytest.param(CRATE, (0, 1.1, 1), (1, 0, 0), math.inf, id="past the box"),
        pytest.param(
            boxes((4, 0, 1), (2, 2, 2), 45), (0, 0, 1), (1, 0, 0), 4 - math.sqrt(2), id="corner"
        ),
    ],
)
def test_ray_meets_what_geometry_says(
    kind: Stems | Boxes | Rectangles, origin: Vector, direction: Vector, expected: float
) -> None:
    assert cast_one(kind, origin, direction) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("time_s", "expected"), [(0, 3.0), (2, 4.0), (9.5, 7.75), (10, 3.0)])
def test_a_box_moves_and_returns(time_s: float, expected: float) -> None:
    moving = boxes((4, 0, 1), (2, 2, 2), 0, (0.5, 0, 0), 10)
    assert cast_one(moving, (0, 0, 1), (1, 0, 0), time_s) == pytest.approx(expected, abs=1e-9)


def fan(seed: int, count: int = 4000) -> tuple[F64Array, F64Array]:
    """Rays of all directions from almost one place, as of a chunk of a lidar."""
    random = np.random.default_rng(seed)
    direction = random.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return random.uniform(-0.1, 0.1, (count, 3)) + np.array([0, 0, 1.0]), direction


@given(st.integers(0, 200))
def test_culling_loses_no_hit(seed: int) -> None:
    """Every surface is met by every ray on its own."""
    random = np.random.default_rng(seed)
    places = random.uniform(-6, 6, (8, 2))
    radius = random.uniform(0.05, 0.5, 8)
    # One around the origin of the rays.
    places[0] = 0.3, 0.0
    radius[0] = 0.6
    low = random.uniform(-5, 3, 3)
    high = low + random.uniform(0.2, 2, 3)
    ends = np.zeros(8)
    kinds = (
        Stems(np.column_stack([places, ends]), ends + 2, radius, radius, ends + 1),
        boxes(tuple((low + high) / 2), tuple(high - low)),
        square((-7.0, -7.0, -1.0), (14.0, 0.0, 0.0), (0.0, 0.0, 5.0)),
    )
    origin, direction = fan(seed)
    rays = Rays.of(origin, direction, np.zeros(len(origin)))
    found, _ = Scene(kinds).cast(rays, 40.0)
    met = [
        kind.meet(np.full(len(origin), row), rays)
        for kind in kinds
        for row in range(len(kind.reflectivity))
    ]
    wanted = np.min(met, axis=0)
    np.testing.assert_array_equal(found, np.where(wanted < 40.0, wanted, np.inf))


def test_reflectivity_is_that_of_the_nearest_surface() -> None:
    near = boxes((3, 0, 0), (1, 1, 1))
    far = boxes((6, 0, 0), (1, 4, 4))
    scene = Scene((near, replace(far, reflectivity=np.array([9.0]))))
    direction = np.array([[1, 0, 0], [6, 1.5, 0]]) / np.array([[1.0], [math.hypot(6, 1.5)]])
    _, level = scene.cast(Rays.of(np.zeros((2, 3)), direction, np.zeros(2)), 100.0)
    assert level.tolist() == [1.0, 9.0]


def test_nothing_is_seen_beyond_the_range() -> None:
    rays = Rays.of(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.zeros(1))
    assert Scene((SHIELD,)).cast(rays, 3.9)[0].tolist() == [math.inf]
    assert Scene((SHIELD,)).cast(rays, 4.1)[0].tolist() == [4.0]


@pytest.mark.parametrize("begin_s", [0.0, 3.9, 3.97])
def test_culling_loses_no_hit_of_a_moving_box(begin_s: float) -> None:
    """Every ray at its own time; the box returns to its first place after 4 s."""
    moving = boxes((4, 3, 0.5), (2, 1, 3), 30, (-2.5, -1.5, 0.2), 4.0)
    origin, direction = fan(11)
    time_s = begin_s + np.linspace(0.0, 0.1, len(origin))
    rays = Rays.of(origin, direction, time_s)
    expected = moving.meet(np.zeros(len(origin), np.int64), rays)
    found, _ = Scene((moving,)).cast(rays, 60.0)
    np.testing.assert_array_equal(found, np.where(expected < 60.0, expected, np.inf))
    assert 10 < np.isfinite(found).sum() < len(found) / 2


def swinging(box: Boxes, axis: Vector, amplitude_deg: float, frequency_hz: float) -> Boxes:
    """A box that swings about the origin."""
    rows = (amplitude_deg * math.pi / 180, frequency_hz, 0.0)
    swing = Swing(np.zeros((1, 3)), np.array([axis], np.float64), *(np.array([v]) for v in rows))
    return replace(box, swing=swing)


@pytest.mark.parametrize(
    ("axis", "direction"), [((0, 0, 1), (0, 1, 0)), ((0, 1, 0), (0, 0, -1)), ((1, 0, 0), (1, 0, 0))]
)
def test_a_box_that_swings_is_seen_where_it_has_turned_to(axis: Vector, direction: Vector) -> None:
    """A cube at 3 m ahead, turned by 90 degrees after a quarter of 4 s, by the right-hand rule."""
    box = swinging(boxes((3, 0, 0), (1, 1, 1)), axis, 90, 0.25)
    assert cast_one(box, (0, 0, 0), (1, 0, 0), time_s=0.0) == pytest.approx(2.5)
    assert cast_one(box, (0, 0, 0), direction, time_s=1.0) == pytest.approx(2.5)
    if direction != (1, 0, 0):
        assert cast_one(box, (0, 0, 0), (1, 0, 0), time_s=1.0) == math.inf


@given(st.integers(0, 100))
def test_culling_loses_no_hit_of_a_box_that_swings(seed: int) -> None:
    """Rays of a tenth of a second together, and one by one, which bounds its place exactly."""
    random = np.random.default_rng(seed)
    axis = random.standard_normal(3)
    box = swinging(
        boxes(tuple(random.uniform(-4, 4, 3)), (1, 2, 0.5)),
        tuple(axis / np.linalg.norm(axis)), random.uniform(5, 120), random.uniform(0.1, 2),
    )  # fmt: skip
    origin, direction = fan(seed)
    times = random.uniform(3.0, 3.1, len(origin))
    together, _ = Scene((box,)).cast(Rays.of(origin, direction, times), 40.0)
    every = np.arange(len(origin))
    met = box.meet(0 * every, Rays.of(origin, direction, times))
    np.testing.assert_array_equal(together, np.where(met < 40.0, met, np.inf))
