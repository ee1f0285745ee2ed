"""Poses, their rates and what an IMU feels: hand-worked motions, and differences of poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.simulate.terrain import Terrain
from mlbatch.simulate.trajectory import (
    RAMP_S,
    Curve,
    MonotoneCurve,
    Spline,
    Sway,
    Trajectory,
    ground_along,
    path_from_waypoints,
)
from mlbatch.units import STANDARD_GRAVITY

# m/s2, upward: what an IMU at rest feels.
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def path(*rows: tuple[float, ...]) -> Curve:
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


def test_an_imu_at_rest_feels_gravity() -> None:
    tilted = np.eye(4)
    # x of the IMU points up.
    tilted[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    force, rate = Trajectory(path((0, 0, 0, 0, 0))).inertial(np.array([1.0]), tilted)
    np.testing.assert_allclose(force, [[STANDARD_GRAVITY, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(rate, [[0, 0, 0]], atol=1e-12)


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


@given(st.lists(st.tuples(st.floats(0.1, 5), st.floats(-9, 9)), min_size=1, max_size=8))
def test_a_monotone_curve_does_not_leave_the_values_of_its_knots(
    rows: list[tuple[float, float]],
) -> None:
    knots = np.cumsum([step for step, _ in rows])
    values = np.array([[value] for _, value in rows])
    curve = MonotoneCurve(knots, values)
    np.testing.assert_allclose(curve(knots)[0], values, atol=1e-12)
    for low, high, first, last in zip(knots, knots[1:], values[:, 0], values[1:, 0], strict=False):
        between = curve(np.linspace(low, high, 50))[0][:, 0]
        assert between.min() >= min(first, last) - 1e-9
        assert between.max() <= max(first, last) + 1e-9
        assert (np.diff(between) * np.sign(last - first) >= -1e-9).all()


def test_derivatives_of_a_monotone_curve_are_those_of_its_values() -> None:
    curve = MonotoneCurve(np.array([0.0, 1, 3, 4, 6]), np.array([[0.0], [2], [2], [5], [6]]))
    times, step = np.linspace(0.013, 5.987, 210), 1e-6
    (_, first, second), (high, later, _), (low, earlier, _) = (
        curve(times + shift) for shift in (0.0, step, -step)
    )
    np.testing.assert_allclose(first, (high - low) / (2 * step), atol=1e-6)
    np.testing.assert_allclose(second, (later - earlier) / (2 * step), atol=1e-4)


def test_a_monotone_curve_stands_still_between_equal_waypoints() -> None:
    rows = ((0, 0, 0, 0, 0), (4, 3, 0, 0, 0), (6, 3, 0, 0, 40), (8, 3, 0, 0, 0), (12, 0, 0, 0, 0))
    table = np.array(rows, np.float64)
    curve = path_from_waypoints(table[:, 0], table[:, 1:4], np.radians(table[:, 4]), MonotoneCurve)
    poses = Trajectory(curve).poses(np.linspace(4.0, 8.0, 41))
    assert (poses.position_m == [3, 0, 0]).all()
    assert (poses.velocity == 0).all()
    # It slews meanwhile, and no further than 40 degrees.
    heading = np.degrees(np.arctan2(poses.rotation[:, 1, 0], poses.rotation[:, 0, 0]))
    assert heading.max() == pytest.approx(40.0)
    assert heading[20] == pytest.approx(40.0)


def plane(by_x: float, by_y: float) -> Terrain:
    place = np.linspace(-20, 20, 41)
    return Terrain(1.0 + by_x * place[:, None] + by_y * place[None, :], 1.0, 20.0)


@pytest.mark.parametrize("yaw_deg", [0.0, 35.0, 90.0, -120.0])
def test_a_body_on_a_slope_is_tilted_as_the_slope_is(yaw_deg: float) -> None:
    """Its z axis is the normal of z = 1 + 0.2 x - 0.1 y, (-0.2, 0.1, 1) / |.|, at every heading."""
    curve = path((0, -3, 2, 0.5, yaw_deg), (9, 4, 1, 0.5, yaw_deg))
    ground = ground_along(curve, plane(0.2, -0.1), footprint_m=3.0)
    times = np.linspace(0, 9, 30)
    poses = Trajectory(curve, ground=ground).poses(times)
    normal = np.array([-0.2, 0.1, 1.0]) / math.sqrt(1.05)
    np.testing.assert_allclose(poses.rotation[:, :, 2], np.tile(normal, (30, 1)), atol=1e-6)
    x, y, z = poses.position_m.T
    np.testing.assert_allclose(z, 1.5 + 0.2 * x - 0.1 * y, atol=1e-2)
    # A horizontal heading along its yaw.
    ahead = poses.rotation[:, :, 0]
    np.testing.assert_allclose(np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])), yaw_deg, atol=1e-6)
