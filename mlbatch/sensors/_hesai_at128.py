"""Points of the AT128, whose rotor turns three mirrors (facts/hesai.md section 6).

Each mirror has a field of rotor angles that begins at its start. A beam leaves at azimuth
2 (rotor - start) - azimuth[channel] and elevation[channel], both corrected by tables over the rotor
angle, straight between their steps of 2 deg. So no beam lies on a cone, and directions are made for
every beam of every column, at the rotor's angle when it fires. What that adds to the angles of the
column and of the channel is small: no cosine is taken per pixel, see `_turned`. A column stays with
one mirror, as fields meet far from where the mirrors look out.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.lidar.geometry import Projection, read_rotor_words
from mlbatch.sensors._hesai_corrections import At128File

_TURN_RAD = 2 * np.pi


class _Mirrors:
    """The projection of one AT128; its frame is HESAI's: x right, y forward, z up."""

    def __init__(
        self, file: At128File, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
    ) -> None:
        beams, steps = file.azimuth_adjust_rad.shape
        self._start_rad = file.start_rad
        self._steps_per_rad = steps / _TURN_RAD
        # Where a beam does not fire there is nothing to place.
        self._firing_ns = np.maximum(firing_ns, 0).astype(np.float32)
        self._azimuth = _cosine_and_sine(-file.azimuth_rad)
        self._elevation = _cosine_and_sine(file.elevation_rad)
        self._azimuth_adjust = _Adjust(file.azimuth_adjust_rad)
        self._elevation_adjust = _Adjust(file.elevation_adjust_rad)
        self._beam = np.arange(beams)
        self._rotation = body_from_sensor[:3, :3].astype(np.float32)
        self._origin = body_from_sensor[:3, 3].astype(np.float32)[:, None]
        self._towards = np.empty((columns, 3, beams), np.float32)
        self._moved = np.empty_like(self._towards)

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Directions of all beams; `member` is always 0."""
        angle, speed, table = read_rotor_words(encoder)
        turned = speed.astype(np.float32)[:, None] * self._firing_ns[table]
        cell, part = self._place(angle, turned)
        past = np.minimum.reduce([(angle - start) % _TURN_RAD for start in self._start_rad])
        cosine, sine = (values[:, None] for values in _cosine_and_sine(2 * past))
        more = self._azimuth_adjust.at(cell, part)
        more += np.float32(2) * turned
        cosine, sine = _turned(*_sum(cosine, sine, *self._azimuth), more)
        flat, up = _turned(*self._elevation, self._elevation_adjust.at(cell, part))
        right, forward = flat * sine, flat * cosine
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

    def _place(self, angle: F64Array, turned: F32Array) -> tuple[I64Array, F32Array]:
        """Cells of `_Adjust` and how far in them the beams (n, B) are."""
        place = angle * self._steps_per_rad
        step = np.floor(place)
        part = turned * np.float32(self._steps_per_rad)
        part += (place - step).astype(np.float32)[:, None]
        # While the beams of a column fire, some may enter the next cell, or the one before.
        further = np.floor(part)
        part -= further
        cell = further.astype(np.int64)
        cell += step.astype(np.int64)[:, None]
        cell *= len(self._beam)
        cell += self._beam
        return cell, part


class _Adjust:
    """Corrections over the rotor angle, (channels, steps) rad, as straight pieces.

    Cell step * channels + channel holds the piece from that step to the next one.
    """

    def __init__(self, adjust_rad: F64Array) -> None:
        # A row a step, so that the beams of a column lie side by side; behind the last, the first.
        rows = adjust_rad.T
        self._value = rows.astype(np.float32).ravel()
        self._slope = (np.roll(rows, -1, axis=0) - rows).astype(np.float32).ravel()

    def at(self, cell: I64Array, part: F32Array) -> F32Array:
        """Values in cells (n, B), the part of the way to the next step."""
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


def _turned(cosine: F32Array, sine: F32Array, more_rad: F32Array) -> tuple[F32Array, F32Array]:
    """Cosine and sine after a small angle, below 0.05 rad: the next terms are d**5 / 120."""
    square = more_rad * more_rad
    by_sine = (square * np.float32(-1 / 6) + np.float32(1)) * more_rad
    by_cosine = (square * np.float32(1 / 24) - np.float32(0.5)) * square + np.float32(1)
    return _sum(cosine, sine, by_cosine, by_sine)


def at128_projection(
    file: At128File, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
) -> Projection:
    """Ranges to points of a sensor at `body_from_sensor` (4, 4), m.

    Columns carry rotor words. firing_ns: (T, 128), as in `Lidar`; columns: the most aimed at once.
    """
    return _Mirrors(file, firing_ns, body_from_sensor, columns)
