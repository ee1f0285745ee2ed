"""Points of the AT128, whose rotor carries three mirrors (docs/sources/hesai.md section 6).

Each mirror has a range of rotor angles that begins at its start. A beam leaves at azimuth 2 (rotor
- start) - azimuth[channel] and elevation[channel], both corrected by tables over the rotor angle,
interpolated linearly between steps of 2 deg. So the beams follow no cones, and directions are
computed for every beam of every column, at the rotor angle of its firing (`native/decode.c`). All
beams of a column belong to one mirror, since the ranges of mirrors meet outside the field of view.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F32Array, F64Array
from mlbatch.lidar.projections import Mirrors
from mlbatch.sensors.hesai.angles import At128File


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
