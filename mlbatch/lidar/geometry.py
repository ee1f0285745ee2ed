"""The universal form of a turning lidar: six vectors per beam, one angle per column or point.

    xyz = (r + reach[b]) * (cos a * U1[b] + sin a * U2[b] + U3[b])
                         + (cos a * O1[b] + sin a * O2[b] + O3[b])

Axis conventions, mounting and extrinsics are folded into the vectors once, in float64. Per pixel
only element-wise + and * in a fixed order remain, so results depend neither on the CPU nor on a
library's version. Where a rotor stops at known positions, the directions of all of them are
rounded once to float32 (`Tabled`); else they are made for every column, and for every beam at the
angle that the rotor has reached when it fires (`Turning`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array

# A rotor word: angle in the low 32 bits (a turn is 2**32), speed in the next 24 (signed, steps of
# 2**-48 turn/ns: up to 29.8 turns a second), number of the firing table above.
_ANGLE_BITS, _SPEED_BITS = 32, 24
_TURN = float(1 << _ANGLE_BITS)
_SPEED_PER_HZ = float(1 << 48) * 1e-9
_SPEED_LIMIT = (1 << (_SPEED_BITS - 1)) - 1


@dataclass(frozen=True, slots=True)
class BeamTable:
    """Geometry of a sensor's beams in one frame, float64, metres.

    direction: (3, B, 3), the vectors U1, U2, U3 of every beam; origin: (3, B, 3), or (3, 1, 3)
    where all beams share it: O1, O2, O3; reach_m: (B,) or (1,), added to the range before it is
    projected; angle_rad: (W,) angle of every rotor position, or None where the columns of the
    sensor carry rotor words (`rotor_words`).
    """

    direction: F64Array
    origin: F64Array
    reach_m: F64Array
    angle_rad: F64Array | None = None

    def moved(self, transform: F64Array) -> BeamTable:
        """The same beams in another frame; `transform` is (4, 4), new frame from old, metres."""
        rotation, translation = transform[:3, :3], transform[:3, 3]
        origin = _rotated(self.origin, rotation)
        origin[2] += translation
        return replace(self, direction=_rotated(self.direction, rotation), origin=origin)

    def directions(self) -> F32Array:
        """Directions of the beams at all rotor positions: (3, W, B) float32, a plane an axis."""
        return self._turned(self.direction)

    def origins(self) -> F32Array:
        """Origins of the beams at all rotor positions: (3, W, B or 1) float32, metres."""
        return self._turned(self.origin)

    def _turned(self, vectors: F64Array) -> F32Array:
        angle_rad = np.zeros(1) if self.angle_rad is None else self.angle_rad
        cosine, sine = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
        # Planes of one memory, position after position, which is how they are looked up.
        rows = np.empty((len(angle_rad), 3, vectors.shape[1]), np.float32)
        turned: F32Array = rows.transpose(1, 0, 2)
        # Fresh pages for each of the terms would cost more than the sums.
        total, term = np.empty((2, *turned.shape[1:]))
        for axis in range(3):
            np.multiply(cosine, vectors[0, :, axis], out=total)
            np.multiply(sine, vectors[1, :, axis], out=term)
            np.add(total, term, out=total)
            np.add(total, vectors[2, :, axis], out=total)
            turned[axis] = total
        return turned


def spherical(
    azimuth_rad: F64Array, elevation_rad: F64Array, clockwise_from: str = "x"
) -> F64Array:
    """Vectors U1, U2, U3, (3, B, 3), of beams on a rotor that turns clockwise seen from above.

    azimuth_rad, elevation_rad: (B,), of each beam where the rotor is at zero, clockwise. Azimuth 0
    is forward, which is x (y to the left) or, with `clockwise_from="y"`, y (x to the right).
    """
    flat, up = np.cos(elevation_rad), np.sin(elevation_rad)
    forward, right, zero = flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.zeros_like(up)
    # Forward and right as the rotor turns by a: (f cos a - s sin a, s cos a + f sin a).
    if clockwise_from == "x":
        rows = ((forward, -right, zero), (-right, -forward, zero), (zero, zero, up))
    else:
        rows = ((right, forward, zero), (forward, -right, zero), (zero, zero, up))
    return np.stack([np.stack(row, axis=-1) for row in rows])


def rotor_words(turns: F64Array, turns_per_s: F64Array, table: I64Array | int = 0) -> I64Array:
    """What `Heads.encoder` holds for sensors without a table of angles; arrays that broadcast.

    turns: angle of the rotor at the column's stamp, in turns (any whole number of them is left
    out); turns_per_s: its speed while the column's beams fire, 0 where it is not to count; table:
    number of the column's row in `Lidar.firing_ns`.
    """
    ticks = turns - np.floor(turns)
    ticks *= _TURN
    angle = np.rint(ticks, out=ticks).astype(np.int64)
    angle &= (1 << _ANGLE_BITS) - 1
    steps = np.rint(turns_per_s * _SPEED_PER_HZ)
    speed = np.minimum(np.maximum(steps, -_SPEED_LIMIT), _SPEED_LIMIT).astype(np.int64)
    speed &= (1 << _SPEED_BITS) - 1
    speed <<= _ANGLE_BITS
    words: I64Array = angle | (speed | np.asarray(table) << (_ANGLE_BITS + _SPEED_BITS))
    return words


def read_rotor_words(words: I64Array) -> tuple[F64Array, F64Array, I64Array]:
    """Angle in rad, speed in rad/ns and firing table of rotor words (n,)."""
    angle = _angles_rad(words)
    field = (words >> _ANGLE_BITS) & ((1 << _SPEED_BITS) - 1)
    steps = (field ^ (1 << (_SPEED_BITS - 1))) - (1 << (_SPEED_BITS - 1))
    speed = (steps * (2.0**-48 * 2 * np.pi)).astype(np.float64)
    return angle, speed, words >> (_ANGLE_BITS + _SPEED_BITS)


def rotor_angles(words: I64Array) -> tuple[F32Array, F32Array]:
    """Cosine and sine of the angles of rotor words (n,)."""
    angle_rad = _angles_rad(words)
    return np.cos(angle_rad).astype(np.float32), np.sin(angle_rad).astype(np.float32)


def _angles_rad(words: I64Array) -> F64Array:
    return (rotor_ticks(words) * (2 * np.pi / _TURN)).astype(np.float64)


def rotor_ticks(words: I64Array) -> I64Array:
    """Angles of rotor words, in 2**-32 turns."""
    return words & ((1 << _ANGLE_BITS) - 1)


# Of a turn; wide enough that columns of slow lidars leave none out.
SECTORS = 120


def sectors(encoder: I64Array, positions: int | None) -> I64Array:
    """Sector of a turn, below SECTORS, in which the rotor stands; (n,).

    positions: of a turn, where these are numbered; None for rotor words.
    """
    if positions is not None:
        return encoder * SECTORS // positions
    return rotor_ticks(encoder) * SECTORS >> _ANGLE_BITS


class Projection(Protocol):
    """Ranges to points in the body frame, for columns of sensors that are decoded together."""

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Prepare for n columns; member: (n,) which of the sensors, rising; encoder: of Columns."""
        ...

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Points (n, B, 3), m, of one return of these columns; range_m: (n, B); out may stride."""
        ...


class Tabled:
    """Sensors whose rotor positions are known beforehand: directions come from a table.

    direction: (rows, 3, B), origin: (rows, 3, B or 1) float32, m, of all sensors one after the
    other; first_position: (sensors,) first row of each; reaches_m: (sensors, B or 1).
    """

    def __init__(self, tables: Sequence[BeamTable], columns: int) -> None:
        """tables: beams of each sensor, in the body frame; columns: the most aimed at once."""
        self.direction = _stacked([table.directions() for table in tables])
        self.origin = _stacked([table.origins() for table in tables])
        counts = [0 if one.angle_rad is None else len(one.angle_rad) for one in tables]
        self.first_position = np.cumsum([0, *counts[:-1]]).astype(np.int64)
        self.reaches_m = _reaches(tables)
        beams = self.direction.shape[2]
        self._taken = np.empty((columns, 3, beams), np.float32)
        self._moved = np.empty_like(self._taken)
        self._reached_m = np.empty((columns, beams), np.float32)
        self._runs: list[_Run] = []

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Look up directions and origins."""
        position = encoder + self.first_position[member]
        is_next = position[1:] - position[:-1] == 1
        is_next &= member[1:] == member[:-1]
        starts = [0, *((~is_next).nonzero()[0] + 1).tolist()]
        count = len(position)
        if len(starts) * _COLUMNS_OF_A_RUN > count + _COLUMNS_OF_A_RUN * len(self.reaches_m):
            towards = self.direction.take(position, axis=0, out=self._taken[:count], mode="clip")
            origin = self.origin.take(position, axis=0, mode="clip")
            reach_m = self.reaches_m[member]
            self._runs = [_Run(slice(0, count), towards, origin, reach_m)]
            return
        self._runs = []
        for begin, end in zip(starts, [*starts[1:], count], strict=True):
            first = int(position[begin])
            turn = slice(first, first + end - begin)
            reach_m = self.reaches_m[member[begin]]
            run = _Run(slice(begin, end), self.direction[turn], self.origin[turn], reach_m)
            self._runs.append(run)

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """(r + reach) * direction + origin."""
        for run in self._runs:
            count = len(run.towards)
            reached_m = np.add(range_m[run.columns], run.reach_m, out=self._reached_m[:count])
            moved = np.multiply(reached_m[:, None, :], run.towards, out=self._moved[:count])
            np.add(moved, run.origin, out=out[run.columns].transpose(0, 2, 1))


@dataclass(frozen=True, slots=True)
class _Run:
    """Columns of a sensor, and what `Tabled` looked up for them; (n, 3, B or 1), metres."""

    columns: slice
    towards: F32Array
    origin: F32Array
    reach_m: F32Array


# Positions that follow each other need not be looked up one by one, if there are enough of them.
_COLUMNS_OF_A_RUN = 32


class Turning:
    """Sensors that say their angle themselves, whose beams fire while the rotor goes on.

    direction, origin: (3 vectors, 3 axes, B) float32, and reach_m: (B,) or (1,), all of the first
    sensor; firing_ns: (T, B), the same for all.
    """

    def __init__(
        self,
        table: BeamTable,
        firing_ns: I64Array,
        columns: int,
        others: Sequence[BeamTable] = (),
    ) -> None:
        """table: beams in the body frame; firing_ns: (T, B); columns: the most aimed at once.

        others: beams of more sensors.
        """
        tables, beams = (table, *others), table.direction.shape[1]
        self._directions = [_Vectors(one.direction, columns, beams) for one in tables]
        self._origins = [_Vectors(one.origin, columns, beams) for one in tables]
        self.direction, self.origin = self._directions[0].first, self._origins[0].first
        self.origin_turns = bool(table.origin[:2].any())
        self._reaches_m = [one.reach_m.astype(np.float32) for one in tables]
        self.reach_m = self._reaches_m[0]
        self.has_reach = any(bool(one.reach_m.any()) for one in tables)
        self.firing_ns = firing_ns.astype(np.float32)
        self.fires_at_once = not firing_ns.any()
        self._repeated_ns = np.broadcast_to(self.firing_ns[0], (columns, beams)).copy()
        self._cosine, self._sine, self._turned, self._half, self._scratch = np.empty(
            (5, columns, beams), np.float32
        )
        self._towards, self._from = np.empty((2, 3, columns, beams), np.float32)
        self._aimed: list[_Aimed] = []

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Cosine and sine of every beam at the angle at which it fires; directions, origins."""
        angle, speed, table = read_rotor_words(encoder)
        count = len(encoder)
        cosine, sine = self._cosine[:count], self._sine[:count]
        cosine[:] = np.cos(angle).astype(np.float32)[:, None]
        sine[:] = np.sin(angle).astype(np.float32)[:, None]
        if not self.fires_at_once and speed.any():
            self._turn_on(cosine, sine, speed, table)
        self._aimed = []
        for number, own in enumerate(blocks(member, len(self._directions))):
            if own.start < own.stop:
                turn = (cosine[own], sine[own], self._scratch[own])
                towards = self._directions[number].turned(*turn, self._towards[:, own])
                origin = self._origins[number].turned(*turn, self._from[:, own])
                self._aimed.append(_Aimed(own, towards, origin, self._reaches_m[number]))

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """(r + reach) * direction + origin."""
        for one in self._aimed:
            own = one.columns
            moved, reached_m = self._scratch[own], range_m[own]
            if self.has_reach:
                reached_m = np.add(reached_m, one.reach_m, out=self._half[own])
            for axis, (towards, origin) in enumerate(zip(one.towards, one.origin, strict=True)):
                np.multiply(reached_m, towards, out=moved)
                np.add(moved, origin, out=out[own, :, axis])

    def _turn_on(self, cosine: F32Array, sine: F32Array, speed: F64Array, table: I64Array) -> None:
        """Add d = speed * firing to the angles of cosine and sine (n, B), without trigonometry.

        c - d (s + d c / 2) and s + d (c - d s / 2); what is left out of the series is below
        d**3 / 6: 1e-7 rad at 600 rpm and 137 us.
        """
        count = len(speed)
        one_table = len(self.firing_ns) == 1
        firing_ns = self._repeated_ns[:count] if one_table else self.firing_ns[table]
        turned, half, scratch = self._turned[:count], self._half[:count], self._scratch[:count]
        turned[:] = speed.astype(np.float32)[:, None]
        np.multiply(turned, firing_ns, out=turned)
        np.multiply(turned, np.float32(0.5), out=half)
        np.multiply(half, cosine, out=scratch)
        np.add(scratch, sine, out=scratch)
        np.multiply(scratch, turned, out=scratch)
        np.multiply(half, sine, out=half)
        np.subtract(cosine, half, out=half)
        np.multiply(half, turned, out=half)
        np.subtract(cosine, scratch, out=cosine)
        np.add(sine, half, out=sine)


@dataclass(frozen=True, slots=True)
class _Aimed:
    """Columns of a sensor, and what `Turning` made for them: planes (n, B) of each axis, metres."""

    columns: slice
    towards: list[F32Array]
    origin: list[F32Array]
    reach_m: F32Array


class _Vectors:
    """Three vectors of every beam, repeated in planes (columns, B); see `_plane`.

    first: (3 vectors, 3 axes, B) float32.
    """

    def __init__(self, vectors: F64Array, columns: int, beams: int) -> None:
        """vectors: (3, B or 1, 3)."""
        wide = np.broadcast_to(vectors, (3, beams, 3)).transpose(0, 2, 1)
        self.first = wide.astype(np.float32, order="C")
        self._turning = [
            [_plane(one[axis], columns) for one in self.first[:2]]
            if self.first[:2, axis].any()
            else None
            for axis in range(3)
        ]
        self._level = [_plane(one, columns) for one in self.first[2]]
        self._rises = [bool(one.any()) for one in self.first[2]]

    def turned(
        self, cosine: F32Array, sine: F32Array, scratch: F32Array, out: F32Array
    ) -> list[F32Array]:
        """cos * V1 + sin * V2 + V3 of each axis: (n, B); vectors that are zero are left out.

        out: (3, n, B), for the axes that turn; others may be (1, 1).
        """
        planes, count = [], len(cosine)
        for turning, level, rises, turned in zip(
            self._turning, self._level, self._rises, out, strict=True
        ):
            if turning is None:
                planes.append(level[:count])
                continue
            np.multiply(cosine, turning[0][:count], out=turned)
            np.multiply(sine, turning[1][:count], out=scratch)
            np.add(turned, scratch, out=turned)
            if rises:
                np.add(turned, level[:count], out=turned)
            planes.append(turned)
        return planes


def _plane(values: F32Array, columns: int) -> F32Array:
    """Values of the beams (B,), the same for all columns: (columns, B); (1, 1) if all are equal.

    Loops over whole planes cost a fraction of loops over the few beams of a column.
    """
    # As bits, since a zero has a sign.
    bits = values.view(np.uint32)
    if bool((bits == bits[0]).all()):
        return values[None, :1]
    return values[None].repeat(columns, axis=0)


def blocks(member: I64Array, members: int) -> list[slice]:
    """The columns of each of several sensors that lie one after the other."""
    bounds = np.searchsorted(member, np.arange(members + 1)).tolist()
    return [slice(begin, end) for begin, end in pairwise(bounds)]


def _reaches(tables: Sequence[BeamTable]) -> F32Array:
    return np.stack(np.broadcast_arrays(*(one.reach_m for one in tables))).astype(np.float32)


def _stacked(planes: Sequence[F32Array]) -> F32Array:
    """Tables (3, W, B) of several sensors, one after the other, as (sum of W, 3, B)."""
    widest = max(plane.shape[2] for plane in planes)
    same = [np.broadcast_to(plane, (*plane.shape[:2], widest)) for plane in planes]
    return np.concatenate([plane.transpose(1, 0, 2) for plane in same])


def _rotated(vectors: F64Array, rotation: F64Array) -> F64Array:
    """Rotate (3, B, 3) vectors, summing in a fixed order (no dot product: see the module text)."""
    x, y, z = vectors[..., 0:1], vectors[..., 1:2], vectors[..., 2:3]
    return x * rotation[:, 0] + y * rotation[:, 1] + z * rotation[:, 2]
