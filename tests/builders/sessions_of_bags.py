"""Sessions as they are recorded: the two lidars of the fixture in every container, or in several.

Messages: bags.py; other messages of the drivers: docs/sources/messages.md, sections 2 and
6.
"""

from __future__ import annotations

import itertools
import json
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from mlbatch.simulate.ouster.encode import metadata_json
from tests.builders.bags import (
    OUSTER_ROS1,
    Body,
    Recorded,
    fixture_messages,
    fixture_packets,
    packet_message,
)
from tests.builders.sessions import Unit


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
