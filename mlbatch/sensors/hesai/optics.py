"""Off-axis optical centres of HESAI lidars: `--decode optical_centre=on`.

Source: docs/sources/hesai.md section 6, refinement 2. The centre c rotates with the rotor; a beam
of unit vector u ends k behind it, where the range r is that from the axis: k = sqrt(r^2 - p^2) -
u.c with p^2 = |c|^2 - (u.c)^2. Where ranges count from the centre itself (JT models), k is r.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.lidar.geometry import BeamTable
from mlbatch.lidar.projections import OffAxis


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
