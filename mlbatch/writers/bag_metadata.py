"""metadata.yaml of a ROS 2 bag (docs/sources/outputs.md): its files, topics and times.

It has version 5 (Humble), which later players read as well.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from mlbatch.errors import ExportError

METADATA = "metadata.yaml"


class BagTopic(NamedTuple):
    """A topic of a file, with the number of its messages there."""

    name: str
    type: str
    encoding: str
    qos: str
    messages: int


class BagFile(NamedTuple):
    """The entry of one MCAP file in metadata.yaml; times: of the first and the last message."""

    name: str
    first_ns: int
    last_ns: int
    topics: tuple[BagTopic, ...]

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(topic.messages for topic in self.topics)


def read_file(path: Path) -> BagFile:
    """Describe a complete file by its summary; ExportError where it cannot be read."""
    try:
        return _file_of_summary(path)
    except (ExportError, OSError):
        raise
    # Damaged bytes raise errors of many types in the library, and others in its versions.
    except Exception as err:
        raise _incomplete(path, str(err) or type(err).__name__) from err


def _file_of_summary(path: Path) -> BagFile:
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        raise _incomplete(path, "one without a summary")
    statistics = summary.statistics
    topics = (
        BagTopic(
            channel.topic,
            summary.schemas[channel.schema_id].name,
            channel.message_encoding,
            channel.metadata["offered_qos_profiles"],
            statistics.channel_message_counts.get(number, 0),
        )
        for number, channel in summary.channels.items()
    )
    first_ns, last_ns = statistics.message_start_time, statistics.message_end_time
    return BagFile(path.name, first_ns, last_ns, tuple(topics))


def _incomplete(path: Path, found: str) -> ExportError:
    return ExportError(
        f"{path}: expected a complete MCAP file, found {found}; convert again with --overwrite"
    )


def metadata_text(files: Sequence[BagFile]) -> str:
    """Return the text of metadata.yaml."""
    names = "".join(f"    - {_quoted(file.name)}\n" for file in files)
    topics = "".join(
        f"    - topic_metadata:\n"
        f"        name: {_quoted(topic.name)}\n"
        f"        type: {_quoted(topic.type)}\n"
        f"        serialization_format: {topic.encoding}\n"
        f"        offered_qos_profiles: {_quoted(topic.qos)}\n"
        f"      message_count: {topic.messages}\n"
        for topic in _all_topics(files)
    )
    first_ns = min(file.first_ns for file in files)
    last_ns = max(file.last_ns for file in files)
    return (
        "rosbag2_bagfile_information:\n"
        "  version: 5\n"
        "  storage_identifier: mcap\n"
        f"  duration:\n    nanoseconds: {last_ns - first_ns}\n"
        f"  starting_time:\n    nanoseconds_since_epoch: {first_ns}\n"
        f"  message_count: {sum(file.messages for file in files)}\n"
        f"  topics_with_message_count:\n{topics}"
        '  compression_format: ""\n'
        '  compression_mode: ""\n'
        f"  relative_file_paths:\n{names}"
        f"  files:\n{''.join(map(_text_of_file, files))}"
    )


def _quoted(text: str) -> str:
    """Return a YAML string: as in JSON, but pairs of escapes, which YAML does not join, are one."""
    parts = (f"\\U{ord(one):08x}" if one > "\uffff" else json.dumps(one)[1:-1] for one in text)
    return f'"{"".join(parts)}"'


def _all_topics(files: Iterable[BagFile]) -> Iterable[BagTopic]:
    """Return each topic once, with its messages in all files, as they appear first."""
    by_name: dict[str, BagTopic] = {}
    for topic in (topic for file in files for topic in file.topics):
        before = by_name.get(topic.name)
        count = topic.messages + (0 if before is None else before.messages)
        by_name[topic.name] = (before or topic)._replace(messages=count)
    return by_name.values()


def _text_of_file(file: BagFile) -> str:
    return (
        f"    - path: {_quoted(file.name)}\n"
        f"      starting_time:\n        nanoseconds_since_epoch: {file.first_ns}\n"
        f"      duration:\n        nanoseconds: {file.last_ns - file.first_ns}\n"
        f"      message_count: {file.messages}\n"
    )
