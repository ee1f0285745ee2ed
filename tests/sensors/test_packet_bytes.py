"""Block times, by which models are distinguished."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.sensors.packet_bytes import block_time_us

HOUR_US = 3_600_000_000
# Ten packets of twelve blocks; a block takes 50 us, in which the rotor rotates by 0.36 degrees.
STAMP_US = np.arange(10) * 600
AZIMUTH = (np.arange(10)[:, None] * 12 + np.arange(12)) * 36


def test_the_time_of_a_block_by_the_speed_between_packets() -> None:
    assert block_time_us(STAMP_US, AZIMUTH, HOUR_US) == pytest.approx(50)
    # Pairs count once, lost packets do not matter, and stamps and angles may wrap.
    pairs = AZIMUTH.repeat(2, axis=1)
    assert block_time_us(STAMP_US, pairs, HOUR_US) == pytest.approx(50)
    assert block_time_us(STAMP_US[[0, 1, 5, 6]], AZIMUTH[[0, 1, 5, 6]], HOUR_US) == pytest.approx(
        50
    )
    late_us = (STAMP_US + HOUR_US - 1000) % HOUR_US
    turned = (AZIMUTH + 35_000) % 36_000
    assert block_time_us(late_us, turned, HOUR_US) == pytest.approx(50)


def test_without_a_block_time() -> None:
    rest = np.zeros_like(AZIMUTH)
    for stamps_us, azimuth in (
        (STAMP_US[:1], AZIMUTH[:1]),
        (STAMP_US[:0], AZIMUTH[:0]),
        (STAMP_US, rest),
        (STAMP_US, AZIMUTH[:, :1]),
        (np.zeros_like(STAMP_US), AZIMUTH),
    ):
        assert block_time_us(stamps_us, azimuth, HOUR_US) is None
