"""Files of messages rewritten by `mcap` and `rosbags`, with changes: indexes and checksums fit."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rosbags.rosbag1 as bags
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from mlbatch.outputs.cloud_messages import PRESETS
from tests.builders.rosbag1 import definition_of
from tests.builders.verify_outputs import Edit

Records = npt.NDArray[Any]


@dataclass(frozen=True)
class Sent:
    """A message; number: among those of its topic."""

    topic: str
    number: int
    log_ns: int
    publish_ns: int
    data: bytes
    kind: str = ""


# The messages that replace one: none, itself, or several.
Change = Callable[[Sent], list[Sent]]
Notes = Callable[[dict[str, Any], dict[str, Any]], object]


def mcap(
    change: Change = lambda sent: [sent],
    notes: Notes = lambda metadata, files: None,
    profile: str = "ros2",
) -> Edit:
    """Rewrite an MCAP file, or that of a ROS 2 bag, with the reference library.

    notes: changes metadata records and attachments.
    """

    def edit(path: Path) -> None:
        (file,) = [*path.glob("*.mcap")] if path.is_dir() else [path]
        with file.open("rb") as stream:
            reader = make_reader(stream)
            found = list(reader.iter_messages(log_time_order=False))
            metadata = {one.name: one.metadata for one in reader.iter_metadata()}
            files = {one.name: one.data for one in reader.iter_attachments()}
        notes(metadata, files)
        with file.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.NONE)
            writer.start(profile, "mlbatch 0.1.0")
            _write(writer, found, change)
            for name, data in metadata.items():
                writer.add_metadata(name, data)
            for name, content in files.items():
                writer.add_attachment(0, 0, name, "text/csv", content)
            finish: Callable[[], None] = writer.finish
            finish()

    return edit


def _write(writer: Writer, found: list[Any], change: Change) -> None:
    channels: dict[tuple[str, str], int] = {}
    counts: dict[str, int] = {}
    sent: dict[int, int] = {}
    for schema, channel, message in found:
        number = counts[channel.topic] = counts.get(channel.topic, -1) + 1
        one = Sent(
            channel.topic, number, message.log_time, message.publish_time, message.data, schema.name
        )
        for new in change(one):
            key = (new.topic, new.kind)
            if key not in channels:
                kind = writer.register_schema(new.kind, schema.encoding, schema.data)
                channels[key] = writer.register_channel(
                    new.topic, channel.message_encoding, kind, channel.metadata
                )
            identity = channels[key]
            sequence = sent[identity] = sent.get(identity, -1) + 1
            writer.add_message(identity, new.log_ns, new.data, new.publish_ns, sequence)


def bag(change: Change) -> Edit:
    """Rewrite a ROS 1 bag with rosbags."""

    def edit(path: Path) -> None:
        with bags.Reader(path) as reader:
            found = [(c, log_ns, bytes(data)) for c, log_ns, data in reader.messages()]
        path.unlink()
        counts: dict[str, int] = {}
        with bags.Writer(path) as writer:
            connections = {}
            for old, log_ns, data in found:
                if old.topic not in connections:
                    connections[old.topic] = writer.add_connection(
                        old.topic, old.msgtype, msgdef=definition_of(old), md5sum=old.digest
                    )
                number = counts[old.topic] = counts.get(old.topic, -1) + 1
                for new in change(Sent(old.topic, number, log_ns, log_ns, data)):
                    writer.write(connections[old.topic], new.log_ns, new.data)

    return edit


def only(topic: str, number: int, change: Change) -> Change:
    """Change one message, leave the others."""

    def chosen(sent: Sent) -> list[Sent]:
        return change(sent) if (sent.topic, sent.number) == (topic, number) else [sent]

    return chosen


def points(layout: str, change: Callable[[Records], None]) -> Change:
    """Change the points of a PointCloud2; they end one byte before the end."""
    preset = PRESETS[layout]

    def changed(sent: Sent) -> list[Sent]:
        data = bytearray(sent.data)
        # After their length.
        begin = next(
            begin
            for begin in range(len(data) % 4, 2048)
            if struct.unpack_from("<I", data, begin)[0] == len(data) - begin - 5
        )
        records = np.frombuffer(
            data, preset.dtype, (len(data) - begin - 5) // preset.step, begin + 4
        )
        change(records)
        return [replace(sent, data=bytes(data))]

    return changed
