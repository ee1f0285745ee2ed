"""Points of the HDL-64E, whose range correction depends on the position of a point.

Source: docs/sources/velodyne.md section 10, the first variant (velodyne_decoder). A laser is
calibrated at 25.04 m, and again at 2.40 m to the side (x) and 1.93 m ahead (y). Below 25.04 m its
correction is interpolated linearly between the two, for each axis separately; height uses the mean
of both.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array
from mlbatch.lidar.geometry import Projection, read_rotor_words
from mlbatch.sensors.velodyne.calibration import VelodyneFile

_FAR_M = 25.04
_NEAR_RIGHT_M = 2.40
_NEAR_FORWARD_M = 1.93


class _Hdl64Projection:
    """Projection of one HDL-64E; arrays (n, 64), float32."""

    def __init__(
        self, file: VelodyneFile, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
    ) -> None:
        # Beams that do not fire (-1) have no points.
        self._firing_ns = np.maximum(firing_ns, 0).astype(np.float32)
        self._cosine_rot = np.cos(file.azimuth_rad).astype(np.float32)
        self._sine_rot = np.sin(file.azimuth_rad).astype(np.float32)
        self._flat = np.cos(file.elevation_rad).astype(np.float32)
        self._up = np.sin(file.elevation_rad).astype(np.float32)
        self._aside_m = file.horiz_offset_m.astype(np.float32)
        self._above_m = file.vert_offset_m.astype(np.float32)
        self._far = file.dist_correction_m.astype(np.float32)
        # Lasers without near values keep the far one: slope 0.
        two_points = (file.dist_correction_x_m != 0) & (file.dist_correction_y_m != 0)
        self._has_near = bool(two_points.any())
        self._right = _line(file.dist_correction_x_m, file, two_points, _NEAR_RIGHT_M)
        self._forward = _line(file.dist_correction_y_m, file, two_points, _NEAR_FORWARD_M)
        self._pose = body_from_sensor[:3].astype(np.float32)
        self._cosine = np.empty((columns, len(self._flat)), np.float32)
        self._sine = np.empty_like(self._cosine)

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Cosine and sine of every beam's azimuth when it fires; `member` is always 0.

        Rotor angle minus rot_correction plus d = speed * firing time: c - d (s + d c / 2). The
        remainder of the series is below d**3 / 6: 5e-8 rad at 1200 rpm and 57 us.
        """
        angle, speed, table = read_rotor_words(encoder)
        cosine = np.cos(angle).astype(np.float32)[:, None]
        sine = np.sin(angle).astype(np.float32)[:, None]
        first_cosine = cosine * self._cosine_rot + sine * self._sine_rot
        first_sine = sine * self._cosine_rot - cosine * self._sine_rot
        firing_ns = self._firing_ns[0] if len(self._firing_ns) == 1 else self._firing_ns[table]
        rotated = speed.astype(np.float32)[:, None] * firing_ns
        half = rotated * np.float32(0.5)
        count = len(encoder)
        np.subtract(
            first_cosine,
            rotated * (first_sine + half * first_cosine),
            out=self._cosine[:count],
        )
        np.add(first_sine, rotated * (first_cosine - half * first_sine), out=self._sine[:count])

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Correct along right, forward and up, then transform into the body frame."""
        count = len(range_m)
        cosine = self._cosine[:count]
        sine = self._sine[:count]
        to_right, to_forward, to_up = self._corrected_m(range_m, cosine, sine)
        right = to_right * self._flat * sine - self._aside_m * cosine
        forward = to_forward * self._flat * cosine + self._aside_m * sine
        up = to_up * self._up + self._above_m
        # ROS axes: x forward, y left (section 5).
        for axis, (x, y, z, moved) in enumerate(self._pose):
            np.add(x * forward - y * right + z * up, moved, out=out[..., axis])

    def _corrected_m(
        self, range_m: F32Array, cosine: F32Array, sine: F32Array
    ) -> tuple[F32Array, F32Array, F32Array]:
        """Range plus correction along right, forward and up."""
        far: F32Array = range_m + self._far
        if not self._has_near:
            return far, far, far
        flat = far * self._flat
        near_right, slope_right = self._right
        near_forward, slope_forward = self._forward
        to_right = near_right + slope_right * np.abs(flat * sine)
        to_forward = near_forward + slope_forward * np.abs(flat * cosine)
        is_near = range_m < np.float32(_FAR_M)
        half = np.float32(0.5)
        return (
            np.where(is_near, range_m + to_right, far),
            np.where(is_near, range_m + to_forward, far),
            np.where(is_near, range_m + (to_right + to_forward) * half, far),
        )


def hdl64_projection(
    file: VelodyneFile,
    firing_ns: I64Array,
    body_from_sensor: F64Array,
    columns: int,
) -> Projection:
    """Ranges as measured to points of a sensor at `body_from_sensor` (4, 4), m.

    Columns carry rotor words. firing_ns: (T, 64), as in `Lidar`; columns: largest batch.
    """
    return _Hdl64Projection(file, firing_ns, body_from_sensor, columns)


def _line(
    near: F64Array, file: VelodyneFile, two_points: BoolArray, near_m: float
) -> tuple[F32Array, F32Array]:
    """Correction at 0 m and its slope, from the values at `near_m` and at 25.04 m."""
    far = file.dist_correction_m
    slope = np.where(two_points, (far - near) / (_FAR_M - near_m), 0.0)
    start = np.where(two_points, near - slope * near_m, far)
    return start.astype(np.float32), slope.astype(np.float32)
