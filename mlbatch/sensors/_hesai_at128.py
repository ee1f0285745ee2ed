"""Points of the AT128, whose rotor turns three mirrors (facts/hesai.md section 6).

Each mirror has a field of rotor angles that begins at its start. A beam leaves at azimuth
2 (rotor - start) - azimuth[channel] and elevation[channel], both corrected by tables over the rotor
angle, straight between their steps of 2 deg. So no beam lies on a cone, and directions are made for
every beam of every column, at the rotor's angle when it fires.
"""

from __future__ import annotations

import numpy as np

from mlbatch.geometry import Projection, read_rotor_words
from mlbatch.sensors._hesai_corrections import At128File
from mlbatch.types import F32Array, F64Array, I64Array

_TURN_RAD = 2 * np.pi


class _Mirrors:
    """The projection of one AT128; its frame is HESAI's: x right, y forward, z up."""

    def __init__(
        self, file: At128File, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
    ) -> None:
        beams, self._steps = file.azimuth_adjust_rad.shape
        self._file = file
        # Where a beam does not fire there is nothing to place.
        self._firing_ns = np.maximum(firing_ns, 0).astype(np.float64)
        self._azimuth = _Adjust(file.azimuth_adjust_rad)
        self._elevation = _Adjust(file.elevation_adjust_rad)
        self._beam = np.arange(beams)
        self._rotation = body_from_sensor[:3, :3]
        self._origin = body_from_sensor[:3, 3].astype(np.float32)[:, None]
        self._towards = np.empty((columns, 3, beams), np.float32)
        self._moved = np.empty_like(self._towards)

    def aim(self, member: I64Array, encoder: I64Array) -> None:
        """Directions of all beams; `member` is always 0."""
        angle, speed, table = read_rotor_words(encoder)
        rotor = angle[:, None] + speed[:, None] * self._firing_ns[table]
        past = np.minimum.reduce([(rotor - start) % _TURN_RAD for start in self._file.start_rad])
        place = rotor * (self._steps / _TURN_RAD)
        step = np.floor(place)
        part = place - step
        cell = step.astype(np.int64) % self._steps * len(self._beam) + self._beam
        azimuth = 2 * past - self._file.azimuth_rad + self._azimuth.at(cell, part)
        elevation = self._file.elevation_rad + self._elevation.at(cell, part)
        flat = np.cos(elevation)
        x, y, z = flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)
        for axis, (right, forward, up) in enumerate(self._rotation):
            self._towards[: len(encoder), axis] = right * x + forward * y + up * z

    def points(self, range_m: F32Array, out: F32Array) -> None:
        """Range times direction, from one origin."""
        count = len(range_m)
        moved = self._moved[:count]
        np.multiply(range_m[:, None, :], self._towards[:count], out=moved)
        np.add(moved, self._origin, out=out.transpose(0, 2, 1))


class _Adjust:
    """Corrections over the rotor angle, (channels, steps) rad, as straight pieces."""

    def __init__(self, adjust_rad: F64Array) -> None:
        # A row a step, so that the beams of a column lie side by side; behind the last, the first.
        rows = np.ascontiguousarray(adjust_rad.T)
        self._value, self._slope = rows.ravel(), (np.roll(rows, -1, axis=0) - rows).ravel()

    def at(self, cell: I64Array, part: F64Array) -> F64Array:
        """Values where cell = step * channels + channel, and part of the way to the next step."""
        slope: F64Array = self._slope.take(cell, mode="clip")
        slope *= part
        slope += self._value.take(cell, mode="clip")
        return slope


def at128_projection(
    file: At128File, firing_ns: I64Array, body_from_sensor: F64Array, columns: int
) -> Projection:
    """Ranges to points of a sensor at `body_from_sensor` (4, 4), m.

    Columns carry rotor words. firing_ns: (T, 128), as in `Lidar`; columns: the most aimed at once.
    """
    return _Mirrors(file, firing_ns, body_from_sensor, columns)
