"""Laws of rotor words, and the sense in which beams turn; points: `test_round_trip.py`."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.lidar.geometry import BeamTable, read_rotor_words, spherical
from tests.builders.decoded import Rotor, projected, rotor_words


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
