"""Small recordings for the digests: both fixtures, a lidar of each vendor, decoded clouds.

All imports from the builders are here; the rest of the digest guard knows only the command line.
A recording is the same packets in several containers, in one folder with its rig and metadata.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tests.builders import livox
from tests.builders.bags import Recorded
from tests.builders.captures import Packet, Section, udp_frame, write_pcap, write_pcapng
from tests.builders.mcaps import write_mcap
from tests.builders.messages import Unit, merged, messages
from tests.builders.points import OUSTER, STAMP_NS, Form, cloud_message, write_points
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.sessions_of_bags import packets_only, session_of
from tests.builders.traffic import Datagram, datagrams_of, read_pcap
from tests.matrix.containers import CONTAINERS as MATRIX_CONTAINERS
from tests.matrix.containers import SCAN_NS, rig_text
from tests.matrix.lidars import VENDORS, Spell, write_metadata

FIXTURES = Path(__file__).resolve().parents[2] / "fixtures"
CAPTURES = ("pcap", "pcapng")
BAGS = ("mcap", "bag", "db3")
CONTAINERS = CAPTURES + BAGS
# Recordings and the containers they are written in; the first one is that of the baseline.
RECORDINGS: Mapping[str, Sequence[str]] = {
    "two_lidars": CONTAINERS,
    "four_makers": CONTAINERS,
    "ouster": CONTAINERS,
    "velodyne": CONTAINERS,
    "hesai": CONTAINERS,
    "robosense": CONTAINERS,
    "livox": CAPTURES,
    "clouds": BAGS,
    "bag_mcap": ("mcap",),
    "bag_db3": ("db3",),
    "bag_ros1": ("bag",),
}
_WITH_RIG = tuple(name for name, containers in RECORDINGS.items() if containers == CONTAINERS)

NS_PER_MS = 1_000_000
# Half a second before a full hour in 2026.
_BEGIN_NS = 1_777_881_599_500_000_000
_SPELL = Spell(_BEGIN_NS, 240 * NS_PER_MS)
_MATRIX_NAMES = {"bag": "rosbag1", "db3": "rosbag2"}


def write_recordings(folder: Path) -> None:
    """Write all recordings, each into the folder of its name."""
    for name in RECORDINGS:
        (folder / name).mkdir(parents=True)
    _two_lidars(folder / "two_lidars")
    _four_makers(folder / "four_makers")
    for vendor in VENDORS:
        _vendor(folder / vendor, vendor)
    _livox(folder / "livox")
    _clouds(folder / "clouds")
    # Packets, metadata, transforms and an IMU, as drivers record them.
    write_mcap(folder / "bag_mcap" / "drive.mcap", session_of("cdr"))
    write_rosbag2(folder / "bag_db3" / "drive.db3", session_of("cdr"))
    write_rosbag1(folder / "bag_ros1" / "drive.bag", session_of("ros1"))


def rig_of(recording: str, container: str) -> str:
    """File name of the rig in the folder of the recording, "" where there is none."""
    if recording not in _WITH_RIG:
        return ""
    return "rig.yaml" if container in CAPTURES else "rig_of_topics.yaml"


def _write_bags(folder: Path, recorded: Mapping[str, Sequence[Recorded]]) -> None:
    """recorded: messages of each container."""
    write_mcap(folder / "drive.mcap", recorded["mcap"])
    write_rosbag1(folder / "drive.bag", recorded["bag"])
    write_rosbag2(folder / "drive.db3", recorded["db3"])


def _write_captures(folder: Path, frames: Sequence[tuple[int, bytes]]) -> None:
    write_pcap(folder / "drive.pcap", list(frames))
    blocks = [Packet(frame, host_ns) for host_ns, frame in frames]
    write_pcapng(folder / "drive.pcapng", [Section(blocks)])


def _copy_fixture(folder: Path, fixture: str) -> None:
    for path in (FIXTURES / fixture).iterdir():
        if path.suffix in (".yaml", ".json", ".csv") and path.name != "expected.json":
            shutil.copy(path, folder)
    _write_captures(folder, read_pcap(FIXTURES / fixture / f"{fixture}.pcap"))
    # The fixture's own file, not a copy of its frames.
    shutil.copy(FIXTURES / fixture / f"{fixture}.pcap", folder / "drive.pcap")


def _two_lidars(folder: Path) -> None:
    _copy_fixture(folder, "two_lidars")
    # Serial numbers identify the sensors in every container.
    shutil.copy(folder / "rig.yaml", folder / "rig_of_topics.yaml")
    cdr, ros1 = packets_only("cdr"), packets_only("ros1")
    _write_bags(folder, {"mcap": cdr, "bag": ros1, "db3": cdr})


# Source IP, port and topic of the lidars of the fixture; RoboSense sends its calibration, too.
_FOUR = {
    "ouster": ("192.168.1.87", (7502,), "/left/ouster/lidar_packets"),
    "velodyne": ("192.168.1.201", (2368,), "/roof/velodyne_packets"),
    "hesai": ("192.168.1.202", (2368,), "/right/pandar_packets"),
    "robosense": ("192.168.1.200", (6699, 7788), "/rear/rslidar_packets"),
}


def _four_makers(folder: Path) -> None:
    _copy_fixture(folder, "four_makers")
    rig = (folder / "rig.yaml").read_text(encoding="utf-8")
    for source_ip, ports, topic in _FOUR.values():
        rig = rig.replace(f"source_ip: {source_ip}, port: {ports[0]}", f"topic: {topic}")
    (folder / "rig_of_topics.yaml").write_text(rig, encoding="utf-8")
    sent = datagrams_of(read_pcap(folder / "drive.pcap"))
    _write_bags(folder, {container: _four_messages(sent, container) for container in BAGS})


def _four_messages(sent: Sequence[Datagram], container: str) -> list[Recorded]:
    encoding = "ros1" if container == "bag" else "cdr"
    parts = []
    for vendor, (source_ip, ports, topic) in _FOUR.items():
        own = [one for one in sent if one.source == source_ip and one.port in ports]
        unit = Unit(vendor, topic, [(one.host_ns, one.payload) for one in own])
        parts.append(messages(unit, encoding, SCAN_NS if container == "db3" else 0))
    return merged(*parts)


def _vendor(folder: Path, vendor: str) -> None:
    session = [VENDORS[vendor].send(_SPELL)]
    write_metadata(folder)
    for path in folder.iterdir():
        if path.name != VENDORS[vendor].metadata:
            path.unlink()
    for container in CONTAINERS:
        MATRIX_CONTAINERS[_MATRIX_NAMES.get(container, container)](folder, session)
    for container in ("pcap", "mcap"):
        text = rig_text(session, container)
        (folder / rig_of(vendor, container)).write_text(text, encoding="utf-8")


def _livox(folder: Path) -> None:
    """A quarter of a second of points at 0.48 ms a packet of 96."""
    spec = livox.LivoxSpec(start_ns=_BEGIN_NS)
    rng = np.random.default_rng(5)
    count = 520 * spec.points
    coordinates = rng.integers(-20_000, 20_000, (count, 1, 3))
    coordinates[rng.random(count) < 0.2] = 0
    levels = rng.integers(0, 256, (count, 1))
    packets = livox.point_packets(spec, coordinates, levels)
    frames = [(at, udp_frame(payload, "10.0.0.5", dport=56301)[0]) for at, payload in packets]
    _write_captures(folder, frames)


def _clouds(folder: Path) -> None:
    """Four revolutions of 64 columns of 8 points."""
    rng = np.random.default_rng(7)
    revolutions = []
    for _ in range(4):
        xyz = rng.integers(-400, 400, (64, 8, 3)) / 16
        xyz[rng.random((64, 8)) < 0.1] = 0
        points = [
            (*xyz[column, ring].tolist(), int(ring + column), column * 1_562_500, ring)
            for ring in range(8)
            for column in range(64)
        ]
        revolutions.append(points)
    recorded = {}
    for container in BAGS:
        form = Form("ros1" if container == "bag" else "cdr")
        data = [
            cloud_message(OUSTER, points, STAMP_NS + number * 100 * NS_PER_MS, form)
            for number, points in enumerate(revolutions)
        ]
        recorded[container] = write_points("/roof/points", data)
    _write_bags(folder, recorded)
