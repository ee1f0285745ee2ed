"""Geometry of spinning lidars: six vectors per beam, one rotor angle per column or point.

    xyz = (r + reach[b]) * (cos a * U1[b] + sin a * U2[b] + U3[b])
                         + (cos a * O1[b] + sin a * O2[b] + O3[b])

Axis conventions and extrinsics are folded into the vectors once, in float64. For a pixel only
element-wise + and * of float32 in a fixed order remain (`native/decode.c`), so results depend
neither on the CPU nor on library versions. If the rotor angles are known in advance, all beams of a
column fire at the angle of its position; else each beam is at the angle of the rotor when it fires.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array

# A rotor word: angle in the low 32 bits (a revolution is 2**32), speed in the next 24 (signed,
# steps of 2**-48 revolutions/ns: up to 29.8 Hz), row of the firing table in the others.
_ANGLE_BITS = 32
_SPEED_BITS = 24
_REVOLUTION = float(1 << _ANGLE_BITS)


@dataclass(frozen=True, slots=True)
class BeamTable:
    """Geometry of a sensor's beams in one frame, float64, metres.

    direction: (3, B, 3), vectors U1, U2, U3 of every beam; origin: (3, B, 3), or (3, 1, 3) if
    shared by all beams, vectors O1, O2, O3; reach_m: (B,) or (1,), added to the range before
    projection; angle_rad: (W,), angle of every rotor position, or None if columns have rotor words
    (`read_rotor_words`).
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


def read_rotor_words(words: I64Array) -> tuple[F64Array, F64Array, I64Array]:
    """Return angle in rad, speed in rad/ns and row of the firing table of rotor words (n,)."""
    angle = angles_rad(words)
    field = (words >> _ANGLE_BITS) & ((1 << _SPEED_BITS) - 1)
    steps = (field ^ (1 << (_SPEED_BITS - 1))) - (1 << (_SPEED_BITS - 1))
    speed = (steps * (2.0**-48 * 2 * np.pi)).astype(np.float64)
    return angle, speed, words >> (_ANGLE_BITS + _SPEED_BITS)


def rotor_angles(words: I64Array) -> tuple[F32Array, F32Array]:
    """Return cosine and sine of the angles of rotor words (n,)."""
    angle_rad = angles_rad(words)
    return np.cos(angle_rad).astype(np.float32), np.sin(angle_rad).astype(np.float32)


def angles_rad(words: I64Array) -> F64Array:
    """Return the angles of rotor words (n,), rad."""
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


def _rotated(vectors: F64Array, rotation: F64Array) -> F64Array:
    """Rotate vectors (3, B, 3); sums in a fixed order, no dot product."""
    x = vectors[..., 0:1]
    y = vectors[..., 1:2]
    z = vectors[..., 2:3]
    return x * rotation[:, 0] + y * rotation[:, 1] + z * rotation[:, 2]


# -- sensors that a `BeamTable` does not describe, as data of `native/decode.c` --------------------
# float32 unless said, metres, in the body frame.


class OffAxis(NamedTuple):
    """Beams that pass the axis of the rotor at a distance, with ranges from the axis.

    beams: from the optical centre; miss_m2: (B,) square of that distance, m2; axis_m: (3,), origin
    of points that are too near for it.
    """

    beams: BeamTable
    miss_m2: F32Array
    axis_m: F32Array


class CorrectedRanges(NamedTuple):
    """Beams whose range correction depends on the position of the point (HDL-64E).

    planes: (11, B), in the order of `native.h`; pose: (3, 4) body_from_sensor.
    """

    planes: F32Array
    pose: F32Array


class Mirrors(NamedTuple):
    """Beams that leave by mirrors on the rotor (AT128).

    start_rad: (mirrors,) float64, rotor angles at which the mirrors begin; planes: (4, B), cosine
    and sine of azimuth and elevation; azimuth, elevation: (2, steps, B), corrections over the
    rotor angle, rad, and their change to the next step; pose: (3, 4) body_from_sensor.
    """

    start_rad: F64Array
    planes: F32Array
    azimuth: F32Array
    elevation: F32Array
    pose: F32Array


class PlacedPoints(NamedTuple):
    """Points that are recorded with coordinates.

    first_byte: in a record, of the planes x, y, z and intensity (float32, one value per slot);
    rotation: (3, 3); translation_m: (3,); labels_at: first byte of the labels of the points, 0:
    none; origin_m: (3,) from where ranges count, as points are recorded; None: from zero.
    """

    first_byte: int
    rotation: F32Array
    translation_m: F32Array
    labels_at: int = 0
    origin_m: F32Array | None = None


class Coordinates(NamedTuple):
    """Single points that are recorded as integers, one return after the other.

    form: number of the integers, as in `native.h`; return_bytes: of a return; intensity_at: first
    byte of the intensity in it; pose: (3, 4) float64 body_from_sensor; sines: (36000,) of whole
    hundredths of a degree.
    """

    form: int
    return_bytes: int
    intensity_at: int
    pose: F64Array
    sines: F32Array


Projection = OffAxis | CorrectedRanges | Mirrors | PlacedPoints | Coordinates
