"""Names of Livox packets by content: sizes, data types, increasing timestamps.

Source: docs/sources/others.md (Livox SDK2 and SDK1); time type 5 (NTP): Livox communication
protocol of the Avia2, v1.0.
"""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.sensors.livox.packets import HEADER_SIZE, KINDS, PointKind
from mlbatch.sensors.packet_bytes import NO_DECODER, majority, most_common, number, payload_rows
from mlbatch.units import NS_PER_S, NS_PER_US

_HEADER1_SIZE = 18
_TIME_TYPES2 = (0, 1, 2, 5)
_TIME_TYPES1 = (0, 1, 3, 4)
_GPS_TIME = 3
_IMU1 = 6


# SDK1, by data type: payload size and description.
_TYPES1 = {
    0: (1318, "Cartesian, single return"),
    1: (918, "spherical, single return"),
    2: (1362, "Cartesian with tags, single return"),
    3: (978, "spherical with tags, single return"),
    4: (1362, "Cartesian, dual return"),
    5: (786, "spherical, dual return"),
    _IMU1: (42, "IMU"),
    7: (1278, "Cartesian, triple return"),
    8: (678, "spherical, triple return"),
}


def describe(size: int, sample: U8Array) -> str | None:
    """Name payloads (k, size); None if they are not Livox's.

    SDK1 (Mid-40, Horizon, Avia, ...) is named, not decoded.
    """
    packets = payload_rows(size, sample)
    if packets is None:
        return None
    return _describe_sdk2(size, packets) or _describe_sdk1(size, packets)


def identify(size: int, packets: U8Array) -> PointKind | None:
    """Kind of points of SDK2 packets (k, size); None if they are other packets.

    The header states the size twice: as a length, and by number and type of points.
    """
    if size <= HEADER_SIZE or not len(packets):
        return None
    data_type = most_common(number(packets, 10, 1))
    kind = KINDS.get(data_type)
    if kind is None:
        return None
    good = (packets[:, 10] == data_type) & np.isin(packets[:, 11], _TIME_TYPES2)
    good &= number(packets, 1, 2) == size
    good &= number(packets, 5, 2) * kind.size == size - HEADER_SIZE
    return kind if majority(packets, good) is not None else None


def _describe_sdk2(size: int, packets: U8Array) -> str | None:
    kind = identify(size, packets)
    if kind is None:
        return None
    return f"Livox lidar (SDK2), {kind.what}" if kind.returns else "Livox IMU packet"


def _describe_sdk1(size: int, packets: U8Array) -> str | None:
    """Size and type are weak evidence, so timestamps of a few packets must increase."""
    if len(packets) < 2 or size < _HEADER1_SIZE:
        return None
    kind = most_common(number(packets, 9, 1))
    expected, what = _TYPES1.get(kind, (0, ""))
    time_type = most_common(number(packets, 8, 1))
    if size != expected or time_type not in _TIME_TYPES1:
        return None
    # Version, slot, device, reserved byte, time and data type are constant in a stream; the status
    # between them is not.
    constant = packets[:, [0, 1, 2, 3, 8, 9]]
    if majority(packets, (constant == np.median(constant, axis=0)).all(axis=1)) is None:
        return None
    gps = time_type == _GPS_TIME
    step_ns = np.diff(number(packets, 14, 4) * NS_PER_US if gps else number(packets, 10, 8))
    if not ((step_ns > 0) & (step_ns < NS_PER_S)).mean() > 0.5:
        return None
    return "Livox IMU packet" if kind == _IMU1 else f"Livox lidar (SDK1), {what}{NO_DECODER}"
