"""A simulated Ouster: rays of its columns, packets, metadata and IMU packets.

Source: docs/sources/ouster.md sections 1 (metadata), 6 (range to xyz) and 8 (IMU). The rays are
written here once more, apart from the decoder.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.sensors.ouster.profiles import OFF, PROFILES
from mlbatch.simulate.interface import (
    ImuUnit,
    LidarFiles,
    LidarModel,
    LidarSettings,
    PacketTopic,
    Sent,
    Shots,
    whole_counts,
)
from mlbatch.simulate.ouster.encode import (
    IntLike,
    OusterSpec,
    encode_packets,
    imu_packet,
    metadata_json,
)
from mlbatch.units import M_PER_MM, MM_PER_M, NS_PER_S, RAD_PER_DEG

_COLUMNS_PER_PACKET = 16
_IMU_HZ = 100
_RANGE_BITS = 19
# Photons of a target of reflectivity 255 at 1 m; the signal falls with the square of the range.
_SIGNAL_AT_1_M = 60_000
_NEAR_IR = 400


@dataclass(frozen=True, slots=True)
class _Line:
    """A product line: beams from top to bottom, places of their origin and of the sensor frame."""

    product: str
    beams: tuple[int, ...]
    altitude_deg: tuple[float, float]
    origin_mm: float
    lift_mm: float


_LINES = {
    "OS0": _Line("OS-0", (32, 64, 128), (44.5, -44.5), 27.67, 36.18),
    "OS1": _Line("OS-1", (64, 16, 32, 128), (22.4, -22.4), 15.806, 38.195),
    "OS2": _Line("OS-2", (32, 64, 128), (11.2, -11.2), 13.762, 74.296),
    "OSDome": _Line("OS-DOME", (32, 64, 128), (88.5, 0.5), 12.163, 78.296),
}
_NAMES = {f"{line}-{beams}": (line, beams) for line in _LINES for beams in _LINES[line].beams}
_PROFILES = (
    "RNG19_RFL8_SIG16_NIR16",
    *(name for name in PROFILES if name not in (OFF, "RNG19_RFL8_SIG16_NIR16")),
)

MODELS = tuple(
    LidarModel(name, ("single",), (10, 20), _PROFILES, (1024, 512, 2048)) for name in _NAMES
)


def simulated(settings: LidarSettings) -> SimulatedOuster:
    """Return the lidar."""
    return SimulatedOuster(settings)


class SimulatedOuster:
    """Columns of a revolution are evenly timed; all beams of a column fire at once."""

    def __init__(self, settings: LidarSettings) -> None:
        """Compute the rays of a revolution."""
        line_name, beams = _NAMES[settings.model]
        line = _LINES[line_name]
        # Not quite even, as calibration gives them.
        even = np.linspace(*line.altitude_deg, beams)
        uneven = 0.03 * (np.arange(beams) * 7 % 5 - 2)
        altitude = np.asarray(np.round(even + uneven, 2), np.float64)
        self._spec = OusterSpec(
            profile=settings.profile,
            beams=beams,
            columns_per_frame=settings.columns,
            columns_per_packet=_COLUMNS_PER_PACKET,
            rate_hz=settings.rate_hz,
            serial=settings.serial,
            product=f"{line.product}-{beams}",
            timestamp_mode="TIME_FROM_PTP_1588",
            altitude_deg=tuple(altitude.tolist()),
            beam_offset_mm=(line.origin_mm, 0.0),
            lidar_to_sensor_mm=[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, line.lift_mm, 0, 0, 0, 1],
        )
        self.rig_model = ""
        self.topics = {
            self._spec.lidar_port: PacketTopic("lidar_packets", "ouster_sensor_msgs/PacketMsg"),
            self._spec.imu_port: PacketTopic("imu_packets", "ouster_sensor_msgs/PacketMsg"),
        }
        text = json.dumps(metadata_json(self._spec), indent=1) + "\n"
        self.files = LidarFiles("json", text.encode(), "metadata")
        imu_mm = np.array(self._spec.imu_to_sensor_mm).reshape(4, 4)
        imu_mm[:3, 3] *= M_PER_MM
        self.imu = ImuUnit(_IMU_HZ, imu_mm) if settings.imu else None
        # A quarter of a revolution, whole packets for all numbers of columns.
        self._chunk_columns = settings.columns // 4
        self._per_second = settings.columns * settings.rate_hz
        self.chunk_s = self._chunk_columns / self._per_second
        self._start_ns = settings.start_ns
        self._first = round(settings.phase_deg / 360.0 * settings.columns)
        # Packets begin at multiples of their columns.
        self._first = self._first // _COLUMNS_PER_PACKET * _COLUMNS_PER_PACKET
        self._offset_mm = line.origin_mm
        self._origin, self._direction = self._rays(altitude, line)

    def shots(self, chunk: int) -> Shots:
        """Rays of the columns of a chunk."""
        number = self._numbers(chunk)
        mid = (self._first + number) % self._spec.columns_per_frame
        origin = self._origin[mid][:, None, :]
        return Shots(self._stamps(number), np.zeros((1, 1)), origin, self._direction[mid])

    def packets(self, chunk: int, distance_m: F64Array, reflectivity: F64Array) -> list[Sent]:
        """Packets of a chunk."""
        number = self._numbers(chunk)
        column = self._first + number
        stamps = self._stamps(number)
        per_frame = self._spec.columns_per_frame
        values = self._fields(distance_m, reflectivity)
        payloads = encode_packets(
            self._spec, stamps, column % per_frame, column // per_frame, values
        )
        last = stamps[_COLUMNS_PER_PACKET - 1 :: _COLUMNS_PER_PACKET].tolist()
        port = self._spec.lidar_port
        return [Sent(at, port, payload) for at, payload in zip(last, payloads, strict=True)]

    def imu_packets(
        self, time_ns: I64Array, acceleration: F64Array, angular_velocity: F64Array
    ) -> list[Sent]:
        """Packets of IMU samples, one each."""
        return [
            Sent(
                int(time_ns[row]),
                self._spec.imu_port,
                imu_packet(
                    self._spec,
                    time_ns[row : row + 1],
                    acceleration[row : row + 1],
                    angular_velocity[row : row + 1],
                ),
            )
            for row in range(len(time_ns))
        ]

    def _numbers(self, chunk: int) -> I64Array:
        """Return the columns of a chunk, counted from the start."""
        return np.arange(chunk * self._chunk_columns, (chunk + 1) * self._chunk_columns)

    def _stamps(self, number: I64Array) -> I64Array:
        return self._start_ns + number * NS_PER_S // self._per_second

    def _fields(self, distance_m: F64Array, reflectivity: F64Array) -> dict[str, IntLike]:
        """Return what the profile has: range, reflectivity, signal, ambient light."""
        fields = PROFILES[self._spec.profile].fields
        place = fields["RANGE"]
        step_mm = 1 << place.shift
        # Ranges count from the axis of the rotor, along the beam.
        range_m = distance_m + self._offset_mm * M_PER_MM
        largest = (1 << min(place.width, _RANGE_BITS)) - 1
        counts = whole_counts(range_m, step_mm * M_PER_MM, largest)
        level = np.where(counts > 0, np.rint(reflectivity), 0.0)
        found: dict[str, IntLike] = {
            "RANGE": counts * step_mm,
            "REFLECTIVITY": level.astype(np.int64),
        }
        if "SIGNAL" in fields:
            square = np.maximum(counts * (step_mm / MM_PER_M), 1.0) ** 2
            found["SIGNAL"] = np.rint(level / 255.0 * _SIGNAL_AT_1_M / square).astype(np.int64)
        if "NEAR_IR" in fields:
            found["NEAR_IR"] = np.full_like(counts, _NEAR_IR)
        return found

    def _rays(self, altitude_deg: F64Array, line: _Line) -> tuple[F64Array, F64Array]:
        """Return origins (columns, 3) and directions (columns, beams, 3); section 6."""
        columns = self._spec.columns_per_frame
        theta = 2.0 * math.pi * (1.0 - np.arange(columns) / columns)
        azimuth = theta[:, None] - np.array(self._spec.azimuths_deg()) * RAD_PER_DEG
        altitude = altitude_deg * RAD_PER_DEG
        x = np.cos(azimuth) * np.cos(altitude)
        y = np.sin(azimuth) * np.cos(altitude)
        z = np.broadcast_to(np.sin(altitude), x.shape)
        origin_mm = np.stack(
            [line.origin_mm * np.cos(theta), line.origin_mm * np.sin(theta), np.zeros(columns)], 1
        )
        # Lidar frame to sensor frame: half a revolution about z, and the lift.
        flip = np.array([-1.0, -1.0, 1.0])
        origin_mm = origin_mm * flip + np.array([0.0, 0.0, line.lift_mm])
        return origin_mm * M_PER_MM, np.stack([x, y, z], axis=-1) * flip
