"""The universal form of a turning lidar: six vectors per beam, one angle per column.

    xyz = (r + reach[b]) * (cos a * U1[b] + sin a * U2[b] + U3[b])
                         + (cos a * O1[b] + sin a * O2[b] + O3[b])

Axis conventions, mounting and extrinsics are folded into the vectors once, in float64; the
directions of all encoder positions are rounded once to float32. Per pixel only element-wise + and
* in a fixed order remain, so results depend neither on the CPU nor on a library's version.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mlbatch.types import F32Array, F64Array


@dataclass(frozen=True, slots=True)
class BeamTable:
    """Geometry of a sensor's beams in one frame, float64, metres.

    direction: (3, B, 3), the vectors U1, U2, U3 of every beam; origin: (3, B, 3), or (3, 1, 3)
    where all beams share it: O1, O2, O3; reach_m: (B,) or (1,), added to the range before it is
    projected; angle_rad: (W,) angle of every encoder position.
    """

    direction: F64Array
    origin: F64Array
    reach_m: F64Array
    angle_rad: F64Array

    def moved(self, transform: F64Array) -> BeamTable:
        """The same beams in another frame; `transform` is (4, 4), new frame from old, metres."""
        rotation, translation = transform[:3, :3], transform[:3, 3]
        origin = _rotated(self.origin, rotation)
        origin[2] += translation
        return replace(self, direction=_rotated(self.direction, rotation), origin=origin)

    def directions(self) -> F32Array:
        """Directions of the beams at all encoder positions: (3, W, B) float32, a plane an axis."""
        return self._turned(self.direction)

    def origins(self) -> F32Array:
        """Origins of the beams at all encoder positions: (3, W, B or 1) float32, metres."""
        return self._turned(self.origin)

    def _turned(self, vectors: F64Array) -> F32Array:
        cosine, sine = np.cos(self.angle_rad)[:, None], np.sin(self.angle_rad)[:, None]
        turned = np.empty((3, len(self.angle_rad), vectors.shape[1]), np.float32)
        for axis in range(3):
            turned[axis] = (
                cosine * vectors[0, :, axis] + sine * vectors[1, :, axis] + vectors[2, :, axis]
            )
        return turned


def _rotated(vectors: F64Array, rotation: F64Array) -> F64Array:
    """Rotate (3, B, 3) vectors, summing in a fixed order (no dot product: see the module text)."""
    x, y, z = vectors[..., 0:1], vectors[..., 1:2], vectors[..., 2:3]
    return x * rotation[:, 0] + y * rotation[:, 1] + z * rotation[:, 2]
