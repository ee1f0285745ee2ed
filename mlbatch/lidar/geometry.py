"""Geometry of spinning lidars: six vectors per beam, one rotor angle per column or point.

    xyz = (r + reach[b]) * (cos a * U1[b] + sin a * U2[b] + U3[b])
                         + (cos a * O1[b] + sin a * O2[b] + O3[b])

Axis conventions and extrinsics are folded into the vectors once, in float64. For a pixel only
element-wise + and * of float32 in a fixed order remain, so results depend neither on the CPU nor on
library versions. If the rotor angles are known in advance, all beams of a column fire at the angle
of its position (`Tabled`); else each beam is at the angle of the rotor when it fires (`Turning`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array

# A rotor word: angle in the low 32 bits (a revolution is 2**32), speed in the next 24 (signed,
# steps of 2**-48 revolutions/ns: up to 29.8 Hz), row of the firing table in the others.
_ANGLE_BITS = 32
_SPEED_BITS = 24
_REVOLUTION = float(1 << _ANGLE_BITS)
SPEED_PER_HZ = float(1 << 48) * 1e-9
_SPEED_LIMIT = (1 << (_SPEED_BITS - 1)) - 1


@dataclass(frozen=True, slots=True)
class BeamTable:
    """Geometry of a sensor's beams in one frame, float64, metres.

    direction: (3, B, 3), vectors U1, U2, U3 of every beam; origin: (3, B, 3), or (3, 1, 3) if
    shared by all beams, vectors O1, O2, O3; reach_m: (B,) or (1,), added to the range before
    projection; angle_rad: (W,), angle of every rotor position, or None if columns have rotor words
    (`rotor_words`).
    """

    direction: F64Array
    origin: F64Array
    reach_m: F64Array
    angle_rad: F64Array | None = None

    def moved(self, transform: F64Array) -> BeamTable:
        """Return the beams in another frame; transform: (4, 4), new frame from old, m."""
        rotation = transform[:3, :3]
        translation = transform[:3, 3]
        origin = _rotated(self.origin, rotation)
        origin[2] += translation
        return replace(self, direction=_rotated(self.direction, rotation), origin=origin)

    def rotor(self) -> tuple[F32Array, F32Array]:
        """Return cosines and sines of all rotor positions: (W,) float32."""
        angle_rad = np.zeros(1) if self.angle_rad is None else self.angle_rad
        return np.cos(angle_rad).astype(np.float32), np.sin(angle_rad).astype(np.float32)

    def vectors(self) -> F32Array:
        """Return U1, U2, U3 of every beam: (3 vectors, 3 axes, B) float32."""
        vectors: F32Array = self.direction.transpose(0, 2, 1).astype(np.float32, order="C")
        return vectors

    def origins(self) -> F32Array:
        """Return beam origins at all rotor positions: (W, axes, B or 1) float32, m."""
        angle_rad = np.zeros(1) if self.angle_rad is None else self.angle_rad
        first, second, third = self.origin.transpose(0, 2, 1)
        cosine = np.cos(angle_rad)[:, None, None]
        sine = np.sin(angle_rad)[:, None, None]
        origins: F32Array = (cosine * first + sine * second + third).astype(np.float32)
        return origins


def spherical(
    azimuth_rad: F64Array, elevation_rad: F64Array, clockwise_from: str = "x"
) -> F64Array:
    """Return vectors U1, U2, U3, (3, B, 3), of beams on a rotor that rotates clockwise from above.

    azimuth_rad, elevation_rad: (B,), of the beams at rotor angle 0, azimuth clockwise. Azimuth 0 is
    forward: the x axis (y is left), or with `clockwise_from="y"` the y axis (x is right).
    """
    horizontal = np.cos(elevation_rad)
    up = np.sin(elevation_rad)
    forward = horizontal * np.cos(azimuth_rad)
    right = horizontal * np.sin(azimuth_rad)
    zero = np.zeros_like(up)
    # At rotor angle a: (forward cos a - right sin a, right cos a + forward sin a).
    if clockwise_from == "x":
        rows = ((forward, -right, zero), (-right, -forward, zero), (zero, zero, up))
    else:
        rows = ((right, forward, zero), (forward, -right, zero), (zero, zero, up))
    return np.stack([np.stack(row, axis=-1) for row in rows])


def rotor_words(
    revolutions: F64Array, revolutions_per_s: F64Array, table: I64Array | int = 0
) -> I64Array:
    """Return the `encoder` of columns of sensors without an angle table; arguments broadcast.

    revolutions: rotor angle at the timestamp of the column (whole revolutions are removed);
    revolutions_per_s: rotor speed while the beams of the column fire, Hz, 0 to ignore it; table:
    row of the column in `Lidar.firing_ns`.
    """
    ticks = revolutions - np.floor(revolutions)
    ticks *= _REVOLUTION
    angle = np.rint(ticks, out=ticks).astype(np.int64)
    angle &= (1 << _ANGLE_BITS) - 1
    steps = np.rint(revolutions_per_s * SPEED_PER_HZ)
    speed = np.minimum(np.maximum(steps, -_SPEED_LIMIT), _SPEED_LIMIT).astype(np.int64)
    speed &= (1 << _SPEED_BITS) - 1
    speed <<= _ANGLE_BITS
    words: I64Array = angle | (speed | np.asarray(table) << (_ANGLE_BITS + _SPEED_BITS))
    return words


def read_rotor_words(words: I64Array) -> tuple[F64Array, F64Array, I64Array]:
    """Return angle in rad, speed in rad/ns and row of the firing table of rotor words (n,)."""
    angle = _angles_rad(words)
    field = (words >> _ANGLE_BITS) & ((1 << _SPEED_BITS) - 1)
    steps = (field ^ (1 << (_SPEED_BITS - 1))) - (1 << (_SPEED_BITS - 1))
    speed = (steps * (2.0**-48 * 2 * np.pi)).astype(np.float64)
    return angle, speed, words >> (_ANGLE_BITS + _SPEED_BITS)


def rotor_angles(words: I64Array) -> tuple[F32Array, F32Array]:
    """Return cosine and sine of the angles of rotor words (n,)."""
    angle_rad = _angles_rad(words)
    return np.cos(angle_rad).astype(np.float32), np.sin(angle_rad).astype(np.float32)


def _angles_rad(words: I64Array) -> F64Array:
    return (rotor_ticks(words) * (2 * np.pi / _REVOLUTION)).astype(np.float64)


def rotor_ticks(words: I64Array) -> I64Array:
    """Return the angles of rotor words, in 2**-32 revolutions."""
    return words & ((1 << _ANGLE_BITS) - 1)


# Sectors of a revolution; wide enough that no lidar has fewer columns.
SECTORS = 120


def sectors(encoder: I64Array, positions: int | None) -> I64Array:
    """Return the sector of a revolution, below SECTORS, of rotor positions (n,).

    positions: number of positions of a revolution; None: `encoder` contains rotor words.
    """
    if positions is not None:
        return encoder * SECTORS // positions
    return rotor_ticks(encoder) * SECTORS >> _ANGLE_BITS


class Projection(Protocol):
    """Converts ranges to points in the body frame, for columns of one or more sensors."""

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Prepare n columns; member: (n,) sensor index, ascending; encoder: as in Columns."""
        ...

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Write points (n, B, 3), m, of one return; range_m: (n, B); out may have strides."""
        ...


class Tabled:
    """Sensors whose rotor angles are known in advance, one for every rotor position.

    cosine, sine: (rows,), origin: (rows, 3, B or 1) float32, m, of all sensors in sequence;
    vectors: (sensors, 3 vectors, 3 axes, B); first_position: (sensors,), first row of each;
    reaches_m: (sensors, B or 1). Columns of `prepare` may be in any order.
    """

    def __init__(self, tables: Sequence[BeamTable], columns: int) -> None:
        """tables: beams of each sensor in the body frame; columns: most in a call of `prepare`."""
        rotors = [table.rotor() for table in tables]
        self.cosine = np.concatenate([cosine for cosine, _ in rotors])
        self.sine = np.concatenate([sine for _, sine in rotors])
        self.vectors = np.stack([table.vectors() for table in tables])
        self.origin = _joined([table.origins() for table in tables])
        counts = [0 if one.angle_rad is None else len(one.angle_rad) for one in tables]
        self.first_position = np.cumsum([0, *counts[:-1]]).astype(np.int64)
        self.reaches_m = _reaches(tables)
        self._counts = counts
        self._columns = columns
        self._tables: _AngleTables | None = None

    @property
    def direction(self) -> F32Array:
        """Directions at all rotor positions, (3, rows, B) float32."""
        return self._made().direction

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Look up directions and origins."""
        self._made().look_up(encoder + self.first_position.take(member), member)

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """(r + reach) * direction + origin."""
        self._made().project(range_m, out)

    def _made(self) -> _AngleTables:
        """Return the tables, made when first asked for: compiled loops need none."""
        if self._tables is None:
            self._tables = _AngleTables(self, self._counts, self._columns)
        return self._tables


class _AngleTables:
    """Directions and origins at all rotor positions, and those of some columns; by axis.

    Planes of one axis are contiguous, so that numpy multiplies them in one loop, and not in one a
    column.
    """

    def __init__(self, tabled: Tabled, counts: Sequence[int], columns: int) -> None:
        """counts: rotor positions of each sensor; columns: most in a call of `look_up`."""
        beams = tabled.vectors.shape[3]
        self.direction: F32Array = np.empty((3, len(tabled.cosine), beams), np.float32)
        for first, count, vectors in zip(
            tabled.first_position.tolist(), counts, tabled.vectors, strict=True
        ):
            rows = slice(first, first + count)
            own = self.direction[:, rows].transpose(1, 0, 2)
            _combine(tabled.cosine[rows], tabled.sine[rows], vectors, own)
        self._origin = tabled.origin.transpose(1, 0, 2).copy()
        self._reaches_m = tabled.reaches_m
        # The same for all beams and sensors, as of most lidars: a number costs less than an array.
        one = tabled.reaches_m[:1, :1]
        self._reach_m: F32Array | None = one if bool((tabled.reaches_m == one).all()) else None
        self._scratch = np.empty((2, columns * beams * 3), np.float32)
        self._reached_m = np.empty((columns, beams), np.float32)
        self._taken = (self.direction[:, :0], self._origin[:, :0], tabled.reaches_m[:1])

    def look_up(self, position: I64Array, member: I64Array) -> None:
        """Look up the rows `position` (n,) of sensors `member` (n,), for `project`."""
        shape = (3, len(position), self.direction.shape[2])
        out = self._scratch[0, : math.prod(shape)].reshape(shape)
        direction = self.direction.take(position, axis=1, out=out, mode="clip")
        origin = self._origin.take(position, axis=1, mode="clip")
        reach_m = self._reaches_m.take(member, axis=0) if self._reach_m is None else self._reach_m
        self._taken = (direction, origin, reach_m)

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """(r + reach) * direction + origin."""
        direction, origin, reach_m = self._taken
        reached_m = np.add(range_m, reach_m, out=self._reached_m[: len(range_m)])
        moved = self._scratch[1, : direction.size].reshape(direction.shape)
        np.multiply(reached_m, direction, out=moved)
        np.add(moved, origin, out=out.transpose(2, 0, 1))


class Turning:
    """Sensors whose columns have rotor words; the rotor moves while the beams fire.

    direction, origin: (3 vectors, 3 axes, B) float32, and reach_m: (B,) or (1,), of the first
    sensor; firing_ns: (T, B), of all sensors.
    """

    def __init__(
        self,
        table: BeamTable,
        firing_ns: I64Array,
        columns: int,
        others: Sequence[BeamTable] = (),
    ) -> None:
        """table: beams of the first sensor in the body frame; others: of the other sensors.

        firing_ns: (T, B); columns: most in a call of `prepare`.
        """
        tables = (table, *others)
        beams = table.direction.shape[1]
        directions = [_vectors(one.direction, beams) for one in tables]
        origins = [_vectors(one.origin, beams) for one in tables]
        self.direction = directions[0]
        self.origin = origins[0]
        self.origin_turns = bool(table.origin[:2].any())
        reaches_m = [one.reach_m.astype(np.float32) for one in tables]
        self.reach_m = reaches_m[0]
        self.has_reach = any(bool(one.reach_m.any()) for one in tables)
        self.firing_ns = firing_ns.astype(np.float32)
        self.fires_at_once = not firing_ns.any()
        self._members = list(zip(directions, origins, reaches_m, strict=True))
        self._columns = columns
        self._planes: _RotorPlanes | None = None

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Compute directions and origins of every beam at the angle at which it fires."""
        self._made().prepare(member, encoder)

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """(r + reach) * direction + origin."""
        self._made().project(range_m, out)

    def _made(self) -> _RotorPlanes:
        """Return the planes, made when first asked for: compiled loops need none."""
        if self._planes is None:
            self._planes = _RotorPlanes(self, self._members, self._columns)
        return self._planes


class _RotorPlanes:
    """Directions and origins of some columns of `Turning`, by axis, and scratch arrays for them."""

    def __init__(
        self,
        turning: Turning,
        members: Sequence[tuple[F32Array, F32Array, F32Array]],
        columns: int,
    ) -> None:
        """members: directions, origins and reaches of each sensor; columns: as of `Turning`."""
        beams = turning.direction.shape[2]
        self._directions = [_Vectors(direction, columns) for direction, _, _ in members]
        self._origins = [_Vectors(origin, columns) for _, origin, _ in members]
        self._reaches_m = [reach_m for _, _, reach_m in members]
        self._has_reach = turning.has_reach
        self._firing_ns = turning.firing_ns
        self._fires_at_once = turning.fires_at_once
        self._repeated_ns = np.broadcast_to(self._firing_ns[0], (columns, beams)).copy()
        self._cosine = np.empty((columns, beams), np.float32)
        self._sine = np.empty((columns, beams), np.float32)
        self._delta = np.empty((columns, beams), np.float32)
        self._half = np.empty((columns, beams), np.float32)
        self._scratch = np.empty((columns, beams), np.float32)
        self._direction_planes = np.empty((3, columns, beams), np.float32)
        self._origin_planes = np.empty((3, columns, beams), np.float32)
        self._prepared: list[_Prepared] = []

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """See `Turning`."""
        angle, speed, table = read_rotor_words(encoder)
        count = len(encoder)
        cosine = self._cosine[:count]
        sine = self._sine[:count]
        cosine[:] = np.cos(angle).astype(np.float32)[:, None]
        sine[:] = np.sin(angle).astype(np.float32)[:, None]
        if not self._fires_at_once and speed.any():
            self._add_firing_angles(cosine, sine, speed, table)
        self._prepared = []
        for number, own in enumerate(blocks(member, len(self._directions))):
            if own.start < own.stop:
                angles = (cosine[own], sine[own], self._scratch[own])
                direction = self._directions[number].at(*angles, self._direction_planes[:, own])
                origin = self._origins[number].at(*angles, self._origin_planes[:, own])
                reach_m = self._reaches_m[number]
                self._prepared.append(_Prepared(own, direction, origin, reach_m))

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """See `Turning`."""
        for one in self._prepared:
            own = one.columns
            moved = self._scratch[own]
            reached_m = range_m[own]
            if self._has_reach:
                reached_m = np.add(reached_m, one.reach_m, out=self._half[own])
            planes = zip(one.direction, one.origin, strict=True)
            for axis, (direction, origin) in enumerate(planes):
                np.multiply(reached_m, direction, out=moved)
                np.add(moved, origin, out=out[own, :, axis])

    def _add_firing_angles(
        self, cosine: F32Array, sine: F32Array, speed: F64Array, table: I64Array
    ) -> None:
        """Add d = speed * firing time to the angles of cosine and sine (n, B), by a series.

        c - d (s + d c / 2) and s + d (c - d s / 2); the error is below d**3 / 6: 1e-7 rad at
        600 rpm and 137 us.
        """
        count = len(speed)
        one_table = len(self._firing_ns) == 1
        firing_ns = self._repeated_ns[:count] if one_table else self._firing_ns[table]
        delta = self._delta[:count]
        half = self._half[:count]
        scratch = self._scratch[:count]
        delta[:] = speed.astype(np.float32)[:, None]
        np.multiply(delta, firing_ns, out=delta)
        np.multiply(delta, np.float32(0.5), out=half)
        np.multiply(half, cosine, out=scratch)
        np.add(scratch, sine, out=scratch)
        np.multiply(scratch, delta, out=scratch)
        np.multiply(half, sine, out=half)
        np.subtract(cosine, half, out=half)
        np.multiply(half, delta, out=half)
        np.subtract(cosine, scratch, out=cosine)
        np.add(sine, half, out=sine)


class _Prepared(NamedTuple):
    """Columns of a sensor, and the planes (n, B) of each axis, m."""

    columns: slice
    direction: list[F32Array]
    origin: list[F32Array]
    reach_m: F32Array


class _Vectors:
    """Vectors V1, V2, V3 of every beam, repeated in planes (columns, B); see `_plane`."""

    def __init__(self, vectors: F32Array, columns: int) -> None:
        """vectors: (3 vectors, 3 axes, B)."""
        # By axis: V1 and V2, None if both are zero.
        self._rotating = [
            [_plane(one[axis], columns) for one in vectors[:2]] if vectors[:2, axis].any() else None
            for axis in range(3)
        ]
        # By axis: V3, and whether it is not zero.
        self._constant = [_plane(one, columns) for one in vectors[2]]
        self._has_constant = [bool(one.any()) for one in vectors[2]]

    def at(
        self, cosine: F32Array, sine: F32Array, scratch: F32Array, out: F32Array
    ) -> list[F32Array]:
        """Return cos * V1 + sin * V2 + V3 by axis, (n, B) each; zero vectors are skipped.

        out: (3, n, B), used for axes with V1 or V2; planes of other axes may be (1, 1).
        """
        planes = []
        count = len(cosine)
        for rotating, constant, has_constant, plane in zip(
            self._rotating, self._constant, self._has_constant, out, strict=True
        ):
            if rotating is None:
                planes.append(constant[:count])
                continue
            np.multiply(cosine, rotating[0][:count], out=plane)
            np.multiply(sine, rotating[1][:count], out=scratch)
            np.add(plane, scratch, out=plane)
            if has_constant:
                np.add(plane, constant[:count], out=plane)
            planes.append(plane)
        return planes


def _vectors(vectors: F64Array, beams: int) -> F32Array:
    """Return vectors (3, B or 1, 3) of the beams by axis: (3 vectors, 3 axes, B)."""
    wide = np.broadcast_to(vectors, (3, beams, 3)).transpose(0, 2, 1)
    by_axis: F32Array = wide.astype(np.float32, order="C")
    return by_axis


def _plane(values: F32Array, columns: int) -> F32Array:
    """Repeat values of the beams (B,) for all columns: (columns, B); (1, 1) if all are equal.

    Element-wise operations on whole planes cost a fraction of those on the beams of a column.
    """
    # Compared as bits, since a zero has a sign.
    bits = values.view(np.uint32)
    if bool((bits == bits[0]).all()):
        return values[None, :1]
    return values[None].repeat(columns, axis=0)


def blocks(member: I64Array, members: int) -> list[slice]:
    """Return the columns of each of some sensors; member: (n,), ascending."""
    bounds = np.searchsorted(member, np.arange(members + 1)).tolist()
    return [slice(begin, end) for begin, end in pairwise(bounds)]


def _reaches(tables: Sequence[BeamTable]) -> F32Array:
    return np.stack(np.broadcast_arrays(*(one.reach_m for one in tables))).astype(np.float32)


def _combine(cosine: F32Array, sine: F32Array, vectors: F32Array, out: F32Array) -> None:
    """Write cos * V1 + sin * V2 + V3, (W, 3, B), in float32; compiled loops do the same."""
    first, second, third = vectors
    np.multiply(cosine[:, None, None], first, out=out)
    out += sine[:, None, None] * second
    out += third


def _joined(tables: Sequence[F32Array]) -> F32Array:
    """Join tables (W, 3, B or 1) of some sensors to (sum of W, 3, B or 1)."""
    widest = max(table.shape[2] for table in tables)
    return np.concatenate([np.broadcast_to(one, (*one.shape[:2], widest)) for one in tables])


def _rotated(vectors: F64Array, rotation: F64Array) -> F64Array:
    """Rotate vectors (3, B, 3); sums in a fixed order, no dot product."""
    x = vectors[..., 0:1]
    y = vectors[..., 1:2]
    z = vectors[..., 2:3]
    return x * rotation[:, 0] + y * rotation[:, 1] + z * rotation[:, 2]
