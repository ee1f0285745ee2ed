"""Sessions as they are recorded: the two lidars of the fixture in every container, or in several.

Messages: bags.py; other messages of the drivers: docs/sources/messages.md, sections 2 and
6.
"""

from __future__ import annotations

import itertools
import json
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import zstandard

from mlbatch.simulate.ouster.encode import metadata_json
from tests.builders import mcaps
from tests.builders.bags import (
    OUSTER_ROS1,
    Body,
    Recorded,
    fixture_messages,
    fixture_packets,
    packet_message,
)
from tests.builders.captures import Packet, Section, write_pcapng
from tests.builders.mcaps import LZ4, ZSTD, write_mcap
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import Form, write_folder, write_rosbag2
from tests.builders.run import TWO_LIDARS
from tests.builders.sessions import Unit
from tests.builders.traffic import read_pcap

Write = Callable[[Path], Path]
# A message record (opcode 5) that announces more bytes than follow.
CUT_RECORD = b"\x05" + (9000).to_bytes(8, "little") + bytes(40)


def packets_only(encoding: str) -> list[Recorded]:
    """The packets of the fixture, nothing else."""
    kind = "ouster_sensor_msgs/PacketMsg" if encoding == "cdr" else OUSTER_ROS1
    return [
        Recorded(topic, kind, host_ns, packet_message(encoding, payload))
        for topic, host_ns, payload in fixture_packets()
    ]


def session_of(encoding: str = "cdr", without: str = "", **packet_types: str) -> list[Recorded]:
    """The whole session less the topics that end in `without`."""
    messages = fixture_messages(encoding, **packet_types)
    return [one for one in messages if not without or not one.topic.endswith(without)]


def split_at(messages: Sequence[Recorded], parts: int) -> list[list[Recorded]]:
    """Messages in consecutive parts of about equal length."""
    bounds = [len(messages) * part // parts for part in range(parts + 1)]
    return [list(messages[a:b]) for a, b in itertools.pairwise(bounds)]


def _pcapng(folder: Path) -> Path:
    records = read_pcap(TWO_LIDARS / "two_lidars.pcap")
    blocks = [Packet(frame, host_ns) for host_ns, frame in records]
    return write_pcapng(folder / "a.pcapng", [Section(blocks)])


def _bag(compression: str, callers: int = 1) -> Write:
    def write(folder: Path) -> Path:
        return write_rosbag1(folder / "a.bag", packets_only("ros1"), compression, callers=callers)

    return write


def _db3(form: Form) -> Write:
    def write(folder: Path) -> Path:
        return write_rosbag2(folder / "a.db3", packets_only("cdr"), form)

    return write


def _packed_db3(folder: Path) -> Path:
    raw = write_rosbag2(folder / "a.db3", packets_only("cdr"))
    packed = folder / "a.db3.zstd"
    packed.write_bytes(zstandard.ZstdCompressor().compress(raw.read_bytes()))
    raw.unlink()
    return packed


def _folder(folder: Path) -> Path:
    return write_folder(folder / "bag", split_at(packets_only("cdr"), 3))


def _mcap(form: mcaps.Form) -> Write:
    def write(folder: Path) -> Path:
        return write_mcap(folder / "a.mcap", packets_only(form.encoding), form)

    return write


def _mcap_folder(folder: Path) -> Path:
    bag = folder / "bag"
    bag.mkdir()
    for number, part in enumerate(split_at(packets_only("cdr"), 3)):
        write_mcap(bag / f"bag_{number}.mcap", part)
    return bag


# The packets of the fixture; the fixture itself is the pcap.
CONTAINERS: Mapping[str, Write] = {
    "pcapng": _pcapng,
    "ROS 1": _bag("none"),
    "ROS 1, bz2": _bag("bz2"),
    "ROS 1, lz4, two publishers": _bag("lz4", callers=2),
    "db3, schema 3": _db3(Form()),
    "db3, schema 4": _db3(Form(schema=4)),
    "db3, no index": _db3(Form(index=False)),
    "db3, zstd messages": _db3(Form(zstd_messages=True)),
    "db3, zstd file": _packed_db3,
    "db3, folder of three": _folder,
    "MCAP": _mcap(mcaps.Form()),
    "MCAP, lz4": _mcap(mcaps.Form(compression=LZ4)),
    "MCAP, zstd": _mcap(mcaps.Form(compression=ZSTD)),
    "MCAP, unchunked": _mcap(mcaps.Form(chunked=False)),
    "MCAP, cut off": _mcap(mcaps.Form(chunked=False, summary=False, tail=CUT_RECORD)),
    "MCAP, chunks cut off": _mcap(mcaps.Form(summary=False, tail=CUT_RECORD)),
    "MCAP of ROS 1": _mcap(mcaps.Form("ros1")),
    "MCAP, folder of three": _mcap_folder,
}


def edited_copy(source: Path, target: Path) -> Path:
    """A copy of a bag's folder that says neither its storage nor its serialization."""
    target.mkdir()
    for file in source.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    about = target / "metadata.yaml"
    text = about.read_text(encoding="utf-8")
    text = text.replace("storage_identifier: sqlite3", 'storage_identifier: ""')
    text = text.replace("serialization_format: cdr", 'serialization_format: ""')
    about.write_text(text, encoding="utf-8")
    for file in target.glob("*.db3"):
        with sqlite3.connect(file) as connection:
            connection.execute("UPDATE topics SET serialization_format = ''")
        connection.close()
    return target


def urdf(left_x_m: float) -> str:
    """A robot description that puts the left lidar at this x, and as the fixture else."""
    return (
        '<robot name="machine"><link name="base_link"/><link name="left/os_sensor"/>'
        '<joint name="left_mount" type="fixed"><parent link="base_link"/>'
        '<child link="left/os_sensor"/>'
        f'<origin xyz="{left_x_m} 0.95 2.45" rpy="0.00698131701 0.38397243544 1.39626340160"/>'
        "</joint></robot>"
    )


def description(text: str, host_ns: int) -> Recorded:
    """A latched robot_description."""
    data = Body("cdr").text(text).done()
    return Recorded("/robot_description", "std_msgs/String", host_ns, data, latched=True)


def unit_messages(unit: Unit, place: str) -> list[Recorded]:
    """A unit's metadata, then its packets, as its driver publishes them."""
    kind = "ouster_sensor_msgs/PacketMsg"
    text = json.dumps(metadata_json(unit.spec))
    data = Body("cdr").text(text).done()
    topic = f"/{place}/ouster"
    first_ns = unit.payloads[0][0]
    return [
        Recorded(f"{topic}/metadata", "std_msgs/String", first_ns, data, latched=True),
        *(
            Recorded(f"{topic}/lidar_packets", kind, host_ns, packet_message("cdr", payload))
            for host_ns, payload in unit.payloads
        ),
    ]


def frame_message(unit: Unit) -> bytes:
    """All packets of a unit as a driver sends a frame: without times of their own."""
    body = Body("cdr").header(unit.begin_ns).put("I", len(unit.payloads))
    for _, payload in unit.payloads:
        body.time(0).blob(payload).put("I", len(payload))
    return body.done()
