"""A ROS 2 bag: a folder with one MCAP file and metadata.yaml (facts/outputs.md, section 4).

metadata.yaml is that of version 5 (Humble), which later players read as well.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Cdr
from mlbatch.types import Message, RunInfo, Summary
from mlbatch.writers._atomic import prepare
from mlbatch.writers._bag_writer import BagWriter, Sink, extras_of, layout_of
from mlbatch.writers._chunk import Chunk
from mlbatch.writers._options import ScanWriter, WriterOptions

if TYPE_CHECKING:
    from mlbatch.writers._mcap_file import Container
    from mlbatch.writers._mcap_sink import McapSink

FORMAT = "rosbag2"
SUFFIX: str | None = None
COMPRESSES = True

METADATA = "metadata.yaml"


def extras(options: WriterOptions) -> frozenset[str]:
    """What the fields of the point layout are made of, IMU samples and messages."""
    return extras_of(options, "cdr")


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start the folder of a ROS 2 bag."""
    layout_of(options)
    output = prepare(target, options.overwrite, folder=True, keep=options.kept_bytes is not None)
    sink = partial(_sink, f"{target.name}_0.mcap", options.compression)
    return BagWriter(output, info, options, Cdr, sink)


def _sink(name: str, compression: str, folder: Path, kept_bytes: int | None) -> Sink:
    # The library comes in here, so that naming the format does not load it.
    from mlbatch.writers._mcap_sink import McapSink

    return _BagSink(folder, name, McapSink(folder / name, kept_bytes, compression))


class _BagSink:
    """The file in a bag's folder; a player refuses messages of ROS 1 in it."""

    def __init__(self, folder: Path, name: str, file: McapSink) -> None:
        self._folder = folder
        self._name = name
        self._file = file

    @property
    def ended(self) -> int:
        """Chunks that are complete."""
        return self._file.ended

    def safe(self) -> tuple[int, int]:
        """Chunks that are written, and the bytes up to their end."""
        return self._file.safe()

    def take(self) -> list[Chunk]:
        """The chunks that are complete since the last call."""
        return self._file.take()

    def seal(self, chunks: Sequence[Chunk]) -> None:
        """Make chunks ready to be written; by any thread."""
        self._file.seal(chunks)

    def put(self, chunks: Sequence[Chunk]) -> None:
        """Write sealed chunks, in the order in which they were taken."""
        self._file.put(chunks)

    def send(
        self, topic: str, kind: str, log_ns: int, message: bytes | memoryview, latched: bool = False
    ) -> None:
        """Append a message of type `kind`, package/Type; a topic is made at its first message."""
        self._file.send(topic, kind, log_ns, message, latched)

    def forward(self, message: Message) -> None:
        """Append a message as it was recorded."""
        topic = message.topic
        if topic.encoding != "cdr":
            raise ExportError(
                f"{topic.name}: wanted messages of ROS 2 (cdr) to pass on to a ROS 2 bag, got "
                f"{topic.encoding!r}; leave the topic out, or write a .mcap, which holds both"
            )
        self._file.forward(message)

    def finish(self, summary: Summary, grid: dict[str, str]) -> None:
        """Complete the file and describe it in metadata.yaml."""
        self._file.finish(summary, grid)
        text = _metadata(self._file.container, self._name)
        (self._folder / METADATA).write_text(text, encoding="utf-8", newline="\n")

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.abandon()


def _metadata(container: Container, name: str) -> str:
    """Text of metadata.yaml; strings of JSON are strings of YAML."""
    first_ns, last_ns = container.span_ns
    contents = container.contents()
    count = sum(sent for _, _, sent in contents)
    topics = "".join(
        f"    - topic_metadata:\n"
        f"        name: {json.dumps(channel.topic)}\n"
        f"        type: {json.dumps(schema)}\n"
        f"        serialization_format: {channel.message_encoding}\n"
        f"        offered_qos_profiles: {json.dumps(channel.metadata['offered_qos_profiles'])}\n"
        f"      message_count: {sent}\n"
        for channel, schema, sent in contents
    )
    return (
        "rosbag2_bagfile_information:\n"
        "  version: 5\n"
        "  storage_identifier: mcap\n"
        f"  duration:\n    nanoseconds: {last_ns - first_ns}\n"
        f"  starting_time:\n    nanoseconds_since_epoch: {first_ns}\n"
        f"  message_count: {count}\n"
        f"  topics_with_message_count:\n{topics}"
        '  compression_format: ""\n'
        '  compression_mode: ""\n'
        f"  relative_file_paths:\n    - {json.dumps(name)}\n"
        f"  files:\n    - path: {json.dumps(name)}\n"
        f"      starting_time:\n        nanoseconds_since_epoch: {first_ns}\n"
        f"      duration:\n        nanoseconds: {last_ns - first_ns}\n"
        f"      message_count: {count}\n"
    )
