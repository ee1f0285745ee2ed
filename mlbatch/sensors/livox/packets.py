"""Livox SDK2 packets: header, points with coordinates, IMU samples.

Source: docs/sources/others.md (Livox SDK2). Coverage of the CRC-32, time and data: Livox
communication protocol of the Avia2, v1.0.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, F64Array, U8Array
from mlbatch.lidar.geometry import Coordinates
from mlbatch.lidar.headers import EvenColumns, checks
from mlbatch.types import ImuSamples
from mlbatch.units import RAD_PER_DEG, STANDARD_GRAVITY

HEADER_SIZE = 36
IMU = 0
# 1 + 2 + 2 + 2 + 2 + 1 + 1 + 1 + 12 + 4 + 8 = 36 bytes; interval: 0.1 us.
HEADER = np.dtype(
    [
        ("version", "u1"),
        ("size", "<u2"),
        ("interval", "<u2"),
        ("points", "<u2"),
        ("counter", "<u2"),
        ("frame", "u1"),
        ("data_type", "u1"),
        ("time_type", "u1"),
        ("reserved", "V12"),
        ("crc", "<u4"),
        ("stamp_ns", "<u8"),
    ]
)
Points: TypeAlias = npt.NDArray[np.void]
_NS_PER_INTERVAL = 100
_CRC_FROM = 28
_INTENSITY = [("intensity", "u1"), ("tag", "u1")]
_CARTESIAN32 = np.dtype([("xyz", "<i4", 3), *_INTENSITY])
_CARTESIAN16 = np.dtype([("xyz", "<i2", 3), *_INTENSITY])
# zenith: from the z axis; azimuth: from x towards y; both in 0.01 degrees.
_SPHERICAL = np.dtype([("depth", "<u4"), ("zenith", "<u2"), ("azimuth", "<u2"), *_INTENSITY])
_SAMPLE = np.dtype([("angular_velocity", "<f4", 3), ("acceleration_g", "<f4", 3)])
IMU_SIZE = HEADER_SIZE + _SAMPLE.itemsize
_CIRCLE_CDEG = 36000


@dataclass(frozen=True, slots=True)
class PointKind:
    """Points of an SDK2 data type: bytes and returns of a point, and its coordinates."""

    data_type: int
    size: int
    returns: int
    what: str


KINDS: Mapping[int, PointKind] = {
    kind.data_type: kind
    for kind in (
        PointKind(IMU, 24, 0, "IMU"),
        PointKind(1, 14, 1, "Cartesian 32 bit, single return"),
        PointKind(2, 8, 1, "Cartesian 16 bit, single return"),
        PointKind(3, 10, 1, "spherical, single return"),
        PointKind(0x11, 28, 2, "Cartesian 32 bit, dual return"),
    )
}


def headers(packets: U8Array) -> npt.NDArray[np.void]:
    """(P,) records of HEADER."""
    return np.ascontiguousarray(packets[:, :HEADER_SIZE]).view(HEADER)[:, 0]


def has_points(packets: U8Array, kind: PointKind) -> BoolArray:
    """(P,) whether packets have points of a kind."""
    head = headers(packets)
    size = packets.shape[1]
    good = (head["data_type"] == kind.data_type) & (head["size"] == size)
    good &= head["points"] == (size - HEADER_SIZE) // kind.size
    return np.asarray(good, np.bool_)


def header_table(kind: PointKind, size: int, points: int, is_counted: bool) -> EvenColumns:
    """Layout of the headers of packets with so many points.

    Their times are spread evenly over the interval stated in the packet. It is divided by the
    number of points, as in the vendor's driver; the protocol defines it as the time between the
    first and the last point.
    """
    at = {name: place for name, (_, place, *_) in (HEADER.fields or {}).items()}
    return EvenColumns(
        packet_bytes=size,
        columns=points,
        check_count=3,
        checks=checks(
            (at["data_type"], 1, kind.data_type), (at["size"], 2, size), (at["points"], 2, points)
        ),
        stamp_at=at["stamp_ns"],
        interval_at=at["interval"],
        interval_ns=_NS_PER_INTERVAL,
        counter_at=at["counter"] if is_counted else -1,
        ring_at=-1,
        rings=1,
    )


def wrong_crc(packets: U8Array) -> BoolArray:
    """(P,) whether the checksum of packets is wrong."""
    # Less than a microsecond each, a fraction of the decoding of their points.
    crc = [zlib.crc32(packet[_CRC_FROM:].tobytes()) for packet in packets]
    return np.asarray(headers(packets)["crc"] != np.array(crc, np.uint32))


def coordinates(kind: PointKind, body_from_sensor: F64Array) -> Coordinates:
    """Forms of the points of a data type, moved into the body frame."""
    form, layout = _RETURNS[kind.data_type]
    intensity_at = layout.itemsize - np.dtype(_INTENSITY).itemsize
    return Coordinates(
        form, layout.itemsize, intensity_at, np.ascontiguousarray(body_from_sensor[:3]), _sines()
    )


def read_imu(payloads: U8Array, sensor: int) -> ImuSamples:
    """The sample of each IMU packet; point packets of the same size are skipped."""
    head = headers(payloads)
    is_sample = (head["data_type"] == IMU) & (head["points"] == 1)
    chosen = np.ascontiguousarray(payloads[is_sample, HEADER_SIZE:IMU_SIZE])
    sample = chosen.view(_SAMPLE)[:, 0]
    # Damaged packets may contain signaling NaN.
    with np.errstate(invalid="ignore"):
        return ImuSamples(
            sensor,
            head["stamp_ns"][is_sample].astype(np.int64),
            sample["acceleration_g"].astype(np.float64) * STANDARD_GRAVITY,
            sample["angular_velocity"].astype(np.float64),
        )


@lru_cache(maxsize=1)
def _sines() -> F32Array:
    """Sines of a full circle; float32, so that the last digit of a library has no effect."""
    sines: F32Array = np.sin(np.arange(_CIRCLE_CDEG) * (0.01 * RAD_PER_DEG)).astype(np.float32)
    return sines


# By data type: form of the integers, as in `native.h`, and layout of a return.
_MILLIMETRES, _CENTIMETRES, _ANGLES = range(3)
_RETURNS: Mapping[int, tuple[int, np.dtype[np.void]]] = {
    1: (_MILLIMETRES, _CARTESIAN32),
    2: (_CENTIMETRES, _CARTESIAN16),
    3: (_ANGLES, _SPHERICAL),
    0x11: (_MILLIMETRES, _CARTESIAN32),
}
