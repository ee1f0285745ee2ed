"""Rotation and delay of a gyroscope, by turns whose law is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.arrays import F64Array, I64Array
from mlbatch.motion.agreement import Turns
from mlbatch.motion.se3 import exp_rotation, log_rotation
from mlbatch.poses.turning import gyroscope_turns, lidar_turns, turning, turns_too_little
from mlbatch.units import NS_PER_S

MIDDLE_NS = np.arange(200, dtype=np.int64) * 100_000_000 + 2_000_000_000
BIAS = np.array([0.01, -0.004, 0.006])


def turned(time_s: F64Array, axes: int) -> F64Array:
    """Integral (n, 3) of the angular velocity of a body, rad: about z, and about x, too."""
    total = np.zeros((len(time_s), 3))
    total[:, 2] = 0.6 * np.sin(0.8 * time_s) + 0.2 * np.cos(2.1 * time_s)
    if axes > 1:
        total[:, 0] = 0.1 * np.sin(1.7 * time_s)
    return total


def seen_and_felt(
    axes: int, rotation: F64Array, late_ns: int, noise_rad: float = 3e-4
) -> tuple[F64Array, Turns]:
    """Turns seen by a lidar between windows, and those of a gyroscope, 100 Hz."""
    total = turned(MIDDLE_NS / NS_PER_S, axes)
    draw = np.random.default_rng(3).normal(size=total.shape) * noise_rad
    seen = np.diff(total + draw, axis=0, prepend=np.nan)
    stamp_ns: I64Array = np.arange(2400, dtype=np.int64) * 10_000_000
    time_s: F64Array = stamp_ns / NS_PER_S
    felt = turned(time_s, axes) @ rotation + BIAS * time_s[:, None]
    return seen, Turns(stamp_ns + late_ns, felt)


@pytest.mark.parametrize("late_ns", [0, 43_000_000, -310_000_000])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rotation_bias_and_delay(seed: int, late_ns: int) -> None:
    rotation = exp_rotation(np.random.default_rng(seed).normal(size=(1, 3)) * 2.0)[0]
    found = turning(*split(seen_and_felt(2, rotation, late_ns)), "imu")
    error = log_rotation((found.rotation @ rotation.T)[None])[0]
    assert not found.undetermined
    assert not found.late_undetermined
    assert np.abs(error).max() < math.radians(0.2)
    assert (np.abs(error) < 4.0 * found.sigma_rad).all()
    assert found.delay_s == pytest.approx(late_ns * 1e-9, abs=2e-3)
    np.testing.assert_allclose(found.bias, BIAS, atol=5e-4)


def test_turns_about_one_axis_leave_the_rotation_about_it() -> None:
    rotation = exp_rotation(np.array([[0.3, -0.2, 1.0]]))[0]
    found = turning(*split(seen_and_felt(1, rotation, 20_000_000)), "imu")
    assert "turn about (0.00, 0.00, 1.00)" in found.undetermined.replace("-", "")
    assert not found.late_undetermined
    assert found.delay_s == pytest.approx(0.02, abs=2e-3)


@pytest.mark.parametrize(
    ("axes", "slower", "is_enough"), [(2, 1, True), (2, 30, False), (1, 1, False)]
)
def test_a_gyroscope_alone_says_that_it_turns_too_little(
    axes: int, slower: int, is_enough: bool
) -> None:
    """Turns about z by 26 degrees/s and about x by 7, root mean square, or a part of these."""
    _, felt = seen_and_felt(axes, np.eye(3), 0)
    found = turns_too_little(Turns(felt.stamp_ns, felt.total / slower), "imu")
    assert found == "" if is_enough else "imu: expected turns about two axes by 0.5" in found


def test_a_machine_that_does_not_turn_is_refused() -> None:
    seen, turns = seen_and_felt(2, np.eye(3), 0)
    still = np.random.default_rng(1).normal(size=seen.shape) * 3e-4
    quiet = Turns(turns.stamp_ns, 1e-5 * np.random.default_rng(2).normal(size=turns.total.shape))
    found = turning(still, MIDDLE_NS, quiet, "imu")
    assert "expected a machine that turns" in found.undetermined
    assert "expected a machine that turns" in found.late_undetermined


def test_samples_of_another_time_are_refused() -> None:
    seen, turns = seen_and_felt(2, np.eye(3), 0)
    found = turning(seen, MIDDLE_NS, Turns(turns.stamp_ns + 10**12, turns.total), "imu")
    assert "found 0" in found.undetermined


@pytest.mark.parametrize("late_s", [0.0, 0.037, -0.25])
def test_the_clock_of_another_lidar(late_s: float) -> None:
    rotation = exp_rotation(np.array([[0.3, -0.2, 1.0]]))[0]
    seen, _ = seen_and_felt(2, np.eye(3), 0)
    # What happens at a time has a stamp that is late.
    total = turned(MIDDLE_NS / NS_PER_S - late_s, 2) @ rotation
    draw = np.random.default_rng(5).normal(size=total.shape) * 3e-4
    other = np.diff(total + draw, axis=0, prepend=np.nan)
    other[60:63] = np.nan
    found = turning(seen, MIDDLE_NS, lidar_turns(other, MIDDLE_NS), "rear")
    assert not found.late_undetermined
    assert found.delay_s == pytest.approx(late_s, abs=3e-3)


def test_even_turns_do_not_tell_a_delay() -> None:
    total = np.array([0.0, 0.0, 0.3]) * (MIDDLE_NS * 1e-9)[:, None]
    draw = np.random.default_rng(5).normal(size=total.shape) * 3e-4
    seen = np.diff(total + draw, axis=0, prepend=np.nan)
    stamp_ns: I64Array = np.arange(2400, dtype=np.int64) * 10_000_000
    felt = gyroscope_turns(stamp_ns, np.tile([0.0, 0.0, 0.3], (2400, 1)))
    assert turning(seen, MIDDLE_NS, felt, "imu").late_undetermined


def split(pair: tuple[F64Array, Turns]) -> tuple[F64Array, I64Array, Turns]:
    """Arguments in the order of `turning`."""
    return pair[0], MIDDLE_NS, pair[1]
