"""Ground as a height field: bilinear cells of a square grid, and where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import F64Array, I64Array

# A ray is marched until it is this close above the ground, then the cell's plane is met.
_CLOSE_M = 2e-3
_MOST_STEPS = 400
# Steps of the final refinement, each on the cell below the ray.
_REFINEMENTS = 3
_OCTAVES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Heights (n, n), m, at x = y = -half_m, -half_m + cell_m, ..., half_m; none outside."""

    height_m: F64Array
    cell_m: float
    half_m: float
    # (cells, 4): height a + b u + c v + d u v at (u, v) in [0, 1) of a cell.
    _cells: F64Array = field(init=False)
    _slope: float = field(init=False)

    def __post_init__(self) -> None:
        """Compute the cells and the largest slope."""
        h = self.height_m
        a, b, c, d = h[:-1, :-1], h[1:, :-1], h[:-1, 1:], h[1:, 1:]
        cells = np.stack([a, b - a, c - a, a + d - b - c], axis=-1).reshape(-1, 4)
        along = np.abs(np.diff(h, axis=0)).max()
        across = np.abs(np.diff(h, axis=1)).max()
        object.__setattr__(self, "_cells", np.ascontiguousarray(cells))
        object.__setattr__(self, "_slope", float(np.hypot(along, across)) / self.cell_m)

    def height(self, xy_m: F64Array) -> F64Array:
        """Return heights (n,) at points (n, 2); of the nearest cell outside."""
        return self._below(xy_m[:, 0], xy_m[:, 1])

    def cast(self, origin_m: F64Array, direction: F64Array, limit_m: F64Array) -> F64Array:
        """Return distances (n,) along rays (n, 3) to the ground, inf for none before limit_m (n,).

        A step is so short that no slope of the field can rise above the ray within it, so that the
        first crossing is found. Source: sphere tracing, Hart 1996, for height fields.
        """
        found = np.full(len(limit_m), np.inf)
        low = float(self.height_m.min())
        high = float(self.height_m.max())
        begin, end = self._within(origin_m, direction, limit_m)
        dz = direction[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            into = (high - origin_m[:, 2]) / dz
            out_of = (low - origin_m[:, 2]) / dz
        begin = np.where(dz < 0.0, np.maximum(begin, into), begin)
        end = np.where(dz < 0.0, np.minimum(end, out_of + _CLOSE_M), np.minimum(end, into))
        level = np.abs(dz) < 1e-12
        end = np.where(level, np.where(origin_m[:, 2] <= high, limit_m, -1.0), end)
        row = np.flatnonzero(begin < end)
        flat = np.hypot(direction[:, 0], direction[:, 1])
        ox, oy, oz = (np.ascontiguousarray(part) for part in origin_m[row].T)
        dx, dy, dz = (np.ascontiguousarray(part) for part in direction[row].T)
        # Fastest approach of the ground per metre of the ray.
        inverse = 1.0 / np.maximum(self._slope * flat[row] - dz, 1e-9)
        at, last = begin[row], end[row]
        for _ in range(_MOST_STEPS):
            gap = oz + at * dz - self._below(ox + at * dx, oy + at * dy)
            near = gap <= _CLOSE_M
            found[row[near]] = at[near]
            at = at + gap * inverse
            keep = np.flatnonzero(~near & (at < last))
            if not len(keep):
                break
            row = row[keep]
            ox, oy, oz, dx, dy, dz = (part[keep] for part in (ox, oy, oz, dx, dy, dz))
            inverse, at, last = inverse[keep], at[keep], last[keep]
        return self._refined(found, origin_m, direction)

    def _refined(self, found: F64Array, origin_m: F64Array, direction: F64Array) -> F64Array:
        """Return distances at the surface of rays that are a little above it."""
        row = np.flatnonzero(np.isfinite(found))
        o, d, at = origin_m[row], direction[row], found[row]
        for _ in range(_REFINEMENTS):
            x, y = o[:, 0] + at * d[:, 0], o[:, 1] + at * d[:, 1]
            cell, u, v = self._cell(x, y)
            a, b, c, e = self._cells[cell].T
            gap = o[:, 2] + at * d[:, 2] - (a + b * u + c * v + e * u * v)
            rise = ((b + e * v) * d[:, 0] + (c + e * u) * d[:, 1]) / self.cell_m
            # Almost parallel rays stay where they are: they are close enough.
            closing = rise - d[:, 2]
            at = np.where(closing > 1e-3, at + gap / np.maximum(closing, 1e-3), at)
        found[row] = at
        return found

    def _within(
        self, origin_m: F64Array, direction: F64Array, limit_m: F64Array
    ) -> tuple[F64Array, F64Array]:
        """Return the part of each ray above the grid."""
        begin = np.zeros(len(limit_m))
        end = limit_m.copy()
        for axis in range(2):
            step = direction[:, axis]
            inverse = 1.0 / np.where(np.abs(step) < 1e-300, 1e-300, step)
            low = (-self.half_m - origin_m[:, axis]) * inverse
            high = (self.half_m - origin_m[:, axis]) * inverse
            begin = np.maximum(begin, np.minimum(low, high))
            end = np.minimum(end, np.maximum(low, high))
        return begin, end

    def _below(self, x: F64Array, y: F64Array) -> F64Array:
        """Return the heights of the ground (n,) at places (n,)."""
        cell, u, v = self._cell(x, y)
        parts = self._cells[cell]
        below: F64Array = parts[:, 0] + parts[:, 1] * u + (parts[:, 2] + parts[:, 3] * u) * v
        return below

    def _cell(self, x: F64Array, y: F64Array) -> tuple[I64Array, F64Array, F64Array]:
        """Return the cells of places, and where in them these are."""
        count = len(self.height_m) - 1
        across = (x + self.half_m) * (1.0 / self.cell_m)
        up = (y + self.half_m) * (1.0 / self.cell_m)
        i = np.clip(across.astype(np.int32), 0, count - 1)
        j = np.clip(up.astype(np.int32), 0, count - 1)
        return i * count + j, across - i, up - j


def rough_terrain(
    seed: int, half_m: float, cell_m: float, relief_m: float, wavelength_m: float
) -> Terrain:
    """Return a random field: octaves of smooth noise, heights within +-relief_m."""
    count = round(2.0 * half_m / cell_m)
    place = np.linspace(-half_m, half_m, count + 1)
    random = np.random.default_rng(seed)
    height = np.zeros((count + 1, count + 1))
    total = 0.0
    for octave in range(_OCTAVES):
        share = 0.5**octave
        height += share * _noise(random, place, wavelength_m * 0.5**octave)
        total += share
    return Terrain(height * (relief_m / total), cell_m, half_m)


def _noise(random: np.random.Generator, place: F64Array, wavelength_m: float) -> F64Array:
    """Return smooth noise (n, n) in [-1, 1]: values on a lattice, cubic steps between them."""
    knots = place / wavelength_m
    first = np.floor(knots).astype(np.int64)
    share = knots - first
    share = share * share * (3.0 - 2.0 * share)
    first -= first.min()
    values = random.uniform(-1.0, 1.0, (first.max() + 2, first.max() + 2))
    rows = values[first] * (1.0 - share)[:, None] + values[first + 1] * share[:, None]
    noise: F64Array = rows[:, first] * (1.0 - share) + rows[:, first + 1] * share
    return noise
