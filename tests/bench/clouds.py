"""Makes a standard recording of decoded clouds: two lidars that drivers decoded, as an MCAP file.

A cloud is a revolution of 64 rings and 2048 columns, 32 bytes a point: x, y, z and intensity as
float32, the time `t` in ns after the header as uint32, the ring as uint16, and padding. Shots
without a return, a fifth of all, are at zero, as Ouster's driver writes them. Clouds are by ring
(64 rows of 2048 points) or by column (one row of all points).

Source: docs/sources/messages.md, sections 4 (CDR) and 8 (fields); MCAP specification (by the
reference library).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from mlbatch.ros.definitions import definition
from mlbatch.units import NS_PER_MS, NS_PER_S
from tests.bench.cases import BY_RING, CLOUD_COLUMNS, CLOUD_RINGS, BenchSensor
from tests.bench.scene import EPOCH_NS, REVOLUTION_NS, scene

_TYPE: Final = "sensor_msgs/PointCloud2"
_POINT: Final = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20],
        "itemsize": 32,
    }
)
# sensor_msgs/PointField.
_TYPE_NUMBERS: Final = {"<f4": 7, "<u4": 6, "<u2": 4}
_HIGHEST_DEG: Final = 21.0
_MM_PER_M: Final = 1000.0
# From the last point of a cloud to the log time of its message.
_TRAVEL_NS: Final = 5 * NS_PER_MS


def write_clouds(path: Path, sensors: Sequence[BenchSensor], seconds: float) -> None:
    """Write the clouds of sensors, in the order of their log times."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "mlbatch bench")
        schema = writer.register_schema(
            _TYPE.replace("/", "/msg/"), "ros2msg", definition(_TYPE).encode()
        )
        about = {"offered_qos_profiles": ""}
        channels = [writer.register_channel(one.topic, "cdr", schema, about) for one in sensors]
        bodies = [_body(one.kind == BY_RING, one.name) for one in sensors]
        for number in range(int(seconds * NS_PER_S) // REVOLUTION_NS):
            for sensor, channel, body in zip(sensors, channels, bodies, strict=True):
                stamp_ns = EPOCH_NS + number * REVOLUTION_NS + sensor.phase_ns
                log_ns = stamp_ns + REVOLUTION_NS + _TRAVEL_NS
                struct.pack_into("<II", body, 4, *divmod(stamp_ns, NS_PER_S))
                writer.add_message(channel, log_ns, bytes(body), log_ns, number)
        finish: Callable[[], None] = writer.finish
        finish()


def _body(by_ring: bool, frame: str) -> bytearray:
    """A PointCloud2 in CDR; its stamp, from byte 4 on, is zero."""
    points = _points()
    height, width = (CLOUD_RINGS, CLOUD_COLUMNS) if by_ring else (1, CLOUD_RINGS * CLOUD_COLUMNS)
    data = (points if by_ring else points.T).tobytes()
    body = bytearray(b"\x00\x01\x00\x00" + bytes(8))
    _put_text(body, frame)
    _put(body, "<III", height, width, len(_POINT.names or ()))
    for name, (dtype, offset, *_) in (_POINT.fields or {}).items():
        _put_text(body, name)
        _put(body, "<IB", offset, _TYPE_NUMBERS[dtype.str])
        _put(body, "<I", 1)
    _put(body, "<B", 0)
    _put(body, "<III", _POINT.itemsize, width * _POINT.itemsize, len(data))
    return body + data + b"\x01"


def _put(body: bytearray, code: str, *values: int) -> None:
    """Append values, which begin at a multiple of the first one's size behind the head of CDR."""
    size = struct.calcsize(code[:2])
    body += bytes(-(len(body) - 4) % size)
    body += struct.pack(code, *values)


def _put_text(body: bytearray, text: str) -> None:
    """Append a string with its length and its closing NUL."""
    data = text.encode() + b"\0"
    _put(body, "<I", len(data))
    body += data


def _points() -> npt.NDArray[np.void]:
    """The points (rings, columns) of a revolution."""
    range_mm, reflectivity = scene(CLOUD_COLUMNS, CLOUD_RINGS)
    range_m = range_mm.T / _MM_PER_M
    elevation = np.radians(np.linspace(_HIGHEST_DEG, -_HIGHEST_DEG, CLOUD_RINGS))[:, None]
    azimuth = np.arange(CLOUD_COLUMNS) * (2 * np.pi / CLOUD_COLUMNS)
    points = np.zeros(range_m.shape, _POINT)
    points["x"] = range_m * np.cos(elevation) * np.cos(azimuth)
    points["y"] = -range_m * np.cos(elevation) * np.sin(azimuth)
    points["z"] = range_m * np.sin(elevation)
    points["intensity"] = reflectivity.T
    points["t"] = np.arange(CLOUD_COLUMNS) * REVOLUTION_NS // CLOUD_COLUMNS
    points["ring"] = np.arange(CLOUD_RINGS)[:, None]
    return points
