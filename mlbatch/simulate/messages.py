"""ROS 2 messages of a simulated recording: IMU samples, ground truth (CDR).

Types: docs/sources/messages.md, section 1.
"""

from __future__ import annotations

from collections.abc import Sequence

from mlbatch.arrays import F64Array
from mlbatch.frames.transforms import quaternion
from mlbatch.ros.encoding import Cdr
from mlbatch.simulate.trajectory import Poses

TF = "/tf"
TF_STATIC = "/tf_static"
_UNKNOWN = (-1.0, *(0.0,) * 8)


def text_message(text: str) -> bytes:
    """Return a std_msgs/String."""
    message = Cdr()
    message.text(text)
    return bytes(message.data)


def imu_message(stamp_ns: int, frame: str, force: Sequence[float], rate: Sequence[float]) -> bytes:
    """Return a sensor_msgs/Imu: m/s2 and rad/s, frame of the IMU, without orientation."""
    message = Cdr()
    message.header(stamp_ns, frame)
    message.put("d", 0.0, 0.0, 0.0, 1.0, *_UNKNOWN)
    message.put("d", *rate, *(0.0,) * 9)
    message.put("d", *force, *(0.0,) * 9)
    return bytes(message.data)


def static_message(stamp_ns: int, parent: str, child: str, parent_from_child: F64Array) -> bytes:
    """Return a tf2_msgs/TFMessage of a constant transform (4, 4), m."""
    message = Cdr()
    message.put("I", 1)
    message.header(stamp_ns, parent)
    message.text(child)
    message.put("d", *parent_from_child[:3, 3].tolist())
    message.put("d", *quaternion(parent_from_child))
    return bytes(message.data)


def transform_message(stamp_ns: int, parent: str, child: str, poses: Poses, row: int) -> bytes:
    """Return a tf2_msgs/TFMessage of the pose of the body."""
    message = Cdr()
    message.put("I", 1)
    message.header(stamp_ns, parent)
    message.text(child)
    message.put("d", *poses.position_m[row].tolist())
    message.put("d", *quaternion(poses.rotation[row]))
    return bytes(message.data)


def odometry_message(stamp_ns: int, parent: str, child: str, poses: Poses, row: int) -> bytes:
    """Return a nav_msgs/Odometry of the pose of the body; twist in the frame of the body."""
    message = Cdr()
    message.header(stamp_ns, parent)
    message.text(child)
    message.put("d", *poses.position_m[row].tolist())
    message.put("d", *quaternion(poses.rotation[row]), *(0.0,) * 36)
    message.put("d", *(poses.rotation[row].T @ poses.velocity[row]).tolist())
    message.put("d", *poses.angular_velocity[row].tolist(), *(0.0,) * 36)
    return bytes(message.data)
