"""Ground as a height field: bilinear cells of a square grid, and where rays meet it."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array

_MOST_STEPS = 400
_BLOCK_CELLS = 4
# A step ends a little behind a border.
_INTO_M = 1e-9
_TINY = 1e-300
# Finished rays are removed when fewer than this share are left.
_COMPACT = 0.8
_OCTAVES = 3


class Terrain:
    """Heights (n, n), m, at x = y = -half_m, -half_m + cell_m, ..., half_m; none outside."""

    def __init__(self, height_m: F64Array, cell_m: float, half_m: float) -> None:
        """Compute the cells, and the highest point of blocks of cells."""
        self.half_m = half_m
        self.cell_m = cell_m
        self.low_m = float(height_m.min())
        self.high_m = float(height_m.max())
        self._count = len(height_m) - 1
        h = height_m
        a, b, c, d = h[:-1, :-1], h[1:, :-1], h[:-1, 1:], h[1:, 1:]
        # Height a + b u + c v + d u v at (u, v) in [0, 1) of a cell.
        cells = np.stack([a, b - a, c - a, a + d - b - c], axis=0)
        self._cells = np.ascontiguousarray(cells.reshape(4, -1))
        highest = np.maximum(np.maximum(a, b), np.maximum(c, d))
        self._blocks = -(-self._count // _BLOCK_CELLS)
        self._block_m = _BLOCK_CELLS * cell_m
        self._block_high = _block_maximum(highest)

    def height(self, xy_m: F64Array) -> F64Array:
        """Return heights (n,) at points (n, 2); of the nearest cell outside."""
        cell, u, v, _ = self._cell(xy_m[:, 0], xy_m[:, 1])
        a, b, c, d = self._cells.take(cell, axis=1)
        height: F64Array = a + b * u + (c + d * u) * v
        return height

    def cast(self, origin_m: F64Array, direction: F64Array, limit_m: F64Array) -> F64Array:
        """Return distances (n,) along rays (3, n) to the ground, inf for none before limit_m (n,).

        A ray above all of a block of cells is moved to the border of the block, or to the height
        of its highest point; other rays are moved from cell to cell, and meet the surface of one
        in closed form (a quadratic equation). Rays with more than _MOST_STEPS steps have none.
        """
        found = np.full(len(limit_m), np.inf)
        begin, end = self._part_above_grid(origin_m, direction, limit_m)
        rows = np.flatnonzero(begin < end)
        rays = np.concatenate([origin_m, direction, begin[None], end[None]]).take(rows, axis=1)
        for _ in range(_MOST_STEPS):
            if not len(rows):
                break
            ox, oy, oz, dx, dy, dz, at, last = rays
            x = ox + at * dx
            y = oy + at * dy
            z = oz + at * dz
            cell, u, v, highest = self._cell(x, y)
            is_above = z > highest
            border = self._border(is_above, ((x, dx), (y, dy)))
            meets = self._meets(cell, u, v, z, rays[3:6])
            # Finished rays may still be in the table.
            done = np.flatnonzero(~is_above & (meets <= border) & (at < last))
            found[rows[done]] = at[done] + meets[done]
            with np.errstate(divide="ignore", invalid="ignore"):
                down_to = np.where(is_above & (dz < 0.0), (highest - z) / dz, np.inf)
            at += np.minimum(border, down_to) + _INTO_M
            last[done] = -1.0
            keep = np.flatnonzero(at < last)
            if len(keep) < _COMPACT * len(rows):
                rows = rows[keep]
                rays = rays.take(keep, axis=1)
        return found

    def _meets(
        self, cell: I64Array, u: F64Array, v: F64Array, z: F64Array, direction: F64Array
    ) -> F64Array:
        """Return distances of rays at height z to the surface of a cell, inf for none.

        Height above the surface: g + f t + e t t at distance t; the first root, for g > 0.
        """
        dx, dy, dz = direction
        a, b, c, d = self._cells.take(cell, axis=1)
        du = dx * (1.0 / self.cell_m)
        dv = dy * (1.0 / self.cell_m)
        gap = z - (a + b * u + (c + d * u) * v)
        f = dz - (b + d * v) * du - (c + d * u) * dv
        e = -d * du * dv
        with np.errstate(invalid="ignore", divide="ignore"):
            divisor = np.sqrt(f * f - 4.0 * e * gap) - f
            first = np.where(divisor > 0.0, 2.0 * gap / divisor, np.inf)
        return np.where(gap <= 0.0, 0.0, first)

    def _part_above_grid(
        self, origin_m: F64Array, direction: F64Array, limit_m: F64Array
    ) -> tuple[F64Array, F64Array]:
        """Return begins and ends of the parts of rays that may meet the ground."""
        begin = np.zeros(len(limit_m))
        end = limit_m.copy()
        sides = ((-self.half_m, self.half_m), (-self.half_m, self.half_m), (-np.inf, self.high_m))
        for (low, high), place, step in zip(sides, origin_m, direction, strict=True):
            inverse = 1.0 / np.where(step == 0.0, _TINY, step)
            first = (low - place) * inverse
            second = (high - place) * inverse
            np.maximum(begin, np.minimum(first, second), out=begin)
            np.minimum(end, np.maximum(first, second), out=end)
        return begin, end

    def _border(self, is_above: BoolArray, axes: tuple[tuple[F64Array, F64Array], ...]) -> F64Array:
        """Return distances to the borders of blocks, for rays above them, or of cells.

        axes: places and steps of the rays in x and y.
        """
        scale = np.where(is_above, 1.0 / self._block_m, 1.0 / self.cell_m)
        border = np.full(len(scale), np.inf)
        for place, step in axes:
            across = (place + self.half_m) * scale
            ahead = np.floor(across) + (step > 0.0) - across
            speed = step * scale
            is_still = speed == 0.0
            to_border = np.abs(ahead / np.where(is_still, 1.0, speed))
            np.minimum(border, np.where(is_still, np.inf, to_border), out=border)
        return border

    def _cell(self, x: F64Array, y: F64Array) -> tuple[I64Array, F64Array, F64Array, F64Array]:
        """Return the cells of places, where in them these are, and the highest of the block."""
        across = (x + self.half_m) * (1.0 / self.cell_m)
        up = (y + self.half_m) * (1.0 / self.cell_m)
        i = np.minimum(np.maximum(across.astype(np.int64), 0), self._count - 1)
        j = np.minimum(np.maximum(up.astype(np.int64), 0), self._count - 1)
        block = (i // _BLOCK_CELLS) * self._blocks + j // _BLOCK_CELLS
        return i * self._count + j, across - i, up - j, self._block_high[block]


def _block_maximum(values: F64Array) -> F64Array:
    """Return the largest value of each block of cells, one after the other."""
    starts = np.arange(0, len(values), _BLOCK_CELLS)
    rows = np.maximum.reduceat(values, starts, axis=0)
    return np.maximum.reduceat(rows, starts, axis=1).ravel()


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
