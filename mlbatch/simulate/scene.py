"""Surfaces of a scene, and where rays meet them; world frame, metres, z up.

Rays are sorted by their azimuth. A surface is tested against those rays only whose azimuth can
reach its bounding circle: with hundreds of stems, each ray meets a few candidates. All pairs of a
ray and a candidate of one kind are computed at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.simulate.terrain import Terrain

# A ray does not meet what is nearer to its origin.
NEAREST_M = 1e-6
_KEYS = 65536
# Azimuths are cut to whole keys; one more on each side.
_MARGIN_KEYS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Rays: (n, 3) origin_m and unit direction, (n,) time_s since the start."""

    origin_m: F64Array
    direction: F64Array
    time_s: F64Array


@dataclass(frozen=True, slots=True, eq=False)
class Rectangles:
    """k rectangles corner + s along + t across, s and t in [0, 1], edges at right angles."""

    corner_m: F64Array
    along_m: F64Array
    across_m: F64Array
    reflectivity: F64Array

    def circles(self, time_s: tuple[float, float]) -> tuple[F64Array, F64Array]:
        """Return (k, 2) centres and (k,) radii that contain the surfaces during a time."""
        centre = self.corner_m + 0.5 * (self.along_m + self.across_m)
        diagonals = self.along_m + self.across_m, self.along_m - self.across_m
        flat = [np.hypot(diagonal[:, 0], diagonal[:, 1]) for diagonal in diagonals]
        return centre[:, :2], 0.5 * np.maximum(*flat)

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        along = self.along_m[index]
        across = self.across_m[index]
        normal = np.cross(self.along_m, self.across_m)[index]
        offset = self.corner_m[index] - rays.origin_m
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = _dot(offset, normal) / _dot(rays.direction, normal)
            local = distance[:, None] * rays.direction - offset
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

    def circles(self, time_s: tuple[float, float]) -> tuple[F64Array, F64Array]:
        """Return (k, 2) centres and (k,) radii that contain the surfaces during a time."""
        return self.base_m[:, :2], np.maximum(self.radius_m, self.top_radius_m)

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        offset = rays.origin_m - self.base_m[index]
        dx, dy, dz = rays.direction.T
        slope = ((self.top_radius_m - self.radius_m) / self.height_m)[index]
        # Radius at the height of the origin, and its change along the ray.
        radius = self.radius_m[index] + slope * offset[:, 2]
        change = slope * dz
        a = dx * dx + dy * dy - change * change
        half_b = offset[:, 0] * dx + offset[:, 1] * dy - change * radius
        c = offset[:, 0] ** 2 + offset[:, 1] ** 2 - radius * radius
        height = self.height_m[index]
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(half_b * half_b - a * c)
            near = self._within((-half_b - root) / a, offset[:, 2], dz, height)
            far = self._within((-half_b + root) / a, offset[:, 2], dz, height)
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
        """Return centres (n, 3) of the boxes `index` (n,) at times (n,)."""
        repeat = self.repeat_s[index]
        with np.errstate(invalid="ignore"):
            own = np.where(np.isfinite(repeat), time_s % repeat, time_s)
        return self.centre_m[index] + own[:, None] * self.velocity_mps[index]

    def circles(self, time_s: tuple[float, float]) -> tuple[F64Array, F64Array]:
        """Return (k, 2) centres and (k,) radii that contain the surfaces during a time."""
        index = np.arange(len(self.centre_m))
        first, last = (self.centres(index, np.full(len(index), one))[:, :2] for one in time_s)
        radius = 0.5 * np.hypot(self.size_m[:, 0], self.size_m[:, 1])
        moved = np.hypot(*(self.velocity_mps[:, :2] * (time_s[1] - time_s[0])).T)
        with np.errstate(invalid="ignore"):
            laps = [np.floor_divide(one, self.repeat_s) for one in time_s]
        # A box that returns to its first place in this time may be at either end of its way.
        jumps = np.isfinite(self.repeat_s) & (laps[0] != laps[1])
        return 0.5 * (first + last), np.where(jumps, np.inf, radius + moved)

    def meet(self, index: I64Array, rays: Rays) -> F64Array:
        """Return distances (n,) of rays (n,) to the surfaces `index` (n,); inf where they miss."""
        offset = rays.origin_m - self.centres(index, rays.time_s)
        cosine = np.cos(self.yaw_rad)[index]
        sine = np.sin(self.yaw_rad)[index]
        half = 0.5 * self.size_m[index]
        near = np.full(len(index), -np.inf)
        far = np.full(len(index), np.inf)
        for axis in range(3):
            place, step = offset[:, axis], rays.direction[:, axis]
            if axis == 0:
                place = cosine * offset[:, 0] + sine * offset[:, 1]
                step = cosine * rays.direction[:, 0] + sine * rays.direction[:, 1]
            elif axis == 1:
                place = cosine * offset[:, 1] - sine * offset[:, 0]
                step = cosine * rays.direction[:, 1] - sine * rays.direction[:, 0]
            # Exact zeros would give 0 / 0 on a face.
            inverse = 1.0 / np.where(np.abs(step) < 1e-300, 1e-300, step)
            low = (-half[:, axis] - place) * inverse
            high = (half[:, axis] - place) * inverse
            near = np.maximum(near, np.minimum(low, high))
            far = np.minimum(far, np.maximum(low, high))
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
        order, keys, centre, spread = _sorted_by_azimuth(rays)
        ordered = Rays(rays.origin_m[order], rays.direction[order], rays.time_s[order])
        distance = np.full(len(order), max_range_m)
        reflectivity = np.zeros(len(order))
        span = (float(rays.time_s.min()), float(rays.time_s.max()))
        for kind in self.kinds:
            circle, radius = kind.circles(span)
            index, row = _candidates(keys, circle - centre, radius + spread, max_range_m)
            part = Rays(ordered.origin_m[row], ordered.direction[row], ordered.time_s[row])
            found = kind.meet(index, part)
            nearer = np.flatnonzero(found < distance[row])
            row, index, found = row[nearer], index[nearer], found[nearer]
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


def _sorted_by_azimuth(rays: Rays) -> tuple[I64Array, I64Array, F64Array, float]:
    """Return the order of rays, their keys in it, and the centre and spread of their origins."""
    azimuth = np.arctan2(rays.direction[:, 1], rays.direction[:, 0])
    keys = np.floor(azimuth * (_KEYS / (2.0 * np.pi))).astype(np.int64)
    # Stable sorting of 16 bits is a radix sort.
    order = np.clip(keys, -_KEYS // 2, _KEYS // 2 - 1).astype(np.int16).argsort(kind="stable")
    centre = rays.origin_m[:, :2].mean(axis=0)
    away = rays.origin_m[:, :2] - centre
    spread = float(np.sqrt((away * away).sum(axis=1).max()))
    return order, keys[order], centre, spread


def _candidates(
    keys: I64Array, centre: F64Array, radius: F64Array, max_range_m: float
) -> tuple[I64Array, I64Array]:
    """Return pairs of a surface and a ray whose azimuth can reach its circle.

    keys: (n,) of the sorted rays; centre: (k, 2) from the rays' centre; radius: (k,).
    """
    distance = np.hypot(centre[:, 0], centre[:, 1])
    everywhere = distance <= radius * (1.0 + 1e-9)
    with np.errstate(invalid="ignore", divide="ignore"):
        half = np.arcsin(np.minimum(radius / distance, 1.0)) * (_KEYS / (2.0 * np.pi))
    middle = np.arctan2(centre[:, 1], centre[:, 0]) * (_KEYS / (2.0 * np.pi))
    low = np.floor(np.where(everywhere, 0.0, middle - half)).astype(np.int64) - _MARGIN_KEYS
    high = np.ceil(np.where(everywhere, 0.0, middle + half)).astype(np.int64) + _MARGIN_KEYS
    low[everywhere] = -_KEYS // 2
    high[everywhere] = _KEYS // 2
    near = distance - radius <= max_range_m
    index = np.flatnonzero(near)
    begins, ends, owners = [], [], []
    for turn in (0,) if everywhere.all() else (-_KEYS, 0, _KEYS):
        chosen = index if turn == 0 else index[~everywhere[index]]
        begins.append(np.searchsorted(keys, low[chosen] + turn, "left"))
        ends.append(np.searchsorted(keys, high[chosen] + turn, "right"))
        owners.append(chosen)
    begin = np.concatenate(begins)
    count = np.concatenate(ends) - begin
    total = int(count.sum())
    first = np.cumsum(count) - count
    row = np.arange(total) + np.repeat(begin - first, count)
    return np.repeat(np.concatenate(owners), count), row


def _dot(a: F64Array, b: F64Array) -> F64Array:
    """Return products of vectors (n, 3)."""
    products: F64Array = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return products
