"""Packets of lidars as the messages that their drivers record.

Messages: docs/sources/messages.md section 1, docs/sources/hesai.md section 10,
docs/sources/velodyne.md section 12.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mlbatch.simulate.robosense.encode import DIFOP_MAGIC
from tests.builders.bags import Body, Recorded, packet_message

# A driver publishes the packets of a revolution a little after its end.
_LATER_NS = 3_000_000
_OUSTER = {"cdr": "ouster_sensor_msgs/PacketMsg", "ros1": "ouster_ros/PacketMsg"}
# Messages of one packet in ROS 1, and of many.
_KINDS = {
    "velodyne": ("velodyne_msgs/VelodynePacket", "velodyne_msgs/VelodyneScan"),
    "hesai": ("pandar_msgs/PandarPacket", "pandar_msgs/PandarScan"),
}


@dataclass(frozen=True, slots=True)
class Unit:
    """A lidar's packets, (receive time, payload), and the topic of its driver."""

    vendor: str
    topic: str
    packets: Iterable[tuple[int, bytes]]


def messages(unit: Unit, encoding: str, scan_ns: int = 0) -> list[Recorded]:
    """A message a packet; scan_ns: of Velodyne and HESAI one for all packets of such a time."""
    if unit.vendor in _KINDS and scan_ns:
        return _scans(unit, encoding, scan_ns)
    return [
        Recorded(unit.topic, *_message(unit.vendor, encoding, host_ns, payload))
        for host_ns, payload in unit.packets
    ]


def merged(*parts: list[Recorded]) -> list[Recorded]:
    """Messages in the order of their log times."""
    return sorted((one for part in parts for one in part), key=lambda one: one.log_ns)


def _message(vendor: str, encoding: str, host_ns: int, payload: bytes) -> tuple[str, int, bytes]:
    """Type, log time and data; newer drivers of Velodyne and HESAI record nebula_msgs."""
    body = Body(encoding)
    if vendor == "ouster":
        return _OUSTER[encoding], host_ns, packet_message(encoding, payload)
    if vendor == "robosense":
        # Header, is_difop, is_frame_begin, data.
        body.header(host_ns, "rslidar").put("B", payload.startswith(DIFOP_MAGIC), 0).blob(payload)
        return "rslidar_msg/RslidarPacket", host_ns, body.done()
    if encoding == "cdr":
        body.header(host_ns, "").put("I", 1).time(host_ns).blob(payload)
        return "nebula_msgs/NebulaPackets", host_ns, body.done()
    return _KINDS[vendor][0], host_ns, _put(vendor, body, host_ns, payload).done()


def _scans(unit: Unit, encoding: str, every_ns: int) -> list[Recorded]:
    """Header, then the packets; recorded with the last one."""
    groups: dict[int, list[tuple[int, bytes]]] = {}
    for host_ns, payload in unit.packets:
        groups.setdefault(host_ns // every_ns, []).append((host_ns, payload))
    found = []
    for group in groups.values():
        body = Body(encoding).header(group[0][0], unit.vendor).put("I", len(group))
        for host_ns, payload in group:
            _put(unit.vendor, body, host_ns, payload)
        log_ns = group[-1][0] + _LATER_NS
        found.append(Recorded(unit.topic, _KINDS[unit.vendor][1], log_ns, body.done()))
    return found


def _put(vendor: str, body: Body, host_ns: int, payload: bytes) -> Body:
    """A packet of a Velodyne; of a HESAI: `size` bytes of 1500 count."""
    body.time(host_ns)
    if vendor == "velodyne":
        return body.raw(payload)
    return body.raw(payload + b"\xaa" * (1500 - len(payload))).put("I", len(payload))
