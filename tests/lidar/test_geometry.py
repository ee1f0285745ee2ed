"""Geometry: the vectors against plain trigonometry of one point, and laws of rotor words."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import F64Array
from mlbatch.frames.transforms import from_rpy_deg
from mlbatch.lidar.geometry import (
    BeamTable,
    read_rotor_words,
    spherical,
)
from tests.builders.decoded import Rotor, projected
from tests.builders.rotor import rotor_words

AZIMUTH_DEG = (0.0, 1.5, -4.2, 30.0)
ELEVATION_DEG = (-25.0, -1.0, 3.0, 15.0)
FIRING_NS = np.array([[0, 2304, 4608, 53_000], [10_000, 0, 40_000, 136_450]])
POSE = from_rpy_deg((0.3, -1.2, 2.4), (5.0, -12.0, 131.0))


def _beams(axis: str, lens_m: float = 0.0) -> BeamTable:
    direction = spherical(np.radians(AZIMUTH_DEG), np.radians(ELEVATION_DEG), axis)
    lens = spherical(np.zeros(1), np.zeros(1), axis)
    return BeamTable(direction, lens_m * lens, np.array([0.01, 0.0, -0.02, 0.5]))


def _by_hand(axis: str, beam: int, range_m: float, angle: float, lens_m: float) -> F64Array:
    """One point with scalar trigonometry: clockwise angles, forward is x or y."""
    reached = range_m + (0.01, 0.0, -0.02, 0.5)[beam]
    azimuth = angle + math.radians(AZIMUTH_DEG[beam])
    elevation = math.radians(ELEVATION_DEG[beam])
    forward = reached * math.cos(elevation) * math.cos(azimuth) + lens_m * math.cos(angle)
    right = reached * math.cos(elevation) * math.sin(azimuth) + lens_m * math.sin(angle)
    up = reached * math.sin(elevation)
    x, y = (forward, -right) if axis == "x" else (right, forward)
    return np.asarray(POSE @ np.array([x, y, up, 1.0]))[:3]


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("lens_m", [0.0, 0.035])
@pytest.mark.parametrize("rotor_hz", [0.0, 10.0, -20.0])
def test_beams_fire_while_the_rotor_moves(axis: str, lens_m: float, rotor_hz: float) -> None:
    revolutions = np.linspace(-0.3, 1.4, 41, dtype=np.float64)
    table = np.arange(41) % 2
    words = rotor_words(revolutions, np.full(41, rotor_hz), table)
    range_m = np.linspace(0.5, 120, 41 * 4).reshape(41, 4).astype(np.float32)
    points = projected(Rotor(FIRING_NS, _beams(axis, lens_m)), words, range_m, POSE)
    for column in range(41):
        for beam in range(4):
            fired_s = float(FIRING_NS[table[column], beam]) * 1e-9
            angle = 2 * math.pi * (float(revolutions[column]) + rotor_hz * fired_s)
            expected = _by_hand(axis, beam, float(range_m[column, beam]), angle, lens_m)
            # float32 at 120 m, and 136 us at 20 Hz: 8e-7 rad of the series are left out.
            allowed = 5e-5 + (1e-4 if abs(rotor_hz) > 10 else 0)
            np.testing.assert_allclose(points[column, beam], expected, atol=allowed)


def test_a_beam_to_the_right_at_a_quarter_revolution() -> None:
    """Clockwise: after a quarter of a revolution forward is right, which is -y or +x."""
    for axis, expected in (("x", (0.0, -2.0, 0.0)), ("y", (2.0, 0.0, 0.0))):
        table = BeamTable(
            spherical(np.zeros(1), np.zeros(1), axis), np.zeros((3, 1, 3)), np.zeros(1)
        )
        words = rotor_words(np.array([0.25]), np.zeros(1))
        rotor = Rotor(np.zeros((1, 1), np.int64), table)
        out = projected(rotor, words, np.full((1, 1), 2.0, np.float32))
        np.testing.assert_allclose(out[0, 0], expected, atol=1e-6)


@given(
    st.floats(-1e6, 1e6),
    st.floats(-25, 25, allow_subnormal=False),
    st.integers(min_value=0, max_value=100),
)
def test_rotor_words_are_read_back(revolutions: float, rotor_hz: float, table: int) -> None:
    angle, speed, number = read_rotor_words(
        rotor_words(np.array([revolutions]), np.array([rotor_hz]), np.array([table]))
    )
    assert number.tolist() == [table]
    away = (angle[0] / (2 * math.pi) - revolutions + 0.5) % 1 - 0.5
    assert abs(away) < 1e-9
    # Half a step of the word is 1.8e-15 revolutions per nanosecond.
    assert speed[0] == pytest.approx(2 * math.pi * rotor_hz * 1e-9, abs=2e-14)


def test_a_speed_beyond_all_rotors_is_the_largest() -> None:
    _, speed, table = read_rotor_words(rotor_words(np.zeros(2), np.array([1e9, -1e9]), 3))
    assert speed[0] == -speed[1] == pytest.approx(2 * math.pi * 29.8e-9, rel=1e-3)
    assert table.tolist() == [3, 3]
