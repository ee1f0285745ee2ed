"""An exact scene for synthetic lidars: a hall with pillars, a ramp, a crate and the machine itself.

Body frame of the machine, metres: x forward, y left, z up, floor at z = 0. All surfaces are
rectangles or upright cylinders, so a ray meets them in closed form (plane and quadratic equation);
nothing is sampled. The law for tests: a measured point is within the sensor's range resolution
of a surface (`distance_to_surfaces`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array

Vector = tuple[float, float, float]

# A ray that starts on a surface must not meet that surface again.
NEAREST_HIT_M = 1e-9


class Surface(Protocol):
    """Something that a ray can meet."""

    @property
    def reflectivity(self) -> int:
        """Brightness that a lidar would report, 0 to 255."""
        ...

    def cast(self, origins: F64Array, directions: F64Array) -> F64Array:
        """Distances (n,) along unit rays (n, 3); inf where they miss."""
        ...

    def distance(self, points: F64Array) -> F64Array:
        """Distances (n,) of points (n, 3) from the surface, never negative."""
        ...


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Points corner + s * along + t * across, s and t in [0, 1]; edges at right angles."""

    corner: Vector
    along: Vector
    across: Vector
    reflectivity: int

    def cast(self, origins: F64Array, directions: F64Array) -> F64Array:
        """Where the ray meets the plane, if that is within both edges."""
        along = np.array(self.along)
        across = np.array(self.across)
        normal = np.cross(along, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((np.array(self.corner) - origins) @ normal) / (directions @ normal)
            local = origins + distance[:, None] * directions - np.array(self.corner)
        return _kept(distance, _within(local, along) & _within(local, across))

    def distance(self, points: F64Array) -> F64Array:
        """From the nearest point of the rectangle."""
        along = np.array(self.along)
        across = np.array(self.across)
        local = points - np.array(self.corner)
        nearest = np.zeros_like(local)
        for edge in (along, across):
            nearest += np.clip(local @ edge / (edge @ edge), 0.0, 1.0)[:, None] * edge
        return _length(local - nearest)


@dataclass(frozen=True, slots=True)
class Pillar:
    """The mantle of an upright cylinder on the floor."""

    x: float
    y: float
    radius: float
    height: float
    reflectivity: int

    def cast(self, origins: F64Array, directions: F64Array) -> F64Array:
        """The nearer root of the quadratic equation, if it is between floor and top."""
        away = origins[:, :2] - (self.x, self.y)
        flat = directions[:, :2]
        a = (flat**2).sum(axis=1)
        half_b = (away * flat).sum(axis=1)
        c = (away**2).sum(axis=1) - self.radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(half_b**2 - a * c)
            near = (-half_b - root) / a
            far = (-half_b + root) / a
        return np.minimum(
            self._within_height(near, origins, directions),
            self._within_height(far, origins, directions),
        )

    def distance(self, points: F64Array) -> F64Array:
        """From the nearest point of the mantle."""
        aside = _length(points[:, :2] - (self.x, self.y)) - self.radius
        above = points[:, 2] - np.clip(points[:, 2], 0.0, self.height)
        return np.hypot(aside, above)

    def _within_height(
        self, distance: F64Array, origins: F64Array, directions: F64Array
    ) -> F64Array:
        with np.errstate(invalid="ignore"):
            z = origins[:, 2] + distance * directions[:, 2]
            return _kept(distance, (z >= 0.0) & (z <= self.height))


@dataclass(frozen=True, slots=True)
class Scene:
    """Static surfaces."""

    surfaces: tuple[Surface, ...]

    def cast(self, origins: F64Array, directions: F64Array) -> F64Array:
        """Distances (n,) in metres along unit rays (n, 3) to the first surface; inf for no hit."""
        return np.asarray(self._distances(origins, directions).min(axis=0))

    def surface_hit(self, origins: F64Array, directions: F64Array) -> I64Array:
        """Index (n,) of the surface that each ray meets first; -1 for no hit."""
        distances = self._distances(origins, directions)
        nearest = distances.argmin(axis=0)
        return np.where(np.isfinite(distances.min(axis=0)), nearest, -1)

    def distance_to_surfaces(self, points: F64Array) -> F64Array:
        """Distances (n,) in metres of points (n, 3) from the nearest surface."""
        distances = np.stack([surface.distance(points) for surface in self.surfaces])
        return np.asarray(distances.min(axis=0))

    def _distances(self, origins: F64Array, directions: F64Array) -> F64Array:
        return np.stack([surface.cast(origins, directions) for surface in self.surfaces])


def box(low: Vector, high: Vector, reflectivity: int) -> tuple[Rectangle, ...]:
    """The four sides and the top of a box with edges along the axes."""
    x0, y0, z0 = low
    x1, y1, z1 = high
    dx = (x1 - x0, 0.0, 0.0)
    dy = (0.0, y1 - y0, 0.0)
    dz = (0.0, 0.0, z1 - z0)
    return (
        Rectangle((x0, y0, z0), dx, dz, reflectivity),
        Rectangle((x0, y1, z0), dx, dz, reflectivity),
        Rectangle((x0, y0, z0), dy, dz, reflectivity),
        Rectangle((x1, y0, z0), dy, dz, reflectivity),
        Rectangle((x0, y0, z1), dx, dy, reflectivity),
    )


def hall() -> Scene:
    """The hall of the fixtures: 20 x 14 x 5 m, the machine 8 m from its rear wall.

    The ceiling is open above x = -2..6, y = -4..4: beams that leave there give no return. The ramp
    climbs from the floor at x = 7 to 1.5 m at x = 11.
    """
    walls = (
        Rectangle((-8.0, -7.0, 0.0), (20.0, 0.0, 0.0), (0.0, 0.0, 5.0), 90),
        Rectangle((-8.0, 7.0, 0.0), (20.0, 0.0, 0.0), (0.0, 0.0, 5.0), 90),
        Rectangle((-8.0, -7.0, 0.0), (0.0, 14.0, 0.0), (0.0, 0.0, 5.0), 120),
        Rectangle((12.0, -7.0, 0.0), (0.0, 14.0, 0.0), (0.0, 0.0, 5.0), 120),
    )
    floor = (Rectangle((-8.0, -7.0, 0.0), (20.0, 0.0, 0.0), (0.0, 14.0, 0.0), 30),)
    ceiling = (
        Rectangle((-8.0, -7.0, 5.0), (6.0, 0.0, 0.0), (0.0, 14.0, 0.0), 60),
        Rectangle((6.0, -7.0, 5.0), (6.0, 0.0, 0.0), (0.0, 14.0, 0.0), 60),
        Rectangle((-2.0, -7.0, 5.0), (8.0, 0.0, 0.0), (0.0, 3.0, 0.0), 60),
        Rectangle((-2.0, 4.0, 5.0), (8.0, 0.0, 0.0), (0.0, 3.0, 0.0), 60),
    )
    pillars = tuple(Pillar(x, y, 0.4, 5.0, 160) for x in (-4.0, 6.5) for y in (-4.5, 4.5))
    ramp = (Rectangle((7.0, -2.0, 0.0), (4.0, 0.0, 1.5), (0.0, 4.0, 0.0), 45),)
    crate = box((2.5, -5.5, 0.0), (3.7, -4.5, 1.0), 200)
    machine = box(MACHINE_LOW_M, MACHINE_HIGH_M, 220)
    return Scene((*walls, *floor, *ceiling, *pillars, *ramp, *crate, *machine))


# The machine's own body; the fixture's rig excludes it with 0.1 m around.
MACHINE_LOW_M: Vector = (-1.6, -0.7, 0.0)
MACHINE_HIGH_M: Vector = (1.2, 0.7, 1.8)


def _within(local: F64Array, edge: F64Array) -> BoolArray:
    with np.errstate(invalid="ignore"):
        share = local @ edge / (edge @ edge)
    within: BoolArray = (share >= 0.0) & (share <= 1.0)
    return within


def _kept(distance: F64Array, hit: BoolArray) -> F64Array:
    with np.errstate(invalid="ignore"):
        return np.where(hit & (distance > NEAREST_HIT_M), distance, np.inf)


def _length(vectors: F64Array) -> F64Array:
    lengths: F64Array = np.sqrt((vectors**2).sum(axis=1))
    return lengths
