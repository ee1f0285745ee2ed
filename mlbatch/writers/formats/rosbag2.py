"""A ROS 2 bag: a folder with one MCAP file and metadata.yaml (docs/sources/outputs.md).

metadata.yaml has version 5 (Humble), which later players read as well.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Cdr
from mlbatch.types import RecordLayout, RunInfo, Topic
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.message_writer import MessageFile, MessageWriter, extras_of, record_of

if TYPE_CHECKING:
    from mlbatch.writers.mcap_container import McapContainer

FORMAT = "rosbag2"
SUFFIX: str | None = None
COMPRESSES = True

METADATA = "metadata.yaml"


def extras(options: WriterOptions) -> frozenset[str]:
    """Return the inputs of the point layout, IMU samples and messages."""
    return extras_of(options, "cdr")


def record_layout(options: WriterOptions) -> RecordLayout | None:
    """Return the records of the point layout."""
    return record_of(options)


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start the folder of a ROS 2 bag."""

    def open_file(folder: Path, kept_bytes: int | None) -> MessageFile:
        # Imported here, so that naming the format does not load the library.
        from mlbatch.writers.mcap_container import McapContainer

        path = folder / f"{target.name}_0.mcap"

        def write_metadata(container: McapContainer) -> None:
            text = _metadata(container, path.name)
            (folder / METADATA).write_text(text, encoding="utf-8", newline="\n")

        return McapContainer(path, kept_bytes, options.compression, _check_topic, write_metadata)

    return MessageWriter(target, info, options, Cdr, open_file, folder=True)


def _check_topic(topic: Topic) -> None:
    """Refuse messages of ROS 1: a player of ROS 2 bags cannot read them."""
    if topic.encoding != "cdr":
        raise ExportError(
            f"{topic.name}: expected messages of ROS 2 (cdr) for a ROS 2 bag, found "
            f"{topic.encoding!r}; do not pass the topic, or write a .mcap, which takes both"
        )


def _metadata(container: McapContainer, name: str) -> str:
    """Return the text of metadata.yaml; JSON strings are valid YAML strings."""
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
