"""The message types that hold raw packets of lidars, and where in them.

Types, stamps and traps: facts/messages.md, sections 1 to 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mlbatch.readers._cdr import ENCODINGS


@dataclass(frozen=True, slots=True)
class Envelope:
    """Where payloads lie in a message type.

    payload: field of the bytes; inside: field of the message(s) that hold it, "" for the message
    itself; size: field with the number of valid bytes; stamp: field of the arrival time at the
    host; stamped_by: encodings whose drivers fill it; corrections: a calibration may stand among
    the packets; padded: short packets may stand in a field of fixed length.
    """

    payload: str
    inside: str = ""
    size: str = ""
    stamp: str = ""
    stamped_by: tuple[str, ...] = ENCODINGS
    corrections: bool = False
    padded: bool = False


_OUSTER = Envelope("buf")
# The ROS 1 driver of pandar_msgs leaves its stamps empty, or fills them while replaying.
_PANDAR = Envelope("data", size="size", stamp="stamp", stamped_by=("cdr",))
_HESAI = Envelope("data", size="size", stamp="stamp")
_ROBOSENSE = Envelope("data", stamp="stamp", padded=True)

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
    # Its header holds the sensor's time, or nothing.
    "rslidar_msg/RslidarPacket": Envelope("data"),
    "rslidar_msgs/rslidarScan": Envelope("data", "packets", stamp="stamp", padded=True),
    "rslidar_msgs/rslidarPacket": _ROBOSENSE,
    "robosense_msgs/RobosenseScan": Envelope("data", "packets", stamp="stamp", padded=True),
    "robosense_msgs/RobosensePacket": _ROBOSENSE,
    "robosense_msgs/RobosenseInfoPacket": Envelope("data", "packet", stamp="stamp", padded=True),
    "udp_msgs/UdpPacket": Envelope("data"),
}
