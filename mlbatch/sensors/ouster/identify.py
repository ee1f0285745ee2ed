"""Names of Ouster packets by content.

Source: docs/sources/ouster.md sections 2, 4, 8 and 9. A size alone identifies nothing: lidar
packets need columns in order, IMU packets need timestamps close together.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array
from mlbatch.sensors.ouster.imu import (
    LEGACY_IMU,
    LEGACY_SIZE,
    SAMPLE,
    SAMPLES_START,
    float64,
    sample_count,
)
from mlbatch.sensors.ouster.packets import column_bytes
from mlbatch.sensors.ouster.profiles import (
    COLUMN,
    ENCODER_TICKS,
    FOOTER_SIZE,
    FUSA,
    HEADER_SIZE,
    HEADERS,
    IMU_PACKET,
    LEGACY,
    LEGACY_COLUMN,
    LIDAR_PACKET,
    PROFILES,
    STANDARD,
    ZONE_PACKET,
    PacketLayout,
)
from mlbatch.sensors.packet_bytes import number, payload_rows
from mlbatch.units import NS_PER_S, STANDARD_GRAVITY

_COLUMNS = 16
_BEAMS = (16, 32, 64, 128, 256)
_COLUMNS_PER_FRAME = (512, 1024, 2048, 4096)
_ZONE_SIZE = 680
_ONE_WORD = PROFILES["RNG15_RFL8_NIR8"]
_PIXELS_SIZES = {
    beams * profile.pixel_size for beams in _BEAMS for profile in PROFILES.values()
} - {0}
# Plausible accelerations of a vehicle, in g.
_LEAST_G = 0.05
_MOST_G = 100.0


def describe(size: int, sample: U8Array) -> str | None:
    """Name payloads (k, size) of one stream; None if they are not Ouster's."""
    packets = payload_rows(size, sample)
    if packets is None:
        return None
    for length in (size, size - 1):  # old ROS drivers append a byte
        text = (
            _describe_legacy(length, packets)
            or _describe_imu(length, packets)
            or _describe_lidar(length, packets)
            or _describe_other(length, packets)
        )
        if text:
            return text
    return None


def _describe_legacy(size: int, packets: U8Array) -> str | None:
    for beams in _BEAMS:
        layout = PacketLayout(PROFILES[LEGACY], beams, _COLUMNS)
        if layout.packet_size == size:
            raw = column_bytes(packets, layout)[:, :, : LEGACY_COLUMN.itemsize]
            column = np.ascontiguousarray(raw).view(LEGACY_COLUMN)[..., 0]
            mid = column["measurement_id"].astype(np.int64)
            encoder = column["encoder"].astype(np.int64)
            on_rotor = any((encoder * w == mid * ENCODER_TICKS).all() for w in _COLUMNS_PER_FRAME)
            if on_rotor and _in_order(mid):
                return f"Ouster lidar, LEGACY, {beams} beams"
    return None


def _describe_imu(size: int, packets: U8Array) -> str | None:
    if size != LEGACY_SIZE:
        return None
    raw = np.ascontiguousarray(packets[:, :LEGACY_SIZE])
    sample = raw.view(LEGACY_IMU)[:, 0]
    stamps = [sample[name] for name in ("system_ns", "acceleration_ns", "gyroscope_ns")]
    near = all(
        bool((stamp > 0).all()) and bool((np.abs(stamp - stamps[0]) < NS_PER_S).all())
        for stamp in stamps
    )
    return "Ouster IMU" if near and _like_gravity(float64(sample["acceleration_g"])) else None


def _describe_lidar(size: int, packets: U8Array) -> str | None:
    """Lidar packets of any profile: the size of a column follows from that of the packet."""
    column_size, rest = divmod(size - HEADER_SIZE - FOOTER_SIZE, _COLUMNS)
    pixels_size = column_size - COLUMN.itemsize
    if rest or pixels_size not in _PIXELS_SIZES:
        return None
    layout = PacketLayout(_ONE_WORD, pixels_size // _ONE_WORD.pixel_size, _COLUMNS)
    raw = column_bytes(packets, layout)[:, :, : COLUMN.itemsize]
    column = np.ascontiguousarray(raw).view(COLUMN)[..., 0]
    header = _header_type(packets, LIDAR_PACKET)
    if header is None or not _in_order(column["measurement_id"].astype(np.int64)):
        return None
    return f"Ouster lidar, {_serial(packets, header)}{size} bytes: needs its metadata"


def _describe_other(size: int, packets: U8Array) -> str | None:
    if sample_count(size):
        name = "IMU"
        packet_type = IMU_PACKET
        raw = packets[:, SAMPLES_START : size - FOOTER_SIZE].reshape(
            len(packets), -1, SAMPLE.itemsize
        )
        samples = np.ascontiguousarray(raw).view(SAMPLE)[..., 0]
        step_ns = np.diff(samples["stamp_ns"], axis=1)
        in_order = bool(((step_ns > 0) & (step_ns < NS_PER_S)).all())
        norm_g = float64(samples["acceleration"]) / STANDARD_GRAVITY
        is_plausible = in_order and _like_gravity(norm_g)
    else:
        name = "zone monitor"
        packet_type = ZONE_PACKET
        is_plausible = size == _ZONE_SIZE
    header = _header_type(packets, packet_type) if is_plausible else None
    return None if header is None else f"Ouster {name}, {_serial(packets, header)}{size} bytes"


def _like_gravity(acceleration_g: F64Array) -> bool:
    """Whether every packet (k, ..., 3) has a sample near gravity, and all samples are plausible."""
    norm_g = np.linalg.norm(acceleration_g, axis=-1).reshape(len(acceleration_g), -1)
    return bool((norm_g.max(axis=1) > _LEAST_G).all()) and bool((norm_g < _MOST_G).all())


def _header_type(packets: U8Array, packet_type: int) -> str | None:
    for header in (STANDARD, FUSA):
        if (number(packets, *HEADERS[header].packet_type) == packet_type).all():
            return header
    return None


def _serial(packets: U8Array, header: str) -> str:
    serial = int(number(packets, *HEADERS[header].serial)[0])
    return f"serial {serial}, " if serial else ""


def _in_order(mid: I64Array) -> bool:
    return bool((mid[:, :1] % _COLUMNS == 0).all() and (np.diff(mid, axis=1) == 1).all())
