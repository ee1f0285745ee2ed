"""Rays of a scene, and cylinders that contain its surfaces; world frame, metres, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array

# A ray does not meet what is nearer to its origin.
NEAREST_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """n rays as rows of a (7, n) table: origin x, y, z (m), unit direction x, y, z, time (s)."""

    table: F64Array

    @classmethod
    def of(cls, origin_m: F64Array, direction: F64Array, time_s: F64Array) -> Rays:
        """Return rays of origins and directions (n, 3) and times (n,) since the start."""
        table = np.empty((7, len(time_s)))
        table[:3] = origin_m.T
        table[3:6] = direction.T
        table[6] = time_s
        return cls(table)

    def chosen(self, rows: I64Array) -> Rays:
        """Return the rays of these numbers."""
        return Rays(self.table.take(rows, axis=1))

    @property
    def origin_m(self) -> F64Array:
        """Origins (3, n)."""
        return self.table[:3]

    @property
    def direction(self) -> F64Array:
        """Unit vectors (3, n)."""
        return self.table[3:6]

    @property
    def time_s(self) -> F64Array:
        """Times (n,) since the start."""
        time_s: F64Array = self.table[6]
        return time_s


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Upright cylinders that contain k surfaces: centres (k, 2), radii, lowest, highest z (k,)."""

    centre_m: F64Array
    radius_m: F64Array
    low_m: F64Array
    high_m: F64Array

    def chosen(self, rows: I64Array) -> Bounds:
        """Return the cylinders of these numbers."""
        parts = (self.centre_m, self.radius_m, self.low_m, self.high_m)
        return Bounds(*(part[rows] for part in parts))
