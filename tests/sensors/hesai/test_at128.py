"""Points of the AT128 by hand, and in plain loops (docs/sources/hesai.md section 6)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.sensors.hesai.angles import At128File
from mlbatch.sensors.hesai.sensor import at128_projection
from tests.builders.decoded import Rotor, projected, rotor_words

DEG = math.pi / 180
CHANNELS = 128
NO_FIRING = np.zeros((1, CHANNELS), np.int64)


def plain_file() -> At128File:
    """Mirrors at 30, 150, 270 deg; no azimuth; channel c at elevation c / 10 deg.

    Adjust of channel 10: azimuth 1 and 3 deg at rotor angles 60 and 62; elevation 2 deg at 358.
    """
    azimuth_adjust, elevation_adjust = np.zeros((CHANNELS, 180)), np.zeros((CHANNELS, 180))
    azimuth_adjust[10, 30], azimuth_adjust[10, 31], elevation_adjust[10, 179] = 1, 3, 2
    return At128File(
        Path("at.dat"),
        np.array([30.0, 150.0, 270.0]) * DEG,
        np.zeros(CHANNELS),
        np.arange(CHANNELS) / 10 * DEG,
        azimuth_adjust * DEG,
        elevation_adjust * DEG,
    )


def words(rotor_deg: list[float], turns_per_s: float = 0.0) -> I64Array:
    return rotor_words(np.array(rotor_deg) / 360, np.full(len(rotor_deg), turns_per_s))


def beams(file: At128File, firing_ns: I64Array = NO_FIRING) -> Rotor:
    """The beams of a file."""
    return Rotor(firing_ns, project=lambda pose: at128_projection(file, pose))


def point(rotor_deg: float, channel: int, range_m: float = 10.0) -> list[float]:
    ranges_m = np.full((1, CHANNELS), range_m, np.float32)
    found: list[float] = projected(beams(plain_file()), words([rotor_deg]), ranges_m)[
        0, channel
    ].tolist()
    return found


# (rotor, channel, azimuth, elevation) in deg, worked by hand: azimuth = 2 (rotor - start) + adjust.
BY_HAND = [
    (75.0, 0, 90.0, 0.0),
    (60.0, 0, 60.0, 0.0),
    (330.0, 100, 120.0, 10.0),
    (29.0, 0, 238.0, 0.0),
    (30.001, 0, 0.002, 0.0),
    # At a step, half and a quarter of the way to the next one, and the way there and back.
    (60.0, 10, 61.0, 1.0),
    (61.5, 10, 65.5, 1.0),
    (59.0, 10, 58.5, 1.0),
    # Elevation, over the end of the revolution.
    (358.0, 10, 176.0, 3.0),
    (359.5, 10, 179.0, 1.5),
]


@pytest.mark.parametrize(("rotor", "channel", "azimuth", "elevation"), BY_HAND)
def test_points_worked_by_hand(
    rotor: float, channel: int, azimuth: float, elevation: float
) -> None:
    flat = 10 * math.cos(elevation * DEG)
    expected = [
        flat * math.sin(azimuth * DEG),
        flat * math.cos(azimuth * DEG),
        10 * math.sin(elevation * DEG),
    ]
    assert point(rotor, channel) == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize(
    ("rotor", "rpm", "azimuth"),
    [
        # 200 rpm: 1.2 deg a ms; after 0.5 ms 0.6 deg on or back, over the step at 60 deg, where
        # channel 10 has 1 deg, and 3 at 62 deg.
        (59.9, 200, 2 * 30.5 + 1.5),
        (60.5, -200, 2 * 29.9 + 0.95),
        # Back over the start of the revolution.
        (0.3, -200, 2 * 89.7),
    ],
)
def test_beams_pass_a_step_while_firing(rotor: float, rpm: int, azimuth: float) -> None:
    firing_ns = np.full((1, CHANNELS), 500_000)
    found = projected(
        beams(plain_file(), firing_ns), words([rotor], rpm / 60), np.ones((1, CHANNELS), np.float32)
    )
    assert math.atan2(found[0, 10, 0], found[0, 10, 1]) / DEG == pytest.approx(azimuth, abs=1e-4)


def test_silent_beams_count_as_the_column_and_words_choose_the_table() -> None:
    firing_ns = np.stack([np.full(CHANNELS, -1), np.full(CHANNELS, 1_000_000)])
    encoder = rotor_words(np.full(2, 60 / 360), np.full(2, 200 / 60), np.array([0, 1]))
    found = projected(beams(plain_file(), firing_ns), encoder, np.ones((2, CHANNELS), np.float32))
    azimuth = np.arctan2(found[:, 0, 0], found[:, 0, 1]) / DEG
    assert azimuth == pytest.approx([60.0, 62.4], abs=1e-4)
