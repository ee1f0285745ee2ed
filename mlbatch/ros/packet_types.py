"""Types of messages with raw packets of lidars, and where the packets are in them.

Types, stamps and traps: docs/sources/messages.md, sections 1 to 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mlbatch.ros.encoding import ENCODINGS


@dataclass(frozen=True, slots=True)
class Envelope:
    """Position of payloads in a message type.

    payload: field of the bytes; inside: field of the message(s) that contain it, "" for the message
    itself; size: field with the number of valid bytes; stamp: field of the receive time at the
    host; stamped_by: encodings whose drivers fill it; corrections: a calibration may be among the
    packets; padded: short packets may be in a field of fixed length; may_lack_size: some
    definitions have no `size`.
    """

    payload: str
    inside: str = ""
    size: str = ""
    stamp: str = ""
    stamped_by: tuple[str, ...] = ENCODINGS
    corrections: bool = False
    padded: bool = False
    may_lack_size: bool = False


_OUSTER = Envelope("buf")
# The ROS 1 driver of pandar_msgs leaves its stamps empty, or fills them while replaying.
_PANDAR = Envelope("data", size="size", stamp="stamp", stamped_by=("cdr",))
_HESAI = Envelope("data", size="size", stamp="stamp")
_OLD_ROBOSENSE = Envelope("data", stamp="stamp", padded=True)
# A branch of Nebula has longer fields, with a size.
_ROBOSENSE = replace(_OLD_ROBOSENSE, size="size", may_lack_size=True)

PACKET_TYPES: Mapping[str, Envelope] = {
    "ouster_ros/PacketMsg": _OUSTER,
    "ouster_msgs/PacketMsg": _OUSTER,
    "ouster_sensor_msgs/PacketMsg": _OUSTER,
    "velodyne_msgs/VelodyneScan": Envelope("data", "packets", stamp="stamp"),
    "velodyne_msgs/VelodynePacket": Envelope("data", stamp="stamp"),
    "hesai_lidar/PandarScan": Envelope("data", "packets", "size", "stamp", corrections=True),
    "hesai_lidar/PandarPacket": _HESAI,
    "pandar_msgs/PandarScan": Envelope("data", "packets", "size", "stamp", ("cdr",)),
    "pandar_msgs/PandarPacket": _PANDAR,
    "pandar_msgs/PandarJumboPacket": _PANDAR,
    "hesai_ros_driver/UdpFrame": Envelope("data", "packets", "size", "stamp"),
    "hesai_ros_driver/UdpPacket": _HESAI,
    "nebula_msgs/NebulaPackets": Envelope("data", "packets", stamp="stamp"),
    "nebula_msgs/NebulaPacket": Envelope("data", stamp="stamp"),
    # Its header has the sensor's time, or nothing.
    "rslidar_msg/RslidarPacket": Envelope("data"),
    "rslidar_msgs/rslidarScan": Envelope("data", "packets", stamp="stamp", padded=True),
    "rslidar_msgs/rslidarPacket": _OLD_ROBOSENSE,
    "robosense_msgs/RobosenseScan": replace(_ROBOSENSE, inside="packets"),
    "robosense_msgs/RobosensePacket": _ROBOSENSE,
    "robosense_msgs/RobosenseInfoPacket": replace(_ROBOSENSE, inside="packet"),
    "udp_msgs/UdpPacket": Envelope("data"),
}

# First bytes of RoboSense packets that are shorter than the field, and their length.
PADDED = ((b"\x55\xaa\x5a\xa5", 1210), (b"\xa5\xff\x00\x5a", 256))
