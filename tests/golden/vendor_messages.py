"""Velodyne and HESAI packets in captures and bags, in the messages that their drivers record.

Messages: docs/sources/messages.md section 1, docs/sources/hesai.md section 10,
docs/sources/velodyne.md section 12.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.builders.bags import Body, Recorded
from tests.builders.captures import Packet, Section, udp_frame, write_pcap, write_pcapng
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import Form, write_folder, write_rosbag2
from tests.builders.sessions_of_bags import Mcap, split_at, write_mcap

NS_PER_MS = 1_000_000
HOST = "192.168.1.10"
# A driver publishes the packets of a revolution a little after its end.
TURN_NS = 100 * NS_PER_MS
LATER_NS = 3 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class Unit:
    """A lidar's packets, (receive time, payload); ip: sorts as its topic does."""

    vendor: str
    ip: str
    topic: str
    packets: tuple[tuple[int, bytes], ...]

    def late(self, by_ns: int) -> Unit:
        """All packets arrive later."""
        packets = tuple((host_ns + by_ns, payload) for host_ns, payload in self.packets)
        return Unit(self.vendor, self.ip, self.topic, packets)


def unit_of(vendor: str, packets: tuple[tuple[int, bytes], ...]) -> Unit:
    """A unit where its vendor's lidars are found."""
    ip, topic = {
        "hesai": ("192.168.1.200", "/pandar_packets"),
        "velodyne": ("192.168.1.201", "/velodyne_packets"),
    }[vendor]
    return Unit(vendor, ip, topic, packets)


Units = tuple[Unit, ...]
Frames = list[tuple[int, bytes]]


def frames(units: Units) -> Frames:
    """What a capture holds, in the order of arrival."""
    records = [
        (host_ns, udp_frame(payload, unit.ip, HOST, 10_000, 2368)[0])
        for unit in units
        for host_ns, payload in unit.packets
    ]
    return sorted(records, key=lambda record: record[0])


def _velodyne_packet(body: Body, host_ns: int, payload: bytes) -> Body:
    return body.time(host_ns).raw(payload)


def _pandar_packet(body: Body, host_ns: int, payload: bytes) -> Body:
    """`size` bytes of 1500 count."""
    filled = payload + b"\xaa" * (1500 - len(payload))
    return body.time(host_ns).raw(filled).put("I", len(payload))


PACKET_OF = {
    "velodyne": (_velodyne_packet, "velodyne_msgs/VelodyneScan", "velodyne_msgs/VelodynePacket"),
    "hesai": (_pandar_packet, "pandar_msgs/PandarScan", "pandar_msgs/PandarPacket"),
}


def singles(unit: Unit, encoding: str) -> list[Recorded]:
    """A message a packet."""
    put, _, kind = PACKET_OF[unit.vendor]
    return [
        Recorded(unit.topic, kind, host_ns, put(Body(encoding), host_ns, payload).done())
        for host_ns, payload in unit.packets
    ]


def scans(unit: Unit, encoding: str, every_ns: int = TURN_NS) -> list[Recorded]:
    """A message a revolution: header, then the packets; recorded with the last one."""
    put, kind, _ = PACKET_OF[unit.vendor]
    groups: dict[int, list[tuple[int, bytes]]] = {}
    for host_ns, payload in unit.packets:
        groups.setdefault(host_ns // every_ns, []).append((host_ns, payload))
    found = []
    for group in groups.values():
        body = Body(encoding).header(group[0][0], unit.vendor).put("I", len(group))
        for host_ns, payload in group:
            put(body, host_ns, payload)
        found.append(Recorded(unit.topic, kind, group[-1][0] + LATER_NS, body.done()))
    return found


def nebula(unit: Unit) -> list[Recorded]:
    """As newer drivers of both vendors record: nebula_msgs."""
    found = []
    for host_ns, payload in unit.packets:
        body = Body("cdr").header(host_ns, "").put("I", 1).time(host_ns).blob(payload)
        found.append(Recorded(unit.topic, "nebula_msgs/NebulaPackets", host_ns, body.done()))
    return found


def merged(*parts: list[Recorded]) -> list[Recorded]:
    """Messages in the order of their log times."""
    return sorted((one for part in parts for one in part), key=lambda one: one.log_ns)


def turns(units: Units, encoding: str) -> list[Recorded]:
    """Scan messages of all units."""
    return merged(*(scans(unit, encoding) for unit in units))


def _pcap(folder: Path, units: Units) -> Path:
    return write_pcap(folder / "a.pcap", frames(units))


def _pcapng(folder: Path, units: Units) -> Path:
    blocks = [Packet(frame, host_ns) for host_ns, frame in frames(units)]
    return write_pcapng(folder / "a.pcapng", [Section(blocks)])


def _db3(folder: Path, units: Units) -> Path:
    return write_rosbag2(folder / "a.db3", turns(units, "cdr"))


def _db3_of_singles(folder: Path, units: Units) -> Path:
    return write_rosbag2(folder / "a.db3", merged(*(singles(unit, "cdr") for unit in units)))


def _db3_folder(folder: Path, units: Units) -> Path:
    parts = split_at(merged(*(scans(unit, "cdr", TURN_NS // 7) for unit in units)), 3)
    return write_folder(folder / "bag", parts, Form(schema=4, zstd_messages=True))


def _mcap(folder: Path, units: Units) -> Path:
    return write_mcap(folder / "a.mcap", turns(units, "cdr"))


def _mcap_of_nebula(folder: Path, units: Units) -> Path:
    """One sensor a message a packet, the others a message a revolution."""
    mixed = merged(nebula(units[0]), *(scans(unit, "cdr") for unit in units[1:]))
    return write_mcap(folder / "a.mcap", mixed, Mcap(chunked=False))


def _bag(folder: Path, units: Units) -> Path:
    return write_rosbag1(folder / "a.bag", turns(units, "ros1"))


def _bag_of_singles(folder: Path, units: Units) -> Path:
    messages = merged(*(singles(unit, "ros1") for unit in units))
    return write_rosbag1(folder / "a.bag", messages, "lz4", callers=2)


Write = Callable[[Path, Units], Path]
CONTAINERS: Mapping[str, Write] = {
    "pcap": _pcap,
    "pcapng": _pcapng,
    "db3": _db3,
    "db3, a message a packet": _db3_of_singles,
    "db3, split, zstd": _db3_folder,
    "MCAP": _mcap,
    "MCAP, packets beside turns": _mcap_of_nebula,
    "ROS 1": _bag,
    "ROS 1, a message a packet": _bag_of_singles,
}
