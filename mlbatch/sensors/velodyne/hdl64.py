"""Points of the HDL-64E, whose range correction depends on the position of a point.

Source: docs/sources/velodyne.md section 10, the first variant (velodyne_decoder). A laser is
calibrated at 25.04 m, and again at 2.40 m to the side (x) and 1.93 m ahead (y). Below 25.04 m its
correction is interpolated linearly between the two, for each axis separately; height uses the mean
of both.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, F64Array
from mlbatch.lidar.projections import CorrectedRanges
from mlbatch.sensors.velodyne.calibration import VelodyneFile

_FAR_M = 25.04
_NEAR_RIGHT_M = 2.40
_NEAR_FORWARD_M = 1.93


def hdl64_projection(file: VelodyneFile, body_from_sensor: F64Array) -> CorrectedRanges:
    """Ranges as measured to points of a sensor at `body_from_sensor` (4, 4), m."""
    # Lasers without near values keep the far one: slope 0.
    two_points = (file.dist_correction_x_m != 0) & (file.dist_correction_y_m != 0)
    planes = (
        np.cos(file.azimuth_rad),
        np.sin(file.azimuth_rad),
        np.cos(file.elevation_rad),
        np.sin(file.elevation_rad),
        file.horiz_offset_m,
        file.vert_offset_m,
        file.dist_correction_m,
        *_line(file.dist_correction_x_m, file, two_points, _NEAR_RIGHT_M),
        *_line(file.dist_correction_y_m, file, two_points, _NEAR_FORWARD_M),
    )
    return CorrectedRanges(
        np.stack(planes).astype(np.float32), body_from_sensor[:3].astype(np.float32)
    )


def _line(
    near: F64Array, file: VelodyneFile, two_points: BoolArray, near_m: float
) -> tuple[F64Array, F64Array]:
    """Correction at 0 m and its slope, from the values at `near_m` and at 25.04 m."""
    far = file.dist_correction_m
    slope = np.where(two_points, (far - near) / (_FAR_M - near_m), 0.0)
    start = np.where(two_points, near - slope * near_m, far)
    return start, slope
