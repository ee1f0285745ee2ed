"""Points of the AT128, whose rotor carries three mirrors (docs/sources/hesai.md section 6).

Each mirror has a range of rotor angles that begins at its start. A beam leaves at azimuth 2 (rotor
- start) - azimuth[channel] and elevation[channel], both corrected by tables over the rotor angle,
interpolated linearly between steps of 2 deg. So the beams follow no cones, and directions are
computed for every beam of every column, at the rotor angle of its firing. The change of angle
within a column is small, so no cosine is computed per pixel, see `_rotated`. All beams of a column
belong to one mirror, since the ranges of mirrors meet outside the field of view.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.lidar.geometry import Projection, read_rotor_words
from mlbatch.sensors.hesai.angles import At128File

_TURN_RAD = 2 * np.pi


class _At128Projection:
    """Projection of one AT128; sensor frame: x right, y forward, z up."""

    def __init__(
        self, file: At128File, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
    ) -> None:
        beams, steps = file.azimuth_adjust_rad.shape
        self._start_rad = file.start_rad
        self._steps_per_rad = steps / _TURN_RAD
        # Beams that do not fire (-1) have no points.
        self._firing_ns = np.maximum(firing_ns, 0).astype(np.float32)
        self._azimuth = _cosine_and_sine(-file.azimuth_rad)
        self._elevation = _cosine_and_sine(file.elevation_rad)
        self._azimuth_adjust = _AngleCorrection(file.azimuth_adjust_rad)
        self._elevation_adjust = _AngleCorrection(file.elevation_adjust_rad)
        self._beam = np.arange(beams)
        self._rotation = body_from_sensor[:3, :3].astype(np.float32)
        self._origin = body_from_sensor[:3, 3].astype(np.float32)[:, None]
        self._towards = np.empty((columns, 3, beams), np.float32)
        self._moved = np.empty_like(self._towards)

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Directions of all beams; `member` is always 0."""
        angle, speed, table = read_rotor_words(encoder)
        rotated = speed.astype(np.float32)[:, None] * self._firing_ns[table]
        cell, part = self._cell(angle, rotated)
        past = np.minimum.reduce([(angle - start) % _TURN_RAD for start in self._start_rad])
        cosine, sine = (values[:, None] for values in _cosine_and_sine(2 * past))
        more = self._azimuth_adjust.at(cell, part)
        more += np.float32(2) * rotated
        cosine, sine = _rotated(*_sum(cosine, sine, *self._azimuth), more)
        flat, up = _rotated(*self._elevation, self._elevation_adjust.at(cell, part))
        right = flat * sine
        forward = flat * cosine
        for axis, (from_right, from_forward, from_up) in enumerate(self._rotation):
            towards = np.multiply(right, from_right, out=self._towards[: len(encoder), axis])
            towards += from_forward * forward
            towards += from_up * up

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Range times direction, from one origin."""
        count = len(range_m)
        moved = self._moved[:count]
        np.multiply(range_m[:, None, :], self._towards[:count], out=moved)
        np.add(moved, self._origin, out=out.transpose(0, 2, 1))

    def _cell(self, angle: F64Array, rotated: F32Array) -> tuple[I64Array, F32Array]:
        """Cells of `_AngleCorrection` and the fractions within them, for beams (n, B)."""
        steps = angle * self._steps_per_rad
        step = np.floor(steps)
        part = rotated * np.float32(self._steps_per_rad)
        part += (steps - step).astype(np.float32)[:, None]
        # During the firing of a column, beams may enter the next or the previous cell.
        further = np.floor(part)
        part -= further
        cell = further.astype(np.int64)
        cell += step.astype(np.int64)[:, None]
        cell *= len(self._beam)
        cell += self._beam
        return cell, part


class _AngleCorrection:
    """Corrections over the rotor angle, (channels, steps) rad, piecewise linear.

    Cell step * channels + channel is the piece from that step to the next one.
    """

    def __init__(self, adjust_rad: F64Array) -> None:
        # One row per step, so that the beams of a column are contiguous; wraps after the last step.
        rows = adjust_rad.T
        self._value = rows.astype(np.float32).ravel()
        self._slope = (np.roll(rows, -1, axis=0) - rows).astype(np.float32).ravel()

    def at(self, cell: I64Array, part: F32Array) -> F32Array:
        """Values in cells (n, B), at the given fraction of the way to the next step."""
        found: F32Array = self._slope.take(cell, mode="wrap")
        found *= part
        found += self._value.take(cell, mode="wrap")
        return found


def _cosine_and_sine(angle_rad: F64Array) -> tuple[F32Array, F32Array]:
    return np.cos(angle_rad).astype(np.float32), np.sin(angle_rad).astype(np.float32)


def _sum(
    cosine: F32Array, sine: F32Array, other_cosine: F32Array, other_sine: F32Array
) -> tuple[F32Array, F32Array]:
    """Cosine and sine of the sum of two angles."""
    return (
        cosine * other_cosine - sine * other_sine,
        sine * other_cosine + cosine * other_sine,
    )


def _rotated(cosine: F32Array, sine: F32Array, more_rad: F32Array) -> tuple[F32Array, F32Array]:
    """Rotate by a small angle, below 0.05 rad: the next terms are d**5 / 120."""
    square = more_rad * more_rad
    by_sine = (square * np.float32(-1 / 6) + np.float32(1)) * more_rad
    by_cosine = (square * np.float32(1 / 24) - np.float32(0.5)) * square + np.float32(1)
    return _sum(cosine, sine, by_cosine, by_sine)


def at128_projection(
    file: At128File, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
) -> Projection:
    """Ranges to points of a sensor at `body_from_sensor` (4, 4), m.

    Columns carry rotor words. firing_ns: (T, 128), as in `Lidar`; columns: largest batch.
    """
    return _At128Projection(file, firing_ns, body_from_sensor, columns)
