"""Messages of ROS 1 and ROS 2, field by field (facts/outputs.md, sections 3 and 4)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mlbatch.ros.definitions import FIELD_CODES
from mlbatch.ros.encoding import Wire
from mlbatch.types import F64Array, ImuSamples, RunInfo
from mlbatch.writers._layouts import Layout
from mlbatch.writers._points import Points

NewWire = Callable[[], Wire]

# sensor_msgs/Imu: -1 says that there is no orientation; all 0 says that a covariance is unknown.
_NO_ORIENTATION = (0.0, 0.0, 0.0, 1.0, -1.0, *[0.0] * 8)
_UNKNOWN_COVARIANCE = (0.0,) * 9


class CloudMessage:
    """Assembles sensor_msgs/PointCloud2 in one buffer that is used for every scan."""

    def __init__(self, layout: Layout, frame_id: str, wire: NewWire) -> None:
        self._wire = wire
        self._layout = layout
        self._frame_id = frame_id
        self._dtype = layout.dtype
        self._buffer = np.empty(0, dtype=np.uint8)

    def assemble(self, points: Points, stamp_ns: int, dense: bool) -> memoryview:
        """The message; it is valid until the next call."""
        head = self._head(points.time_ns.shape, stamp_ns)
        start, size = len(head), points.time_ns.size * self._layout.step
        total = start + size + 1
        self._fit(total)
        self._buffer[:start] = np.frombuffer(head, dtype=np.uint8)
        records = self._buffer[start : start + size].view(self._dtype)
        self._layout.pack(points, records.reshape(points.time_ns.shape))
        self._buffer[start + size] = dense
        return self._buffer[:total].data

    def blank(self, shape: tuple[int, ...], stamp_ns: int) -> memoryview:
        """A message as long as that of a cloud of this shape; it is valid until the next call."""
        total = len(self._head(shape, stamp_ns)) + math.prod(shape) * self._layout.step + 1
        self._fit(total)
        return self._buffer[:total].data

    def _fit(self, total: int) -> None:
        if len(self._buffer) < total:
            # Zeros: bytes between fields are never written.
            self._buffer = np.zeros(total * 5 // 4, dtype=np.uint8)

    def _head(self, shape: tuple[int, ...], stamp_ns: int) -> bytearray:
        """All that precedes the points; `shape`: (width,) or (height, width)."""
        step = self._layout.step
        height, width = shape if len(shape) == 2 else (1, shape[0])
        message = self._wire()
        message.header(stamp_ns, self._frame_id)
        message.put("I", height, width, len(self._layout.fields))
        for field in self._layout.fields:
            message.text(field.name)
            message.put("I", field.offset)
            message.put("B", FIELD_CODES[field.dtype])
            message.put("I", 1)
        message.put("B", 0)
        message.put("I", step, step * width, step * width * height)
        return message.data


def imu_message(samples: ImuSamples, which: int, frame_id: str, wire: NewWire) -> bytes:
    """sensor_msgs/Imu of one of the samples."""
    message = wire()
    message.header(int(samples.stamp_ns[which]), frame_id)
    message.put("d", *_NO_ORIENTATION)
    message.put("d", *samples.angular_velocity[which].tolist(), *_UNKNOWN_COVARIANCE)
    message.put("d", *samples.acceleration[which].tolist(), *_UNKNOWN_COVARIANCE)
    return bytes(message.data)


def static_transforms(info: RunInfo, stamp_ns: int, wire: NewWire) -> bytes:
    """tf2_msgs/TFMessage with the pose of every sensor in the body frame."""
    message = wire()
    message.put("I", len(info.sensors))
    for sensor in info.sensors:
        pose = sensor.body_from_sensor
        message.header(stamp_ns, info.frame_id)
        message.text(sensor.name)
        message.put("d", *pose[:3, 3].tolist(), *quaternion(pose[:3, :3]))
    return bytes(message.data)


def quaternion(rotation: F64Array) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w), w >= 0, of a rotation (3, 3).

    K = 4 q q^T is linear in the rotation; its row with the largest diagonal is q up to a factor
    and far from 0 (S. W. Shepperd, "Quaternion from rotation matrix", 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    product = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    row = product[int(np.argmax(np.diagonal(product)))]
    x, y, z, w = (row / np.sqrt((row * row).sum())).tolist()
    # Adding 0.0 turns -0.0 into 0.0, so that equal poses give equal bytes.
    sign = -1.0 if w < 0 else 1.0
    return sign * x + 0.0, sign * y + 0.0, sign * z + 0.0, sign * w + 0.0
