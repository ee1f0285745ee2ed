"""Surfaces of a scene, and where rays meet them; world frame, metres, z up.

Rays are sorted by their azimuth. A surface is tested against those rays only whose azimuth can
reach its bounding circle: with hundreds of stems, each ray meets a few candidates. All pairs of a
ray and a candidate of one kind are computed at once. Arrays have coordinates as rows, which is
twice as fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.foliage import Crowns
from mlbatch.simulate.rays import NEAREST_M, Bounds, Rays
from mlbatch.simulate.terrain import Terrain

_KEYS = 65536
_KEYS_PER_RAD = _KEYS / (2.0 * math.pi)
# Azimuths are cut to whole keys.
_MARGIN_KEYS = 1.5
_TINY = 1e-300
# Crowns are met in these steps of distance.
_SHELLS_M = (-math.inf, 4.0, 8.0, 14.0, 24.0, math.inf)


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
class Swing:
    """k sinusoidal turns about axes (k, 3), unit vectors, through pivots (k, 3).

    amplitude_rad, frequency_hz, phase_rad: (k,).
    """

    pivot_m: F64Array
    axis: F64Array
    amplitude_rad: F64Array
    frequency_hz: F64Array
    phase_rad: F64Array

    def bounds(self, centre_m: F64Array, radius_m: F64Array, time_s: tuple[float, float]) -> Bounds:
        """Return what contains spheres around centres (3, k) while they swing for a short time."""
        away = centre_m - self.pivot_m.T
        angle = self._angle(np.arange(len(radius_m)), np.full(len(radius_m), 0.5 * sum(time_s)))
        middle = self.pivot_m.T + _turned(away, self.axis.T, angle)
        fastest = 2.0 * math.pi * self.frequency_hz * self.amplitude_rad
        turned = 0.5 * fastest * (time_s[1] - time_s[0])
        reach = radius_m + np.minimum(turned, 2.0) * np.sqrt(_dot(away, away))
        return Bounds(middle[:2].T, reach, middle[2] - reach, middle[2] + reach)

    def undone(self, index: I64Array, rays: Rays) -> Rays:
        """Return rays (n,) as they are seen from what swings, at rest."""
        moving = np.flatnonzero(self.amplitude_rad.take(index))
        own = index[moving]
        angle = -self._angle(own, rays.time_s[moving])
        axis = self.axis.T.take(own, axis=1)
        pivot = self.pivot_m.T.take(own, axis=1)
        table = rays.table.copy()
        table[:3, moving] = pivot + _turned(table[:3, moving] - pivot, axis, angle)
        table[3:6, moving] = _turned(table[3:6, moving], axis, angle)
        return Rays(table)

    def _angle(self, index: I64Array, time_s: F64Array) -> F64Array:
        """Return the angles (n,) of what swings at times (n,)."""
        phase = 2.0 * math.pi * self.frequency_hz.take(index) * time_s + self.phase_rad.take(index)
        angle: F64Array = self.amplitude_rad.take(index) * np.sin(phase)
        return angle


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """k boxes, rotated about z, of constant velocity; from inside, a box is a room.

    centre_m: (k, 3) at the start; size_m: (k, 3); yaw_rad; velocity_mps: (k, 3); repeat_s: a box
    returns to its first place after this time, inf for never; swing: of boxes that turn to and fro.
    """

    centre_m: F64Array
    size_m: F64Array
    yaw_rad: F64Array
    velocity_mps: F64Array
    repeat_s: F64Array
    reflectivity: F64Array
    swing: Swing | None = field(default=None, kw_only=True)

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
        radius += np.hypot(moved[0], moved[1]) + margin
        if self.swing is not None:
            return self.swing.bounds(middle, np.hypot(radius, half), time_s)
        return Bounds(middle[:2].T, radius, middle[2] - half, middle[2] + half)

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        if self.swing is not None:
            rays = self.swing.undone(index, rays)
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
    """All surfaces and leaves."""

    kinds: Sequence[Rectangles | Stems | Boxes]
    terrain: Terrain | None = None
    terrain_reflectivity: float = 0.0
    foliage: Crowns | None = None

    def cast(
        self, rays: Rays, max_range_m: float, random: np.random.Generator | None = None
    ) -> tuple[F64Array, F64Array]:
        """Return distances (n,) to what rays meet first, inf for nothing, and reflectivities (n,).

        random: of leaves that flutter; without, they are at rest.
        """
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
            met = kind.meet(index, ordered.chosen(row))
            _keep_nearest(met, row, kind.reflectivity[index], distance, reflectivity)
        if self.terrain is not None:
            found = self.terrain.cast(ordered.origin_m, ordered.direction, distance)
            hit = found < distance
            distance[hit] = found[hit]
            reflectivity[hit] = self.terrain_reflectivity
        if self.foliage is not None:
            _through_leaves(self.foliage, sight, distance, reflectivity, random)
        result = np.empty_like(distance)
        result[order] = np.where(distance < max_range_m, distance, np.inf)
        level = np.empty_like(reflectivity)
        level[order] = reflectivity
        return result, level


def _keep_nearest(
    met: F64Array, row: I64Array, level: F64Array, distance: F64Array, reflectivity: F64Array
) -> None:
    """Keep what is nearest to each ray; met, level: (n,) distances and reflectivities of `row`."""
    nearer = np.flatnonzero(met < distance[row])
    row = row[nearer]
    met = met[nearer]
    np.minimum.at(distance, row, met)
    first = met == distance[row]
    reflectivity[row[first]] = level[nearer[first]]


def _through_leaves(
    foliage: Crowns,
    sight: _Sight,
    distance: F64Array,
    reflectivity: F64Array,
    random: np.random.Generator | None,
) -> None:
    """Let leaves end rays; near crowns first, as most rays get no further."""
    bounds = foliage.bounds(sight.span_s)
    begins = sight.nearest(bounds)
    for low_m, high_m in pairwise(_SHELLS_M):
        rows = np.flatnonzero(distance > low_m)
        crowns = np.flatnonzero((begins >= low_m) & (begins < high_m))
        if len(rows) and len(crowns):
            part = sight.part(rows)
            index, row = part.candidates(bounds.chosen(crowns))
            index = crowns[index]
            met = foliage.meet(index, part.rays.chosen(row), random)
            _keep_nearest(met, rows[row], foliage.reflectivity[index], distance, reflectivity)


class _Sight:
    """Rays in the order of their azimuths, and which surfaces these can reach."""

    def __init__(self, rays: Rays, keys: F64Array, rise: F64Array, max_range_m: float) -> None:
        """keys: azimuths (n,), increasing; rise: (n,) change of height per horizontal metre."""
        self.rays = rays
        self._keys = keys
        self._rise = rise
        self._height = rays.origin_m[2]
        self._max_range_m = max_range_m
        self._centre = rays.origin_m[:2].mean(axis=1)
        away = rays.origin_m[:2] - self._centre[:, None]
        # Largest distance of an origin from the centre.
        self._spread = float(np.sqrt((away[0] * away[0] + away[1] * away[1]).max()))
        self.span_s = (float(rays.time_s.min()), float(rays.time_s.max()))

    def part(self, rows: I64Array) -> _Sight:
        """Return some of the rays, by increasing numbers."""
        rays = self.rays.chosen(rows)
        return _Sight(rays, self._keys[rows], self._rise[rows], self._max_range_m)

    def nearest(self, bounds: Bounds) -> F64Array:
        """Return horizontal distances (k,) from the origins, which no ray meets before them."""
        x, y = (bounds.centre_m - self._centre).T
        distance: F64Array = np.hypot(x, y) - bounds.radius_m - self._spread
        return distance

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


def _turned(vectors: F64Array, axis: F64Array, angle: F64Array) -> F64Array:
    """Return vectors (3, n) turned about unit axes (3, n) by angles (n,): Rodrigues' formula."""
    cosine, sine = np.cos(angle), np.sin(angle)
    across = np.cross(axis, vectors, axis=0)
    turned: F64Array = (
        vectors * cosine + across * sine + axis * (_dot(axis, vectors) * (1.0 - cosine))
    )
    return turned


def _dot(a: F64Array, b: F64Array) -> F64Array:
    """Return products of vectors (3, n)."""
    products: F64Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return products
