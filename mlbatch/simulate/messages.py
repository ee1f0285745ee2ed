"""ROS 2 messages of a simulated recording: packets, IMU samples, ground truth (CDR).

Types: docs/sources/messages.md, section 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from mlbatch.arrays import F64Array
from mlbatch.frames.transforms import quaternion
from mlbatch.ros.encoding import Cdr
from mlbatch.simulate.interface import PacketTopic
from mlbatch.simulate.trajectory import Poses
from mlbatch.units import NS_PER_S

TF = "/tf"
TF_STATIC = "/tf_static"
# Messages with many packets contain those of a tenth of a second.
_GROUP_NS = NS_PER_S // 10
_UNKNOWN = (-1.0, *(0.0,) * 8)


@dataclass(frozen=True, slots=True)
class Stamped:
    """A packet with its receive time."""

    host_ns: int
    payload: bytes


# Packets, frame and topic to the message.
Encode = Callable[[Sequence[Stamped], str, PacketTopic], bytes]


def _packet(packets: Sequence[Stamped], frame: str, topic: PacketTopic) -> bytes:
    message = Cdr()
    message.put("I", len(packets[0].payload))
    return bytes(message.data) + packets[0].payload


def _velodyne(packets: Sequence[Stamped], frame: str, topic: PacketTopic) -> bytes:
    message = Cdr()
    message.header(packets[-1].host_ns, frame)
    message.put("I", len(packets))
    for packet in packets:
        _stamp(message, packet.host_ns)
        message.data += packet.payload
    return bytes(message.data)


def _hesai(packets: Sequence[Stamped], frame: str, topic: PacketTopic) -> bytes:
    message = Cdr()
    message.header(packets[-1].host_ns, frame)
    message.put("I", len(packets))
    for packet in packets:
        _stamp(message, packet.host_ns)
        message.put("I", len(packet.payload))
        message.data += packet.payload
        message.put("I", len(packet.payload))
    return bytes(message.data)


def _robosense(packets: Sequence[Stamped], frame: str, topic: PacketTopic) -> bytes:
    message = Cdr()
    message.header(packets[0].host_ns, frame)
    message.put("B", topic.flag, 0)
    message.put("I", len(packets[0].payload))
    return bytes(message.data) + packets[0].payload


def _stamp(message: Cdr, time_ns: int) -> None:
    message.put("i", time_ns // NS_PER_S)
    message.put("I", time_ns % NS_PER_S)


# Encoder by message type, and whether a message has many packets.
_ENCODE: Mapping[str, tuple[Encode, bool]] = {
    "ouster_sensor_msgs/PacketMsg": (_packet, False),
    "velodyne_msgs/VelodyneScan": (_velodyne, True),
    "hesai_ros_driver/UdpFrame": (_hesai, True),
    "rslidar_msg/RslidarPacket": (_robosense, False),
}


class PacketMessages:
    """Messages of the packets of one port, in the order of their receive times."""

    def __init__(self, topic: PacketTopic, frame: str) -> None:
        """frame: of the headers."""
        self.topic = topic
        self._frame = frame
        self._encode, self._has_many = _ENCODE[topic.message]
        self._waiting: list[Stamped] = []

    def add(self, packet: Stamped) -> bytes | None:
        """Return the message that a packet completes, of its receive time; None if it waits."""
        self._waiting.append(packet)
        if self._has_many and packet.host_ns - self._waiting[0].host_ns < _GROUP_NS:
            return None
        return self.rest()

    def rest(self) -> bytes | None:
        """Return a message with the packets that wait; None if there are none."""
        if not self._waiting:
            return None
        message = self._encode(self._waiting, self._frame, self.topic)
        self._waiting = []
        return message


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
