"""Off-axis optical centres of HESAI lidars: `--decode optical_centre=on`.

Source: docs/sources/hesai.md section 6, refinement 2. The centre c rotates with the rotor; a beam
of unit vector u ends k behind it, where the range r is that from the axis: k = sqrt(r^2 - p^2) -
u.c with p^2 = |c|^2 - (u.c)^2. Where ranges count from the centre itself (JT models), k is r.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.lidar.geometry import BeamTable, Turning

# Closer returns are projected from the axis.
_NEAREST_M = np.float32(0.09)


def off_axis(on_axis: BeamTable, centre_m: F64Array, *, from_centre: bool) -> BeamTable:
    """Beams from an optical centre (3,), x right, y forward, z up."""
    right, forward, up = centre_m
    # As in `spherical`: clockwise by a, (x, y) becomes (x cos a + y sin a, y cos a - x sin a).
    origin = np.array([[[right, forward, 0.0]], [[forward, -right, 0.0]], [[0.0, 0.0, up]]])
    reach_m = np.zeros(1) if from_centre else -_along(on_axis, centre_m)
    return replace(on_axis, origin=origin, reach_m=reach_m)


class OffAxis:
    """`Projection` of off-axis beams whose ranges count from the axis."""

    def __init__(
        self,
        on_axis: BeamTable,
        centre_m: F64Array,
        body_from_sensor: F64Array,
        firing_ns: I64Array,
        columns: int,
    ) -> None:
        """on_axis: in the sensor frame; centre_m: (3,); columns: largest batch."""
        firing_ns = np.maximum(firing_ns, 0)
        beams = off_axis(on_axis, centre_m, from_centre=False)
        self._beams = Turning(beams.moved(body_from_sensor), firing_ns, columns)
        self._on_axis = Turning(on_axis.moved(body_from_sensor), firing_ns, columns)
        miss_m2 = (centre_m**2).sum() - _along(on_axis, centre_m) ** 2
        self._miss_m2 = miss_m2.astype(np.float32)
        self._aimed: tuple[I64Array, I64Array] = np.empty(0, np.int64), np.empty(0, np.int64)

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Prepare directions of columns."""
        self._aimed = member, encoder
        self._beams.prepare(member, encoder)

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Points (n, B, 3), m."""
        behind_m = np.maximum(range_m * range_m - self._miss_m2, np.float32(0))
        self._beams.project(np.sqrt(behind_m, out=behind_m), out)
        near = range_m <= _NEAREST_M
        near &= range_m > 0
        if near.any():
            self._on_axis.prepare(*self._aimed)
            plain = np.empty((*range_m.shape, 3), np.float32)
            self._on_axis.project(range_m, plain)
            out[near] = plain[near]


def _along(beams: BeamTable, centre_m: F64Array) -> F64Array:
    """(B,) u.c, m, constant under rotation of the rotor."""
    at_zero = beams.direction[0] + beams.direction[2]
    along: F64Array = (at_zero * centre_m).sum(axis=1)
    return along
