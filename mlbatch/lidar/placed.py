"""Points that are recorded with coordinates: no beams, only a rigid transform."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array


class PlacedPoints:
    """Points of the last columns read, moved into the body frame; implements `Projection`.

    Their ranges say nothing of their directions, so that the coordinates that `Lidar.read` found
    are kept for `project`. first_byte: of the planes x, y, z and intensity (float32, one value a
    slot) in a record, for compiled loops.
    """

    def __init__(self, last_read: LastRead, body_from_sensor: F64Array, first_byte: int) -> None:
        self._last_read = last_read
        self.rotation: F32Array = body_from_sensor[:3, :3].astype(np.float32)
        self.translation_m: F32Array = body_from_sensor[:3, 3].astype(np.float32)
        self.first_byte = first_byte

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """No rotor: nothing to prepare."""

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Rotate and translate, axis by axis in a fixed order; empty slots get any value."""
        reals = self._last_read.reals
        x, y, z = (reals[:, axis] for axis in range(3))
        for axis, (row, shift_m) in enumerate(zip(self.rotation, self.translation_m, strict=True)):
            moved = x * row[0]
            moved += y * row[1]
            moved += z * row[2]
            np.add(moved, shift_m, out=out[:, :, axis])


class LastRead:
    """Coordinates of the last columns read, (n, 4, slots), a view of their records."""

    def __init__(self) -> None:
        self.reals: F32Array = np.empty((0, 4, 0), np.float32)
