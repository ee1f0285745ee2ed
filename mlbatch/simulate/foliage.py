"""Foliage: crowns and shrubs as turbid media, in which light is lost by the Beer-Lambert law.

A crown is an upright ellipsoid. A ray that enters it meets a leaf after a random distance of an
exponential distribution, and passes if that is longer than its way through the crown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.simulate.rays import NEAREST_M, Bounds, Rays

# Leaves at rest: rays from places and in directions this near to each other meet the same leaf.
_SAME_PLACE_M = 0.05
_SAME_DIRECTION = 0.004
_MIX = np.array([0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB], np.uint64)


@dataclass(frozen=True, slots=True, eq=False)
class Crowns:
    """k crowns: centre (k, 3) m, radius and half height (k,) m, extinction (k,) 1/m.

    wind_m, wind_hz, wind_phase: (k,) sinusoid of the centre, horizontal, towards the phase.
    flutters: (k,) leaves are elsewhere for each shot; otherwise the same ray meets the same leaf.
    """

    centre_m: F64Array
    radius_m: F64Array
    half_height_m: F64Array
    extinction_per_m: F64Array
    wind_m: F64Array
    wind_hz: F64Array
    wind_phase: F64Array
    reflectivity: F64Array
    flutters: BoolArray = field(kw_only=True)

    def bounds(self, time_s: tuple[float, float]) -> Bounds:
        """Return what contains the crowns at any time."""
        x, y, z = self.centre_m.T
        half = self.half_height_m
        return Bounds(np.column_stack([x, y]), self.radius_m + self.wind_m, z - half, z + half)

    def meet(
        self, index: I64Array, rays: Rays, random: np.random.Generator | None = None
    ) -> F64Array:
        """Return distances (n,) of rays (n,) to a leaf of the crowns `index` (n,); inf for none.

        random: of leaves that flutter; without, all are at rest.
        """
        x, y, z = rays.origin_m - self._centres(index, rays.time_s)
        dx, dy, dz = rays.direction
        radius = self.radius_m.take(index)
        # In units in which the ellipsoid is a sphere.
        scale = (self.radius_m / self.half_height_m).take(index)
        z = z * scale
        dz = dz * scale
        a = dx * dx + dy * dy + dz * dz
        half_b = x * dx + y * dy + z * dz
        inside = half_b * half_b - a * (x * x + y * y + z * z - radius * radius)
        root = np.sqrt(np.maximum(inside, 0.0))
        enters = np.maximum((-half_b - root) / a, NEAREST_M)
        leaves = (root - half_b) / a
        depth = self._depths(index, rays, random) / self.extinction_per_m.take(index)
        distance = enters + depth
        return np.where((inside > 0.0) & (distance < leaves), distance, np.inf)

    def _centres(self, index: I64Array, time_s: F64Array) -> F64Array:
        """Return centres (3, n), moved by the wind."""
        centre: F64Array = self.centre_m.T.take(index, axis=1)
        moving = np.flatnonzero(self.wind_m.take(index))
        if len(moving):
            own = index[moving]
            phase = self.wind_phase.take(own)
            pulse = 2.0 * math.pi * self.wind_hz.take(own)
            moved = self.wind_m.take(own) * np.sin(pulse * time_s[moving] + phase)
            centre[0, moving] += np.cos(phase) * moved
            centre[1, moving] += np.sin(phase) * moved
        return centre

    def _depths(self, index: I64Array, rays: Rays, random: np.random.Generator | None) -> F64Array:
        """Return optical depths (n,) at which rays meet a leaf: of mean 1, exponential."""
        resting = np.flatnonzero(~self.flutters.take(index)) if random else np.arange(len(index))
        depth = random.standard_exponential(len(index)) if random else np.zeros(len(index))
        if len(resting):
            chosen = rays.chosen(resting)
            depth[resting] = -np.log(_uniform(index[resting], chosen))
        return depth


def _uniform(index: I64Array, rays: Rays) -> F64Array:
    """Return numbers (n,) in (0, 1] that depend on crown, place and direction alone."""
    # A hash by multiplication (splitmix64) of whole steps.
    mixed = index.astype(np.uint64) * _MIX[0]
    for row, step in [(row, _SAME_PLACE_M) for row in range(3)] + [
        (row, _SAME_DIRECTION) for row in range(3, 6)
    ]:
        mixed ^= np.floor(rays.table[row] / step).astype(np.int64).view(np.uint64)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * _MIX[1]
        mixed = (mixed ^ (mixed >> np.uint64(27))) * _MIX[2]
        mixed ^= mixed >> np.uint64(31)
    uniform: F64Array = ((mixed >> np.uint64(11)).astype(np.float64) + 1.0) * 2.0**-53
    return uniform
