"""Sensors that a `BeamTable` does not describe, as data for the compiled loops.

Each type is one kind of `native/decode.c`; float32 unless said, metres, in the body frame.
"""

from __future__ import annotations

from typing import NamedTuple

from mlbatch.arrays import F32Array, F64Array
from mlbatch.lidar.geometry import BeamTable


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

    first_byte: in a record, of the planes x, y, z and intensity (float32, one value a slot);
    rotation: (3, 3); translation_m: (3,).
    """

    first_byte: int
    rotation: F32Array
    translation_m: F32Array


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
