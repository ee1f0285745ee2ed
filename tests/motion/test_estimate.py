"""Velocities of windows from points on planes, seen from a body with a known motion.

A window is worked out by hand: random places on the planes of a scene, at random times, in the
frame of a body that turns around z and drives along its own x axis, which is an arc.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.motion.estimate import FIRST, NO_GAIN, Estimate, VelocityEstimator
from mlbatch.motion.registration import ColumnCloud

PERIOD_NS = 100_000_000
PERIOD_S = 0.1
COLUMNS = 256
# Corner, and two edges of a rectangle, m.
Plane = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
FLOOR: Plane = ((-12.6, -9.2, -0.7), (27, 0, 0), (0, 17.5, 0))
SIDES: list[Plane] = [
    ((-12.6, 8.3, -0.7), (27, 0, 0), (0, 0, 6)),
    ((-12.6, -9.2, -0.7), (27, 0, 0), (0, 0, 6)),
]
ENDS: list[Plane] = [
    ((14.4, -9.2, -0.7), (0, 17.5, 0), (0, 0, 6)),
    ((-12.6, -9.2, -0.7), (0, 17.5, 0), (0, 0, 6)),
]
ROOM = [FLOOR, *SIDES, *ENDS]
CORRIDOR = [FLOOR, *SIDES]


def places(planes: list[Plane], rng: np.random.Generator) -> F64Array:
    """Places on the planes, (n, 3): 13 to a square metre of the floor, more on walls."""
    parts = []
    for corner, along, across in planes:
        share = rng.random((6000, 2))
        parts.append(corner + share[:, :1] * np.array(along) + share[:, 1:] * np.array(across))
    found: F64Array = np.concatenate(parts)
    return found


def window(
    planes: list[Plane], number: int, speed: float, turn: float, begin: int = 0
) -> tuple[ColumnCloud, int]:
    """The points of a window with 5 mm of noise, and its middle in ns.

    The motion begins with window `begin`, at the origin; speed: m/s; turn: rad/s.
    """
    rng = np.random.default_rng(number)
    world = places(planes, rng)
    column = rng.integers(0, COLUMNS, len(world))
    column_s = (np.arange(COLUMNS) + 0.5) / COLUMNS * PERIOD_S
    at_s = np.maximum(0.0, (number - begin) * PERIOD_S + column_s)[column]
    yaw = turn * at_s
    # The arc of a body that turns by yaw over a way of speed times time.
    shape = np.sinc(yaw / 2 / math.pi) * speed * at_s
    x, y = shape * np.cos(yaw / 2), shape * np.sin(yaw / 2)
    along, across = world[:, 0] - x, world[:, 1] - y
    body = np.stack(
        [
            np.cos(yaw) * along + np.sin(yaw) * across,
            np.cos(yaw) * across - np.sin(yaw) * along,
            world[:, 2],
        ],
        axis=1,
    )
    body += rng.normal(0.0, 0.005, body.shape)
    middle_ns = number * PERIOD_NS + PERIOD_NS // 2
    return ColumnCloud(body, column, column_s - PERIOD_S / 2), middle_ns


def estimates(
    planes: list[Plane], numbers: list[int], speed: float, turn: float, begin: int = 0
) -> list[Estimate]:
    estimator = VelocityEstimator()
    return [
        estimator.add(*window(planes, number, speed, turn, begin), PERIOD_NS) for number in numbers
    ]


@pytest.mark.parametrize(("speed", "turn"), [(0.0, 0.0), (5.0, 0.0), (2.0, 0.6), (-3.0, -0.4)])
def test_a_constant_motion_is_found_from_the_third_window_on(speed: float, turn: float) -> None:
    """Also if it does not begin at rest: v along x, turn around z, nothing else."""
    found = estimates(ROOM, list(range(10)), speed, turn)
    # What stands is not moved.
    reason = "" if speed else NO_GAIN
    assert [one.reason for one in found] == [FIRST, FIRST, *[reason] * 8]
    for one in found[2:]:
        assert one.velocity is not None
        np.testing.assert_allclose(one.velocity[:3], [speed, 0, 0], atol=0.05)
        np.testing.assert_allclose(one.velocity[3:], [0, 0, turn], atol=0.005)
        assert one.residual_m is not None
        assert one.residual_m < 0.02


def test_along_a_corridor_there_is_no_velocity() -> None:
    """Walls and floor look the same at any speed: not 0 m/s, but none."""
    found = estimates(CORRIDOR, list(range(6)), 5.0, 0.0)
    assert [one.velocity for one in found] == [None] * 6
    assert {one.reason for one in found[1:]} <= {"degenerate", "no_convergence"}


def test_a_floor_alone_gives_none() -> None:
    found = estimates([FLOOR], list(range(4)), 1.0, 0.0)
    assert [one.velocity for one in found] == [None] * 4


def test_few_points_give_none_and_the_next_windows_go_on() -> None:
    """The window after one that failed has none directly before it."""
    estimator = VelocityEstimator()
    found = []
    for number in range(8):
        cloud, middle_ns = window(ROOM, number, 2.0, 0.0)
        if number == 4:
            cloud = cloud.take(np.arange(100))
        found.append(estimator.add(cloud, middle_ns, PERIOD_NS).reason)
    assert found == [FIRST, FIRST, "", "", "few_points", FIRST, "", ""]


def test_an_empty_window_is_a_failure_too() -> None:
    estimator = VelocityEstimator()
    for number in range(4):
        cloud, middle_ns = window(ROOM, number, 2.0, 0.0)
        if number != 2:
            cloud = cloud.take(np.zeros(0, np.int64))
        assert estimator.add(cloud, middle_ns, PERIOD_NS).velocity is None


def test_after_a_gap_everything_begins_again() -> None:
    found = estimates(ROOM, [0, 1, 2, 3, 12, 13, 14], 1.0, 0.0)
    assert [one.reason for one in found] == [FIRST, FIRST, "", "", FIRST, FIRST, ""]


def test_an_impossible_change_is_refused() -> None:
    """From rest to 12 m/s between two windows: 120 m/s2."""
    found = estimates(ROOM, list(range(6)), 12.0, 0.0, begin=4)
    assert [one.reason for one in found[:4]] == [FIRST, FIRST, NO_GAIN, NO_GAIN]
    assert found[5].velocity is None


def test_the_same_points_give_the_same_velocities() -> None:
    one, two = (estimates(ROOM, list(range(5)), 2.0, 0.3) for _ in range(2))
    for left, right in zip(one[2:], two[2:], strict=True):
        assert left.velocity is not None
        assert right.velocity is not None
        assert left.velocity.tobytes() == right.velocity.tobytes()
