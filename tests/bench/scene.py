"""What the lidars of standard recordings measure, and when."""

from __future__ import annotations

from typing import Final

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.units import NS_PER_MS, NS_PER_S

# Time of the first shot.
EPOCH_NS: Final = 1_700_000_000 * NS_PER_S
REVOLUTION_NS: Final = 100 * NS_PER_MS


def scene(columns: int, channels: int) -> tuple[I64Array, I64Array]:
    """Ranges in mm, 0 for none, and reflectivities 0 to 255: (columns, channels) each."""
    random = np.random.default_rng(columns * channels)
    column = np.arange(columns)[:, None] * (2 * np.pi / columns)
    channel = np.arange(channels) * (8 / channels)
    wave = np.sin(3 * column + channel) + 0.3 * np.sin(11 * column - channel)
    range_mm = np.rint(14_000 + 9_000 * wave + random.normal(0, 15, wave.shape)).astype(np.int64)
    # No-return regions, and single shots without a return.
    sky = np.cos(5 * column + 2 * channel) > 0.85
    range_mm[sky | (random.random(wave.shape) < 0.03)] = 0
    reflectivity = np.rint(90 + 60 * wave + random.normal(0, 10, wave.shape)).astype(np.int64)
    return range_mm, np.where(range_mm > 0, reflectivity.clip(1, 255), 0)
