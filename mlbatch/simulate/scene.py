"""Surfaces of a scene, and where rays meet them; world frame, metres, z up.

Rays are sorted by their azimuth. A surface is tested against those rays only whose azimuth can
reach its bounding circle: with hundreds of stems, each ray meets a few candidates. All pairs of a
ray and a candidate of one kind are computed at once. Arrays have coordinates as rows, which is
twice as fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.terrain import Terrain

# A ray does not meet what is nearer to its origin.
NEAREST_M = 1e-6
_KEYS = 65536
_KEYS_PER_RAD = _KEYS / (2.0 * math.pi)
# Azimuths are cut to whole keys.
_MARGIN_KEYS = 1.5
_TINY = 1e-300


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


@dataclass(frozen=True, slots=True, eq=False)
class Rectangles:
    """k rectangles corner + s along + t across, s and t in [0, 1], edges at right angles."""

    corner_m: F64Array
    along_m: F64Array
    across_m: F64Array
    reflectivity: F64Array

    def bounds(self, time_s: tuple[float, float]) -> Bounds:
        """Return what contains the surfaces during a time."""
        centre = self.corner_m + 0.5 * (self.along_m + self.across_m)
        diagonals = self.along_m + self.across_m, self.along_m - self.across_m
        flat = [np.hypot(diagonal[:, 0], diagonal[:, 1]) for diagonal in diagonals]
        half = 0.5 * (np.abs(self.along_m[:, 2]) + np.abs(self.across_m[:, 2]))
        radius = 0.5 * np.maximum(*flat)
        return Bounds(centre[:, :2], radius, centre[:, 2] - half, centre[:, 2] + half)

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        along = self.along_m.T.take(index, axis=1)
        across = self.across_m.T.take(index, axis=1)
        normal = np.cross(self.along_m, self.across_m).T.take(index, axis=1)
        offset = self.corner_m.T.take(index, axis=1) - rays.origin_m
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = _dot(offset, normal) / _dot(rays.direction, normal)
            local = distance * rays.direction - offset
            s = _dot(local, along) / _dot(along, along)
            t = _dot(local, across) / _dot(across, across)
            hit = (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0) & (distance > NEAREST_M)
        return np.where(hit, distance, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Stems:
    """k upright stems: mantles of cylinders or truncated cones, without caps.

    base_m: (k, 3) centre of the lower end; height_m; radius_m, top_radius_m: at both ends.
    """

    base_m: F64Array
    height_m: F64Array
    radius_m: F64Array
    top_radius_m: F64Array
    reflectivity: F64Array

    def bounds(self, time_s: tuple[float, float]) -> Bounds:
        """Return what contains the surfaces during a time."""
        low = self.base_m[:, 2]
        radius = np.maximum(self.radius_m, self.top_radius_m)
        return Bounds(self.base_m[:, :2], radius, low, low + self.height_m)

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        x, y, z = rays.origin_m - self.base_m.T.take(index, axis=1)
        dx, dy, dz = rays.direction
        height = self.height_m[index]
        slope = ((self.top_radius_m - self.radius_m) / self.height_m)[index]
        # Radius at the height of the origin, and its change along the ray.
        radius = self.radius_m[index] + slope * z
        change = slope * dz
        a = dx * dx + dy * dy - change * change
        half_b = x * dx + y * dy - change * radius
        c = x * x + y * y - radius * radius
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(half_b * half_b - a * c)
            near = self._within((-half_b - root) / a, z, dz, height)
            far = self._within((-half_b + root) / a, z, dz, height)
        return np.minimum(near, far)

    @staticmethod
    def _within(distance: F64Array, z: F64Array, dz: F64Array, height: F64Array) -> F64Array:
        """Keep distances between both ends."""
        reached = z + distance * dz
        hit = (reached >= 0.0) & (reached <= height) & (distance > NEAREST_M)
        return np.where(hit, distance, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """k boxes, rotated about z, of constant velocity; from inside, a box is a room.

    centre_m: (k, 3) at the start; size_m: (k, 3); yaw_rad; velocity_mps: (k, 3); repeat_s: a box
    returns to its first place after this time, inf for never.
    """

    centre_m: F64Array
    size_m: F64Array
    yaw_rad: F64Array
    velocity_mps: F64Array
    repeat_s: F64Array
    reflectivity: F64Array

    def centres(self, index: I64Array, time_s: F64Array) -> F64Array:
        """Return centres (3, n) of the boxes `index` (n,) at times (n,)."""
        centre: F64Array = self.centre_m.T.take(index, axis=1)
        moving = np.flatnonzero((self.velocity_mps != 0.0).any(axis=1).take(index))
        if len(moving):
            own_s = time_s[moving]
            repeat_s = self.repeat_s[index[moving]]
            own_s = np.where(np.isfinite(repeat_s), own_s % repeat_s, own_s)
            centre[:, moving] += own_s * self.velocity_mps.T.take(index[moving], axis=1)
        return centre

    def contains(self, box: int, place_m: F64Array) -> bool:
        """Return whether a place (3,) is in a box at the start."""
        x, y, z = place_m - self.centre_m[box]
        cosine, sine = math.cos(self.yaw_rad[box]), math.sin(self.yaw_rad[box])
        own = np.array([cosine * x + sine * y, cosine * y - sine * x, z])
        return bool((np.abs(own) <= 0.5 * self.size_m[box]).all())

    def bounds(self, time_s: tuple[float, float]) -> Bounds:
        """Return what contains the surfaces during a time."""
        index = np.arange(len(self.centre_m))
        first, last = (self.centres(index, np.full(len(index), one)) for one in time_s)
        middle = 0.5 * (first + last)
        radius = 0.5 * np.hypot(self.size_m[:, 0], self.size_m[:, 1])
        moved = 0.5 * np.abs(self.velocity_mps.T) * (time_s[1] - time_s[0])
        with np.errstate(invalid="ignore"):
            laps = [np.floor_divide(one, self.repeat_s) for one in time_s]
        # A box that returns to its first place in this time may be at either end of its way.
        margin = np.where(np.isfinite(self.repeat_s) & (laps[0] != laps[1]), np.inf, 0.0)
        half = 0.5 * self.size_m[:, 2] + moved[2] + margin
        return Bounds(
            middle[:2].T,
            radius + np.hypot(moved[0], moved[1]) + margin,
            middle[2] - half,
            middle[2] + half,
        )

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        x, y, z = rays.origin_m - self.centres(index, rays.time_s)
        dx, dy, dz = rays.direction
        cosine = np.cos(self.yaw_rad)[index]
        sine = np.sin(self.yaw_rad)[index]
        half = 0.5 * self.size_m.T.take(index, axis=1)
        sides = (
            (half[0], cosine * x + sine * y, cosine * dx + sine * dy),
            (half[1], cosine * y - sine * x, cosine * dy - sine * dx),
            (half[2], z, dz),
        )
        near = np.full(len(index), -np.inf)
        far = np.full(len(index), np.inf)
        for size, place, step in sides:
            # Exact zeros would give 0 / 0 on a face.
            inverse = 1.0 / np.where(step == 0.0, _TINY, step)
            to_middle = place * inverse
            to_side = size * np.abs(inverse)
            np.maximum(near, -to_middle - to_side, out=near)
            np.minimum(far, to_side - to_middle, out=far)
        distance = np.where(near > NEAREST_M, near, far)
        return np.where((near <= far) & (far > NEAREST_M), distance, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All surfaces."""

    kinds: Sequence[Rectangles | Stems | Boxes]
    terrain: Terrain | None = None
    terrain_reflectivity: float = 0.0

    def cast(self, rays: Rays, max_range_m: float) -> tuple[F64Array, F64Array]:
        """Return distances (n,) to the first surface, inf for none, and reflectivities (n,)."""
        dx, dy, dz = rays.direction
        # Azimuths in [-pi, pi] as whole keys.
        keys = np.floor(np.arctan2(dy, dx) * _KEYS_PER_RAD)
        np.minimum(keys, _KEYS // 2 - 1, out=keys)
        # Stable sorting of 16 bits is a radix sort.
        order = keys.astype(np.int16).argsort(kind="stable")
        ordered = rays.chosen(order)
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = (dz / np.hypot(dx, dy))[order]
        sight = _Sight(ordered, keys[order], rise, max_range_m)
        distance = np.full(len(order), max_range_m)
        reflectivity = np.zeros(len(order))
        for kind in self.kinds:
            index, row = sight.candidates(kind.bounds(sight.span_s))
            found = kind.meet(index, ordered.chosen(row))
            nearer = np.flatnonzero(found < distance[row])
            row = row[nearer]
            index = index[nearer]
            found = found[nearer]
            np.minimum.at(distance, row, found)
            first = found == distance[row]
            reflectivity[row[first]] = kind.reflectivity[index[first]]
        if self.terrain is not None:
            found = self.terrain.cast(ordered.origin_m, ordered.direction, distance)
            hit = found < distance
            distance[hit] = found[hit]
            reflectivity[hit] = self.terrain_reflectivity
        result = np.empty_like(distance)
        result[order] = np.where(distance < max_range_m, distance, np.inf)
        level = np.empty_like(reflectivity)
        level[order] = reflectivity
        return result, level


class _Sight:
    """Rays in the order of their azimuths, and which surfaces these can reach."""

    def __init__(self, rays: Rays, keys: F64Array, rise: F64Array, max_range_m: float) -> None:
        """keys: azimuths (n,), increasing; rise: (n,) change of height per horizontal metre."""
        self._keys = keys
        self._rise = rise
        self._height = rays.origin_m[2]
        self._max_range_m = max_range_m
        self._centre = rays.origin_m[:2].mean(axis=1)
        away = rays.origin_m[:2] - self._centre[:, None]
        # Largest distance of an origin from the centre.
        self._spread = float(np.sqrt((away[0] * away[0] + away[1] * away[1]).max()))
        self.span_s = (float(rays.time_s.min()), float(rays.time_s.max()))

    def candidates(self, bounds: Bounds) -> tuple[I64Array, I64Array]:
        """Return pairs of a surface and a ray that may meet, by azimuth and by height."""
        x, y = (bounds.centre_m - self._centre).T
        radius = bounds.radius_m + self._spread
        distance = np.hypot(x, y)
        around = distance <= radius * (1.0 + 1e-9)
        with np.errstate(invalid="ignore", divide="ignore"):
            half = np.arcsin(np.minimum(radius / distance, 1.0)) * _KEYS_PER_RAD
        middle = np.arctan2(y, x) * _KEYS_PER_RAD
        low = np.where(around, -_KEYS, middle - half - _MARGIN_KEYS)
        high = np.where(around, _KEYS, middle + half + _MARGIN_KEYS)
        near = np.flatnonzero(distance - radius <= self._max_range_m)
        begin, count, owner = self._runs(low, high, near, near[~around[near]])
        first = np.cumsum(count) - count
        row = np.arange(int(count.sum())) + np.repeat(begin - first, count)
        index = np.repeat(owner, count)
        # Heights where the ray enters and leaves the cylinder, at the earliest and latest.
        rise = self._rise[row]
        height = self._height[row]
        with np.errstate(invalid="ignore"):
            enters = height + rise * np.maximum(distance - radius, 0.0)[index]
            leaves = height + rise * (distance + radius)[index]
            misses = np.minimum(enters, leaves) > bounds.high_m[index]
            misses |= np.maximum(enters, leaves) < bounds.low_m[index]
        hit = np.flatnonzero(~misses)
        return index[hit], row[hit]

    def _runs(
        self, low: F64Array, high: F64Array, all_rows: I64Array, narrow: I64Array
    ) -> tuple[I64Array, I64Array, I64Array]:
        """Return begins and lengths of runs of rays, and the surface of each.

        narrow: surfaces with an azimuth, which may lie on both sides of +-pi.
        """
        turns = [(0, all_rows)]
        if len(narrow):
            turns += [(-_KEYS, narrow[high[narrow] > _KEYS // 2])]
            turns += [(_KEYS, narrow[low[narrow] < -_KEYS // 2])]
        begin = [np.searchsorted(self._keys, low[rows] + turn, "left") for turn, rows in turns]
        end = [np.searchsorted(self._keys, high[rows] + turn, "right") for turn, rows in turns]
        first = np.concatenate(begin)
        return first, np.concatenate(end) - first, np.concatenate([rows for _, rows in turns])


def _dot(a: F64Array, b: F64Array) -> F64Array:
    """Return products of vectors (3, n)."""
    products: F64Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return products
