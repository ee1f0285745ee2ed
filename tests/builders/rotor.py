"""Rotor words of many columns; `tests/reference/headers.py` has the literal ones."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F64Array, I64Array

_MOST_SPEED = (1 << 23) - 1


def rotor_words(
    revolutions: F64Array, revolutions_per_s: F64Array | float = 0.0, table: I64Array | int = 0
) -> I64Array:
    """The `encoder` of columns of sensors without an angle table; arguments broadcast.

    revolutions: rotor angle at the stamp of the column; revolutions_per_s: its speed while the
    beams of the column fire; table: row of the column in `Lidar.firing_ns`.
    """
    ticks = (revolutions - np.floor(revolutions)) * 2.0**32
    angle = np.rint(ticks).astype(np.int64) % 2**32
    steps = np.rint(np.multiply(revolutions_per_s, 2.0**48 * 1e-9))
    speed = np.clip(steps, -_MOST_SPEED, _MOST_SPEED).astype(np.int64) % 2**24
    words: I64Array = angle | speed << 32 | np.asarray(table) << 56
    return words
