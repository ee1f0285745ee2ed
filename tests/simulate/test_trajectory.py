"""Poses, their rates and what an IMU feels: hand-worked motions, and differences of poses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array
from mlbatch.simulate.trajectory import (
    RAMP_S,
    Spline,
    Sway,
    Trajectory,
    path_from_waypoints,
)
from mlbatch.units import STANDARD_GRAVITY

# m/s2, upward: what an IMU at rest feels.
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def path(*rows: tuple[float, ...]) -> Spline:
    table = np.array(rows, np.float64)
    yaw = np.radians(table[:, 4]) if table.shape[1] == 5 else None
    return path_from_waypoints(table[:, 0], table[:, 1:4], yaw)


WINDING = Trajectory(
    path((0, 0, 0, 1), (3, 4, 1, 1.2), (6, 6, 5, 0.9), (9, 3, 8, 1), (12, -1, 7, 1)),
    [Sway(3, 0.05, 0.7, 0.4), Sway(4, 0.08, 1.1), Sway(2, 0.03, 1.9), Sway(5, 0.1, 0.5)],
    standstill_s=1.5,
)


def test_the_spline_passes_through_its_waypoints() -> None:
    trajectory = Trajectory(path((0, 1, 2, 3, 0), (2, 4, 2, 3, 90), (5, 4, 9, 2, -180 + 360)))
    poses = trajectory.poses(np.array([0.0, 2.0, 5.0]))
    expected = [[1, 2, 3], [4, 2, 3], [4, 9, 2]]
    np.testing.assert_allclose(poses.position_m, expected, atol=1e-12)
    # x of the body: ahead, to the left, back.
    ahead = [[1, 0, 0], [0, 1, 0], [-1, 0, 0]]
    np.testing.assert_allclose(poses.rotation[:, :, 0], ahead, atol=1e-12)


def test_without_yaw_the_body_looks_ahead() -> None:
    poses = Trajectory(path((0, 0, 0, 0), (1, 1, 1, 0), (2, 2, 2, 0))).poses(np.array([0.5]))
    np.testing.assert_allclose(poses.rotation[0, :, 0], np.array([1, 1, 0]) / math.sqrt(2))
    np.testing.assert_allclose(poses.velocity[0], [1, 1, 0], atol=1e-12)


def test_a_second_derivative_is_that_of_a_natural_spline() -> None:
    """Through (0, 0), (1, 1), (2, 0) it is 1.5 t - 0.5 t^3 on the first half."""
    spline = Spline(np.array([0.0, 1.0, 2.0]), np.array([[0.0], [1.0], [0.0]]))
    value, first, second = spline(np.array([0.5]))
    assert value[0, 0] == pytest.approx(1.5 * 0.5 - 0.5 * 0.125)
    assert first[0, 0] == pytest.approx(1.5 - 1.5 * 0.25)
    assert second[0, 0] == pytest.approx(-1.5)


def test_rates_are_those_of_the_poses() -> None:
    """Central differences of positions and rotations, over standstill, ramp and drive."""
    times = np.linspace(0.2, 12.0, 60)
    step = 1e-5
    here, later, earlier = (WINDING.poses(times + shift) for shift in (0.0, step, -step))
    velocity = (later.position_m - earlier.position_m) / (2 * step)
    np.testing.assert_allclose(here.velocity, velocity, atol=1e-6)
    acceleration = (later.velocity - earlier.velocity) / (2 * step)
    np.testing.assert_allclose(here.acceleration, acceleration, atol=1e-4)
    change = np.einsum("nji,njk->nik", here.rotation, later.rotation - earlier.rotation)
    change /= 2 * step
    rate = np.stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]], axis=1)
    np.testing.assert_allclose(here.angular_velocity, rate, atol=1e-6)


def test_the_body_stands_and_then_reaches_full_speed() -> None:
    trajectory = Trajectory(path((0, 0, 0, 0, 0), (10, 20, 0, 0, 0)), standstill_s=3.0)
    poses = trajectory.poses(np.array([0.0, 2.9, 3.0, 3.0 + RAMP_S / 2, 3.0 + RAMP_S, 6.0]))
    np.testing.assert_allclose(poses.velocity[:, 0], [0, 0, 0, 1.0, 2.0, 2.0], atol=1e-12)
    # Half of the ramp is lost.
    assert poses.position_m[5, 0] == pytest.approx(2.0 * (3.0 - RAMP_S / 2))
    assert trajectory.end_s == pytest.approx(13.0 + RAMP_S / 2)


def circle(time_s: F64Array) -> Trajectory:
    """2 m around the origin at 1 rad/s, looking ahead."""
    knots = np.linspace(0, 2 * math.pi, 400)
    rows = np.column_stack([2 * np.cos(knots), 2 * np.sin(knots), 0 * knots])
    return Trajectory(path_from_waypoints(knots, rows, knots + math.pi / 2))


def test_an_imu_at_rest_feels_gravity() -> None:
    tilted = np.eye(4)
    # x of the IMU points up.
    tilted[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    force, rate = Trajectory(path((0, 0, 0, 0, 0))).inertial(np.array([1.0]), tilted)
    np.testing.assert_allclose(force, [[STANDARD_GRAVITY, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(rate, [[0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("arm", "radius"),
    [((0.0, 0.0, 0.0), 2.0), ((0.0, 0.5, 0.0), 1.5), ((0.0, -1.0, 0.3), 3.0)],
)
def test_an_imu_on_a_circle_feels_what_its_own_place_does(
    arm: tuple[float, float, float], radius: float
) -> None:
    """The centre is to the left: centripetal acceleration of its own radius, at 1 rad/s."""
    place = np.eye(4)
    place[:3, 3] = arm
    times = np.array([2.0, 3.0, 4.0])
    force, rate = circle(times).inertial(times, place)
    np.testing.assert_allclose(force, UP + [[0, radius, 0]] * 3, atol=2e-3)
    np.testing.assert_allclose(rate, [[0, 0, 1]] * 3, atol=1e-5)


def test_the_specific_force_is_that_of_the_place_of_the_imu() -> None:
    """Second differences of the IMU's own position, in its frame, plus gravity."""
    place = np.eye(4)
    place[:3, 3] = 0.4, -0.7, 0.9
    times = np.linspace(2.7, 11.0, 40)
    step = 1e-3
    tracks = []
    for shift in (-step, 0.0, step):
        poses = WINDING.poses(times + shift)
        tracks.append(poses.position_m + poses.rotation @ place[:3, 3])
    felt = (tracks[0] - 2 * tracks[1] + tracks[2]) / step**2 + UP
    expected = np.einsum("nji,nj->ni", WINDING.poses(times).rotation, felt)
    force, _ = WINDING.inertial(times, place)
    np.testing.assert_allclose(force, expected, atol=2e-3)
