"""Encoder of Ouster packets and metadata: what a sensor would send, from plain values.

Source: docs/sources/ouster.md sections 1 to 3, 6 (range to xyz) and 8 (IMU). Encoding is the
inverse of decoding; where fields lie is taken from the tables of the decoder, which the tests check
bit by bit and on real recordings. The rays of the simulation are written here once more, apart from
the decoder.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.sensors.crc import crc64
from mlbatch.sensors.ouster.imu import (
    ACCEL32,
    LEGACY_IMU,
    SAMPLE,
    SAMPLES_START,
    imu_size,
)
from mlbatch.sensors.ouster.profiles import (
    COLUMN,
    ENCODER_TICKS,
    FUSA,
    HEADERS,
    IMU_PACKET,
    LEGACY,
    LEGACY_COLUMN,
    LIDAR_PACKET,
    OFF,
    PROFILES,
    STANDARD,
    PacketLayout,
)
from mlbatch.simulate.interface import (
    ImuUnit,
    LidarFiles,
    LidarModel,
    LidarSettings,
    PacketTopic,
    Sent,
    Shots,
    SimulatedLidar,
    whole_counts,
)
from mlbatch.units import M_PER_MM, MM_PER_M, NS_PER_S, RAD_PER_DEG, STANDARD_GRAVITY

IntLike: TypeAlias = npt.NDArray[np.integer[Any]]
JsonObject: TypeAlias = dict[str, Any]
ROTATED_MM = [-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 36.18, 0.0, 0.0, 0.0, 1.0]
IMU_MM = [1.0, 0.0, 0.0, 6.253, 0.0, 1.0, 0.0, -11.775, 0.0, 0.0, 1.0, 7.645, 0.0, 0.0, 0.0, 1.0]


@dataclass(frozen=True)
class OusterSpec:
    """A sensor to imitate; angles default to an even fan, window to the whole revolution."""

    profile: str = "RNG15_RFL8_NIR8"
    beams: int = 128
    columns_per_frame: int = 1024
    columns_per_packet: int = 16
    rate_hz: int = 10
    header: str = ""
    serial: int = 122201000998
    init_id: int = 7109750
    product: str = ""
    window: tuple[int, int] | None = None
    lidar_port: int = 7502
    imu_port: int = 7503
    imu_profile: str = LEGACY
    imu_samples: int = 0
    timestamp_mode: str = "TIME_FROM_INTERNAL_OSC"
    altitude_deg: tuple[float, ...] = ()
    azimuth_deg: tuple[float, ...] = ()
    beam_offset_mm: tuple[float, float] = (15.806, 0.0)
    lidar_to_sensor_mm: list[float] = field(default_factory=lambda: list(ROTATED_MM))
    imu_to_sensor_mm: list[float] = field(default_factory=lambda: list(IMU_MM))
    extrinsic_m: list[float] | None = None
    with_crc: bool = True

    @property
    def layout(self) -> PacketLayout:
        """Sizes of its packets."""
        return PacketLayout(PROFILES[self.profile], self.beams, self.columns_per_packet)

    @property
    def header_type(self) -> str:
        """STANDARD or FUSA."""
        return self.header or PROFILES[self.profile].header

    def altitudes_deg(self) -> list[float]:
        """Altitude angles, top beam first."""
        return list(self.altitude_deg) or np.linspace(20.0, -20.0, self.beams).round(3).tolist()

    def azimuths_deg(self) -> list[float]:
        """Azimuth offsets: four staggered groups, as real headers have them."""
        pattern = [4.2, 1.4, -1.4, -4.2]
        return list(self.azimuth_deg) or [pattern[beam % 4] for beam in range(self.beams)]


def metadata_json(spec: OusterSpec) -> JsonObject:
    """A complete nested metadata document."""
    offset_x, offset_z = spec.beam_offset_mm
    document: JsonObject = {
        "beam_intrinsics": {
            "beam_altitude_angles": spec.altitudes_deg(),
            "beam_azimuth_angles": spec.azimuths_deg(),
            "beam_to_lidar_transform": [
                *[1.0, 0.0, 0.0, offset_x, 0.0, 1.0, 0.0, 0.0],
                *[0.0, 0.0, 1.0, offset_z, 0.0, 0.0, 0.0, 1.0],
            ],
            "lidar_origin_to_beam_origin_mm": float(np.hypot(offset_x, offset_z)),
        },
        "lidar_intrinsics": {"lidar_to_sensor_transform": list(spec.lidar_to_sensor_mm)},
        "imu_intrinsics": {"imu_to_sensor_transform": list(spec.imu_to_sensor_mm)},
        "sensor_info": {
            "prod_line": spec.product or f"OS-1-{spec.beams}",
            "prod_sn": str(spec.serial) if spec.serial else "",
            "initialization_id": spec.init_id,
            "build_rev": "v2.5.2",
            "status": "RUNNING",
        },
        "calibration_status": {"reflectivity": {"valid": True, "timestamp": ""}},
        "lidar_data_format": _data_format(spec),
        "config_params": {
            "lidar_mode": f"{spec.columns_per_frame}x{spec.rate_hz}",
            "timestamp_mode": spec.timestamp_mode,
            "udp_dest": "192.0.2.1",
            "udp_port_lidar": spec.lidar_port,
            "udp_port_imu": spec.imu_port,
            "udp_profile_lidar": spec.profile,
            "columns_per_packet": spec.columns_per_packet,
        },
    }
    if spec.imu_samples:
        document["imu_data_format"] = {"imu_measurements_per_packet": spec.imu_samples}
    if spec.extrinsic_m is not None:
        document["ouster-sdk"] = {"extrinsic": list(spec.extrinsic_m)}
    return document


def _data_format(spec: OusterSpec) -> JsonObject:
    return {
        "pixels_per_column": spec.beams,
        "columns_per_packet": spec.columns_per_packet,
        "columns_per_frame": spec.columns_per_frame,
        "column_window": list(spec.window or (0, spec.columns_per_frame - 1)),
        "pixel_shift_by_row": [0] * spec.beams,
        "udp_profile_lidar": spec.profile,
        "udp_profile_imu": spec.imu_profile,
        "header_type": spec.header_type,
        "fps": spec.rate_hz,
    }


def flat_json(spec: OusterSpec) -> JsonObject:
    """The metadata of the same sensor as of firmware 2.2 and 2.3: all keys at the top."""
    nested = metadata_json(spec)
    document: JsonObject = {
        "lidar_mode": nested["config_params"]["lidar_mode"],
        "udp_port_lidar": spec.lidar_port,
        "udp_port_imu": spec.imu_port,
        "data_format": nested["lidar_data_format"],
    }
    for section in ("beam_intrinsics", "lidar_intrinsics", "imu_intrinsics", "sensor_info"):
        document.update(nested[section])
    return document


def encode_packets(
    spec: OusterSpec,
    stamps_ns: IntLike,
    mids: IntLike,
    frame_ids: IntLike,
    fields: dict[str, IntLike],
    valid: BoolArray | None = None,
) -> list[bytes]:
    """Packets of n columns, n a multiple of the columns per packet.

    stamps_ns, mids, frame_ids, valid (default: all): (n,); fields: values (n, beams) by the names
    of the profile's table, RANGE in mm; what is left out is 0. A packet takes the frame id of its
    first column.
    """
    layout = spec.layout
    count = len(stamps_ns)
    packets = count // layout.columns
    if packets * layout.columns != count:
        raise ValueError(f"{count} columns are no whole packets of {layout.columns}")
    measured = np.ones(count, np.bool_) if valid is None else valid
    head = np.zeros(count, LEGACY_COLUMN if layout.legacy else COLUMN)
    head["stamp_ns"] = stamps_ns
    head["measurement_id"] = mids
    records = np.zeros((count, layout.record_size), np.uint8)
    if layout.legacy:
        head["frame_id"] = frame_ids
        head["encoder"] = np.asarray(mids) * ENCODER_TICKS // spec.columns_per_frame
        records[:, -4:] = np.where(measured, 0xFF, 0)[:, None]
    else:
        head["status"] = measured
    records[:, : head.itemsize] = head.view(np.uint8).reshape(count, -1)
    pixels = _pixels(spec, fields, count).view(np.uint8).reshape(count, -1)
    records[:, head.itemsize : head.itemsize + pixels.shape[1]] = pixels
    payloads = np.zeros((packets, layout.packet_size), np.uint8)
    end = layout.record_start + layout.columns * layout.record_size
    payloads[:, layout.record_start : end] = records.reshape(packets, -1)
    if not layout.legacy:
        _write_headers(spec, payloads, LIDAR_PACKET, np.asarray(frame_ids)[:: layout.columns])
    return [payload.tobytes() for payload in payloads]


def encode_frame(
    spec: OusterSpec, first_stamp_ns: int, frame_id: int, ranges_mm: IntLike
) -> list[bytes]:
    """A revolution of evenly timed columns; ranges_mm: (columns per frame, beams, returns)."""
    columns = spec.columns_per_frame
    mids = np.arange(columns)
    names = ("RANGE", "RANGE2")[: ranges_mm.shape[2]]
    return encode_packets(
        spec,
        first_stamp_ns + mids * 10**9 // (columns * spec.rate_hz),
        mids,
        np.full(columns, frame_id),
        {name: ranges_mm[:, :, which] for which, name in enumerate(names)},
    )


def imu_packet(
    spec: OusterSpec,
    stamps_ns: IntLike,
    acceleration: npt.NDArray[np.floating[Any]],
    angular_velocity: npt.NDArray[np.floating[Any]],
    valid: BoolArray | None = None,
) -> bytes:
    """An IMU packet of the kind the spec names; (n, 3) in m/s2 and rad/s, n = 1 for LEGACY."""
    if spec.imu_profile != ACCEL32:
        old = np.zeros(1, LEGACY_IMU)
        old["gyroscope_ns"] = stamps_ns
        old["system_ns"] = old["gyroscope_ns"] + 2
        old["acceleration_ns"] = old["gyroscope_ns"] - 1
        old["acceleration_g"] = acceleration / STANDARD_GRAVITY
        old["angular_velocity_deg"] = angular_velocity / RAD_PER_DEG
        return old.tobytes()
    samples = np.zeros(len(stamps_ns), SAMPLE)
    samples["stamp_ns"] = stamps_ns
    samples["measurement_id"] = np.arange(len(stamps_ns))
    samples["status"] = 1 if valid is None else valid
    samples["acceleration"] = acceleration
    samples["angular_velocity"] = angular_velocity
    payload = np.zeros((1, imu_size(len(samples))), np.uint8)
    payload[0, SAMPLES_START : SAMPLES_START + samples.nbytes] = samples.view(np.uint8)
    _write_headers(spec, payload, IMU_PACKET, np.zeros(1, np.int64))
    return payload.tobytes()


def _pixels(spec: OusterSpec, fields: dict[str, IntLike], count: int) -> npt.NDArray[np.uint32]:
    profile = PROFILES[spec.profile]
    words = np.zeros((count, spec.beams, profile.pixel_size // 4), "<u4")
    for name, values in fields.items():
        place = profile.fields[name]
        raw = np.asarray(values, np.int64) >> place.shift
        if (raw << place.shift != values).any() or (raw >> place.width).any() or (raw < 0).any():
            raise ValueError(f"{name} does not fit {profile.name}: {place}")
        word, bit = divmod(place.first_bit, 32)
        words[:, :, word] |= (raw << bit).astype(np.uint32)
    return words


def _write_headers(spec: OusterSpec, payloads: U8Array, kind: int, frame_ids: IntLike) -> None:
    layout = HEADERS[spec.header_type]
    frames = 2**16 if spec.header_type == STANDARD else 2**32
    for (first, size), values in (
        (layout.packet_type, np.full(len(payloads), kind)),
        (layout.frame_id, np.asarray(frame_ids, np.int64) % frames),
        (layout.init_id, np.full(len(payloads), spec.init_id)),
        (layout.serial, np.full(len(payloads), spec.serial)),
    ):
        for byte in range(size):
            payloads[:, first + byte] = (values >> (8 * byte)) & 0xFF
    # FUSA footers have no checksum.
    if spec.with_crc and spec.header_type != FUSA:
        payloads[:, -8:] = crc64(payloads[:, :-8]).astype("<u8").view(np.uint8).reshape(-1, 8)


# -- simulation ---------------------------------------------------------------------------------

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

LIDARS = tuple(
    LidarModel(name, ("single",), (10, 20), _PROFILES, (1024, 512, 2048)) for name in _NAMES
)


def simulated(settings: LidarSettings) -> SimulatedOuster:
    """Return the lidar."""
    return SimulatedOuster(settings)


class SimulatedOuster(SimulatedLidar):
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
