"""Points of HESAI lidars whose beams follow no cones from the axis of the rotor.

Source: docs/sources/hesai.md section 6.

`--decode optical_centre=on` (refinement 2): the centre c rotates with the rotor; a beam of unit
vector u ends k behind it, where the range r is that from the axis: k = sqrt(r^2 - p^2) - u.c with
p^2 = |c|^2 - (u.c)^2. Where ranges count from the centre itself (JT models), k is r.

The rotor of an AT128 carries three mirrors, each with a range of rotor angles that begins at its
start. A beam leaves at azimuth 2 (rotor - start) - azimuth[channel] and elevation[channel], both
corrected by tables over the rotor angle, interpolated linearly between steps of 2 deg. So
directions are computed for every beam of every column, at the rotor angle of its firing
(`native/decode.c`). All beams of a column belong to one mirror, since the ranges of mirrors meet
outside the field of view.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mlbatch.arrays import F32Array, F64Array
from mlbatch.lidar.geometry import BeamTable, Mirrors, OffAxis
from mlbatch.sensors.hesai.angles import At128File


def off_axis(on_axis: BeamTable, centre_m: F64Array, *, from_centre: bool) -> BeamTable:
    """Beams from an optical centre (3,), x right, y forward, z up."""
    right, forward, up = centre_m
    # As in `spherical`: clockwise by a, (x, y) becomes (x cos a + y sin a, y cos a - x sin a).
    origin = np.array([[[right, forward, 0.0]], [[forward, -right, 0.0]], [[0.0, 0.0, up]]])
    reach_m = np.zeros(1) if from_centre else -_along(on_axis, centre_m)
    return replace(on_axis, origin=origin, reach_m=reach_m)


def axis_ranges(on_axis: BeamTable, centre_m: F64Array, body_from_sensor: F64Array) -> OffAxis:
    """Off-axis beams whose ranges count from the axis; on_axis: in the sensor frame."""
    beams = off_axis(on_axis, centre_m, from_centre=False)
    miss_m2 = (centre_m**2).sum() - _along(on_axis, centre_m) ** 2
    return OffAxis(
        beams.moved(body_from_sensor),
        miss_m2.astype(np.float32),
        on_axis.moved(body_from_sensor).origin[2, 0].astype(np.float32),
    )


def _along(beams: BeamTable, centre_m: F64Array) -> F64Array:
    """(B,) u.c, m, constant under rotation of the rotor."""
    at_zero = beams.direction[0] + beams.direction[2]
    along: F64Array = (at_zero * centre_m).sum(axis=1)
    return along


def at128_projection(file: At128File, body_from_sensor: F64Array) -> Mirrors:
    """Ranges to points of a sensor at `body_from_sensor` (4, 4), m; x right, y forward, z up."""
    angles = (-file.azimuth_rad, file.elevation_rad)
    planes = [part for angle in angles for part in (np.cos(angle), np.sin(angle))]
    return Mirrors(
        file.start_rad,
        np.stack(planes).astype(np.float32),
        _steps(file.azimuth_adjust_rad),
        _steps(file.elevation_adjust_rad),
        body_from_sensor[:3].astype(np.float32),
    )


def _steps(adjust_rad: F64Array) -> F32Array:
    """Corrections (channels, steps) as values and changes to the next step, (2, steps, channels).

    The last step is followed by the first.
    """
    rows = adjust_rad.T
    return np.stack([rows, np.roll(rows, -1, axis=0) - rows]).astype(np.float32)
