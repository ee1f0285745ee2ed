"""Sessions of the matrix in every container, with the rig that names their lidars.

The bag for ROS 2 has scans of HESAI and Velodyne, of many packets a message, all others a message
a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tests.builders.bags import Recorded
from tests.builders.captures import Packet, Section, udp_frame, write_pcap, write_pcapng
from tests.builders.mcaps import write_mcap
from tests.builders.messages import Unit, merged, messages
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_rosbag2
from tests.matrix.lidars import VENDORS, Sent

# Scan messages contain the packets of so many ns, less than the shortest wait of the matrix.
SCAN_NS = 20_000_000
Session = Sequence[Sent]


def packets_of(sent: Sent) -> list[tuple[int, bytes]]:
    """(receive time, payload)."""
    return list(zip(sent.host_ns.tolist(), sent.payloads, strict=True))


def _frames(session: Session) -> list[tuple[int, bytes]]:
    records = [
        (host_ns, udp_frame(payload, vendor.ip, dport=vendor.port)[0])
        for sent in session
        for vendor in [VENDORS[sent.vendor]]
        for host_ns, payload in packets_of(sent)
    ]
    # By receive time, then in the order of the lidars.
    return sorted(records, key=lambda record: record[0])


def _messages(session: Session, encoding: str, scan_ns: int = 0) -> list[Recorded]:
    units = [Unit(sent.vendor, VENDORS[sent.vendor].topic, packets_of(sent)) for sent in session]
    return merged(*(messages(unit, encoding, scan_ns) for unit in units))


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
    return write_rosbag2(folder / "drive.db3", _messages(session, "cdr", SCAN_NS))


CONTAINERS: Mapping[str, Callable[[Path, Session], Path]] = {
    "pcap": _pcap,
    "pcapng": _pcapng,
    "mcap": _mcap,
    "rosbag1": _rosbag1,
    "rosbag2": _rosbag2,
}
CAPTURES = ("pcap", "pcapng")


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
