"""Encoder of Ouster packets and metadata: what a sensor would send, from plain values.

Source: docs/sources/ouster.md sections 1-3 and 8. Encoding is the inverse of decoding; where fields
lie is taken from the tables of the decoder, which the tests check bit by bit and on real
recordings.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, U8Array
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
    PROFILES,
    STANDARD,
    PacketLayout,
)
from mlbatch.units import RAD_PER_DEG, STANDARD_GRAVITY

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
