"""Targets: messages of bags and the texts that define them, down to packets, clouds and frames."""

from __future__ import annotations

import json
import random
import zlib
from collections.abc import Generator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from mlbatch.discovery.first_seconds import FirstSeconds, with_clouds
from mlbatch.frames.naming import Candidate
from mlbatch.readers.bag.recording import BagRecording, Portion
from mlbatch.ros.definitions import definition_text
from mlbatch.ros.packet_types import PACKET_TYPES
from mlbatch.types import StreamTable, Topic
from tests.builders import points
from tests.builders.bags import Body, Recorded, definition, packet_message, transforms_message
from tests.builders.sessions_of_bags import description, urdf
from tests.builders.two_lidars import LEFT
from tests.fuzz.decoding import decode_samples
from tests.fuzz.framing import Part, joined, parts_of
from tests.fuzz.harness import Target
from tests.fuzz.mutation import Seeds, mutated, mutated_text
from tests.fuzz.readers import check_batch
from tests.readers.bag.test_packet_messages import serialised

# Parts of an input: the topic (type, encoding and format as a line), its definition, messages.
_TOPIC, _DEFINITION, _MESSAGE = range(3)
_IDL = """\
module velodyne_msgs { module msg {
  typedef uint8 uint8__1206[1206];
  struct VelodynePacket { builtin_interfaces::msg::Time stamp; uint8__1206 data; };
}; };
================================================================================
IDL: builtin_interfaces/msg/Time
module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };
"""
_CORRECTIONS = "std_msgs/UInt8MultiArray"
_POINT = (1.0, 2.0, 0.5)


def _input(type_name: str, encoding: str, text: str, *messages: bytes, name: str = "") -> bytes:
    """One topic and its messages; name: the end of its name, which says what it is for."""
    kind = "ros1msg" if encoding == "ros1" else "ros2msg"
    if text.startswith("module"):
        kind = "ros2idl"
    about = f"{type_name}\t{encoding}\t{kind}\t/left/{name or 'packets'}"
    parts = [Part(_TOPIC, 0, about.encode()), Part(_DEFINITION, 0, text.encode())]
    return joined([*parts, *(Part(_MESSAGE, 10**18, message) for message in messages)])


@lru_cache(maxsize=1)
def _packet_seeds() -> Seeds:
    payload = bytes(range(256)) * 5
    seeds = []
    for name in PACKET_TYPES:
        for encoding in ("cdr", "ros1"):
            packets = [payload[:1206], payload[:1206]]
            if name.startswith("ouster"):
                message = packet_message(encoding, payload)
                seeds.append(_input(name, encoding, definition(name, encoding), message))
                continue
            message = serialised(name, encoding, packets)
            text = definition_text(name) if encoding == "cdr" else ""
            seeds.append(_input(name, encoding, text, message, message))
    velodyne = serialised("velodyne_msgs/VelodynePacket", "cdr", [payload[:1206]])
    seeds.append(_input("velodyne_msgs/VelodynePacket", "cdr", _IDL, velodyne))
    return tuple(seeds)


@lru_cache(maxsize=1)
def _other_seeds() -> Seeds:
    """Transforms, descriptions, metadata, angle files."""
    edge = ("base_link", "left/os_sensor", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    seeds = []
    for encoding in ("cdr", "ros1"):
        frames = transforms_message(encoding, [edge, edge])
        text = Body(encoding).text(json.dumps(LEFT.metadata)).done()
        layout = Body(encoding).put("I", 0, 0).blob(b"Laser id,Elevation,Azimuth\n1,2,3\n").done()
        robot: Recorded = description(urdf(0.5), 10**18)
        robot_text = Body(encoding).text(urdf(0.25)).done() if encoding == "ros1" else robot.data
        for type_name, name, message in (
            ("tf2_msgs/TFMessage", "tf_static", frames),
            ("std_msgs/String", "metadata", text),
            ("std_msgs/String", "robot_description", robot_text),
            (_CORRECTIONS, "lidar_corrections", layout),
        ):
            known = definition(type_name, encoding)
            seeds.append(_input(type_name, encoding, known, message, name=name))
            seeds.append(_input(type_name, encoding, "", message, name=name))
    return tuple(seeds)


@lru_cache(maxsize=1)
def _cloud_seeds() -> Seeds:
    seeds = []
    fields = (points.OUSTER, points.VELODYNE, points.HESAI, points.LIVOX, points.AUTOWARE)
    for encoding in ("cdr", "ros1"):
        for names in (*fields, points.XYZ):
            rows = [[*_POINT, *(number % 7 for _ in names[3:])] for number in range(1, 13)]
            form = points.Form(encoding, height=2, gap=2, row_gap=3)
            message = points.cloud_message(names, rows, form=form)
            seeds.append(_input(points.CLOUD, encoding, "", message, message))
        custom = points.custom_message(
            [(number * 1000, *_POINT, 9, 0, number % 4) for number in range(12)], encoding=encoding
        )
        kinds = (points.CUSTOM, points.CUSTOM2)
        seeds += [_input(kind, encoding, "", custom, custom) for kind in kinds]
    return tuple(seeds)


def _mutated(rng: random.Random, seeds: Seeds) -> bytes:
    """Messages as bytes; definitions and topics as texts."""
    parts = parts_of(rng.choice(seeds))
    pick = rng.random()
    kind = _MESSAGE if pick < 0.7 else _DEFINITION if pick < 0.95 else _TOPIC
    others = [part.data for seed in rng.choices(seeds, k=3) for part in parts_of(seed)]
    changed = []
    for part in parts:
        data = part.data
        if part.kind == kind and (kind != _MESSAGE or rng.random() < 0.7):
            data = (mutated if kind == _MESSAGE else mutated_text)(rng, (data, data, data, *others))
        changed.append(Part(part.kind, part.host_ns, data))
    return joined(changed)


def _read(data: bytes, folder: Path) -> None:
    """A bag of one topic, from its messages to the sensors that they describe."""
    topic, messages = _topic_of(parts_of(data))
    if topic is None:
        return
    table = StreamTable()

    def portions(recording: BagRecording) -> Generator[Portion, None, None]:
        size = np.array([len(message) for message in messages], np.int64)
        whole = np.frombuffer(b"".join(messages) + bytes(128), np.uint8)
        end = np.cumsum(size)
        log_ns = 10**18 + np.arange(len(size)) * 10**8
        yield Portion(whole, end - size, end, log_ns, np.zeros(len(size), np.int64))

    bag = BagRecording(folder, "bag", 0, table, portions, topics=(topic,))
    recordings, _ = with_clouds([bag], table, None, ())
    first = FirstSeconds(recordings, table)
    sampler, collector = first.sampler, first.metadata
    for recording in recordings:
        for batch in recording.packets():
            check_batch(batch, table)
    calibrations = collector.calibrations()
    frames = [Candidate("left/os_sensor")]
    collector.extrinsics.resolve({"left": frames}, {}, {}, None)
    decode_samples(sampler, calibrations, random.Random(zlib.crc32(data)))


def _topic_of(parts: Sequence[Part]) -> tuple[Topic | None, list[bytes]]:
    words = parts[0].data.decode("utf-8", "replace").split("\t") if parts else []
    if len(words) != 4:
        return None, []
    text = next((part.data for part in parts if part.kind == _DEFINITION), b"")
    topic = Topic(words[3], words[0], words[1], text.decode("utf-8", "replace"), words[2])
    return topic, [part.data for part in parts if part.kind == _MESSAGE]


TARGETS: Sequence[Target] = (
    Target("messages packets", _packet_seeds, _read, _mutated, 14),
    Target("messages clouds", _cloud_seeds, _read, _mutated, 14),
    Target("messages others", _other_seeds, _read, _mutated, 12),
)
