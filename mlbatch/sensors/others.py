"""Streams of makers that this version only knows by name: no model, no calibration.

Source: facts/others.md. A stream of lidar packets is told by the word "lidar"; packets that only
accompany one go without it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mlbatch.lidar import Calibration, SensorModel
from mlbatch.types import U8Array

MAKER = ""
MODELS: tuple[SensorModel, ...] = ()
BUILT_IN: tuple[Calibration, ...] = ()
# The surest first: magic bytes and repeated flags before lengths.
_MAKERS: tuple[Callable[[int, U8Array], str | None], ...] = ()


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """No file is theirs yet."""
    return None


def describe(size: int, sample: U8Array) -> str | None:
    """Maker, model and mode of payloads (k, size), or None where no bytes prove them."""
    packets = np.atleast_2d(sample)
    if not packets.size or packets.shape[1] < size:
        return None
    packets = packets[:, :size]
    return next((text for maker in _MAKERS if (text := maker(size, packets))), None)
