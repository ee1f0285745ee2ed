"""Sessions of the matrix in every container, with the rig that names their lidars.

Messages: docs/sources/messages.md section 1; the bag for ROS 2 has scans of HESAI and Velodyne, of
many packets a message, all others a message a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.builders.bags import Body, Recorded, packet_message
from tests.builders.captures import Packet, Section, udp_frame, write_pcap, write_pcapng
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.sessions_of_bags import write_mcap
from tests.golden.vendor_messages import Unit, merged, nebula, scans, singles
from tests.matrix.lidars import VENDORS, Sent

# Scan messages contain the packets of so many ns, less than the shortest wait of the matrix.
SCAN_NS = 20_000_000
Session = Sequence[Sent]


def packets_of(sent: Sent) -> tuple[tuple[int, bytes], ...]:
    """(receive time, payload)."""
    return tuple(zip(sent.host_ns.tolist(), sent.payloads, strict=True))


def unit(sent: Sent) -> Unit:
    """As the builders of messages want it."""
    vendor = VENDORS[sent.vendor]
    return Unit(sent.vendor, vendor.ip, vendor.topic, packets_of(sent))


def _frames(session: Session) -> list[tuple[int, bytes]]:
    records = [
        (host_ns, udp_frame(payload, vendor.ip, dport=vendor.port)[0])
        for sent in session
        for vendor in [VENDORS[sent.vendor]]
        for host_ns, payload in packets_of(sent)
    ]
    # By receive time, then in the order of the lidars.
    return sorted(records, key=lambda record: record[0])


def _ouster(sent: Sent, encoding: str) -> list[Recorded]:
    kind = {"cdr": "ouster_sensor_msgs/PacketMsg", "ros1": "ouster_ros/PacketMsg"}[encoding]
    topic = VENDORS[sent.vendor].topic
    return [
        Recorded(topic, kind, host_ns, packet_message(encoding, payload))
        for host_ns, payload in packets_of(sent)
    ]


def _robosense(sent: Sent, encoding: str) -> list[Recorded]:
    """Header, is_difop, is_frame_begin, data."""
    topic = VENDORS[sent.vendor].topic
    kind = "rslidar_msg/RslidarPacket"
    return [
        Recorded(
            topic,
            kind,
            host_ns,
            Body(encoding).header(host_ns, "rslidar").put("B", 0, 0).blob(payload).done(),
        )
        for host_ns, payload in packets_of(sent)
    ]


def _messages(session: Session, encoding: str, *, in_scans: bool = False) -> list[Recorded]:
    parts = []
    for sent in session:
        if sent.vendor == "ouster":
            parts.append(_ouster(sent, encoding))
        elif sent.vendor == "robosense":
            parts.append(_robosense(sent, encoding))
        elif in_scans:
            parts.append(scans(unit(sent), encoding, SCAN_NS))
        elif encoding == "cdr":
            parts.append(nebula(unit(sent)))
        else:
            parts.append(singles(unit(sent), encoding))
    return merged(*parts)


def _pcap(folder: Path, session: Session) -> Path:
    return write_pcap(folder / "drive.pcap", _frames(session))


def _pcapng(folder: Path, session: Session) -> Path:
    blocks = [Packet(frame, host_ns) for host_ns, frame in _frames(session)]
    return write_pcapng(folder / "drive.pcapng", [Section(blocks)])


def _mcap(folder: Path, session: Session) -> Path:
    return write_mcap(folder / "drive.mcap", _messages(session, "cdr"))


def _rosbag1(folder: Path, session: Session) -> Path:
    return write_rosbag1(folder / "drive.bag", _messages(session, "ros1"))


def _rosbag2(folder: Path, session: Session) -> Path:
    return write_rosbag2(folder / "drive.db3", _messages(session, "cdr", in_scans=True))


CONTAINERS: Mapping[str, Callable[[Path, Session], Path]] = {
    "pcap": _pcap,
    "pcapng": _pcapng,
    "mcap": _mcap,
    "rosbag1": _rosbag1,
    "rosbag2": _rosbag2,
}
CAPTURES = ("pcap", "pcapng")


def names(session: Session) -> list[str]:
    """Names of the sensors in the order of the rig: their vendors."""
    return [sent.vendor for sent in session]


def rig_text(session: Session, container: str, clocks: Mapping[str, str] | None = None) -> str:
    """A rig; clocks: of some sensors, the text of their `clock`."""
    lines = ["rate_hz: 20", "sensors:"]
    for number, sent in enumerate(session):
        vendor = VENDORS[sent.vendor]
        stream = f"topic: {vendor.topic}"
        if container in CAPTURES:
            stream = f"source_ip: {vendor.ip}, port: {vendor.port}"
        pose = f"translation_m: [0, 0, {number}], rotation_rpy_deg: [0, 0, {90 * number}]"
        lines += [
            f"  - name: {sent.vendor}",
            f"    stream: {{{stream}}}",
            f"    extrinsics: {{{pose}}}",
        ]
        if vendor.metadata:
            lines.append(f"    metadata: {vendor.metadata}")
        if clocks and sent.vendor in clocks:
            lines.append(f"    clock: {clocks[sent.vendor]}")
    return "\n".join(lines) + "\n"


def span_ns(session: Session) -> tuple[int, int]:
    """First and last receive time."""
    hosts = np.concatenate([sent.host_ns for sent in session])
    return int(hosts.min()), int(hosts.max())
