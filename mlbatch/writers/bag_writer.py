"""A ROS 2 bag: metadata.yaml (docs/sources/outputs.md), and one MCAP file, or several.

Each of several has the scans of so many windows (`--max-bag-duration`), and can be read alone: it
begins with /tf_static and has `mlbatch.grid`. The report and scans.csv are of the whole run, and so
in the folder only; the only file of a bag has them inside. A file depends on no other: several runs
may make different ones. metadata.yaml has version 5 (Humble), which later players read as well.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Wire
from mlbatch.types import RunInfo, Scan, Summary, Topic
from mlbatch.writers.atomic import METADATA
from mlbatch.writers.base import ScanJob, WriterOptions, windows_per_file
from mlbatch.writers.mcap_container import McapContainer
from mlbatch.writers.message_writer import (
    TF_STATIC,
    TF_TYPE,
    ChunkJob,
    MessageWriter,
    PendingChunk,
    grid_of,
    stamp_ns,
    static_transforms,
)


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


_NAME = re.compile(r".*_(\d+)\.mcap", re.ASCII | re.DOTALL)


def number_of_file(name: str) -> int | None:
    """Return the number of a file of a bag; None for another name."""
    match = _NAME.fullmatch(name)
    return None if match is None else int(match[1])


def name_of_file(stem: str, number: int) -> str:
    """Return the name of a file of a bag; stem: name of the bag."""
    return f"{stem}_{number}.mcap"


def write_metadata(folder: Path, stem: str, numbers: Sequence[int]) -> None:
    """Describe the files of a bag in metadata.yaml."""
    text = metadata_text([read_file(folder / name_of_file(stem, number)) for number in numbers])
    (folder / METADATA).write_text(text, encoding="utf-8", newline="\n")


def check_topic(topic: Topic) -> None:
    """Refuse messages of ROS 1: a player of ROS 2 bags cannot read them."""
    if topic.encoding != "cdr":
        raise ExportError(
            f"{topic.name}: expected messages of ROS 2 (cdr) for a ROS 2 bag, found "
            f"{topic.encoding!r}; do not pass the topic, or write a .mcap, which takes both"
        )


class BagWriter(MessageWriter):
    """Writes a run as messages in one file or several; see `MessageWriter`."""

    def __init__(self, target: Path, info: RunInfo, options: WriterOptions) -> None:
        self._stem = target.name
        self._compression = options.compression
        self._files = options.files
        # In a file; 0: all are in one.
        self._windows = 0
        if options.max_bag_s:
            self._windows = windows_per_file(options.max_bag_s, Fraction(info.rate_hz))
        self._number = -1  # of the last file that was begun, here or by another run
        self._block = 0  # windows [block * windows, (block + 1) * windows)
        self._is_begun = False  # the block has a file
        self._container: McapContainer | None = None
        self._unfinished: list[McapContainer] = []
        self._pending: list[PendingChunk] = []
        super().__init__(target, info, options, folder=True)

    def start_window(self, index: int) -> None:
        """Continue with the file of a window. In order."""
        block = max(index, 0) // self._windows if self._windows else 0
        if block != self._block:
            self._end_file()
            self._block = block

    def take_chunks(self) -> Sequence[PendingChunk]:
        """Return the chunks completed since the last call, and the ends of files."""
        chunks = self._pending
        self._pending = []
        if self._container is not None:
            chunks += self._container.take_chunks()
        return chunks

    def file_at(self, log_ns: int) -> McapContainer | None:
        """Return the file of the window, which a message of this log time may begin."""
        if not self._is_begun:
            self._is_begun = True
            self._number += 1
            if self._files is None or self._files.is_due(self._block * self._windows):
                path = self._path(self._number)
                self._container = McapContainer(path, self._compression, check_topic)
                self._unfinished.append(self._container)
                # `MessageWriter` begins the first one.
                if self._number:
                    transforms = static_transforms(self._info, log_ns, Wire)
                    self._container.send(TF_STATIC, TF_TYPE, log_ns, transforms, latched=True)
        return self._container

    def complete(self, number: int, block: int, container: McapContainer) -> None:
        """Complete a file once its chunks are written."""
        # By this readers know that report and table are not in the file.
        pieces = {"windows_per_file": str(self._windows)}
        crc = container.finish_piece(grid_of(self._info, self._info.t_init_ns) | pieces)
        self._unfinished.remove(container)
        if self._files is not None:
            self._files.made({self._path(number).name: crc}, block * self._windows)

    def _finish_files(self, summary: Summary, grid: dict[str, str]) -> None:
        """Complete the last file, and describe all that are here in metadata.yaml."""
        if self._windows:
            self._end_file()
            for chunk in self.take_chunks():
                chunk.compress()
                chunk.write()
        elif self._container is not None:
            self._container.finish(summary, grid)
        paths = map(self._path, range(self._number + 1))
        numbers = [number for number, path in enumerate(paths) if path.exists()]
        if numbers:
            write_metadata(self._output.partial, self._stem, numbers)

    def _abandon_files(self) -> None:
        for container in self._unfinished:
            container.abandon()

    def _path(self, number: int) -> Path:
        return self._output.partial / name_of_file(self._stem, number)

    def _end_file(self) -> None:
        """End the file under construction: no message follows."""
        container = self._container
        if container is not None:
            container.end_chunk()
            self._pending = list(self.take_chunks())
            self._pending.append(_FileEnd(self, self._number, self._block, container))
        self._container = None
        self._is_begun = False


class BagPartsWriter(BagWriter):
    """Writes a run in several files, some of which may be those of other runs."""

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job of a scan in a file of another run: it has a place, and no message."""
        return _SkippedJob(self, scan)


class _FileEnd(NamedTuple):
    """Completes a file after its chunks; see `message_writer.PendingChunk`."""

    writer: BagWriter
    number: int
    block: int
    container: McapContainer

    def compress(self) -> None:
        """Do nothing."""

    def write(self) -> None:
        """Complete the file."""
        self.writer.complete(self.number, self.block, self.container)


class _SkippedJob(ChunkJob):
    """Gives a scan of another run its place, and writes what is complete before it."""

    def __init__(self, writer: MessageWriter, scan: Scan) -> None:
        super().__init__(writer)
        self._scan = scan

    def append(self) -> None:
        self._writer.place_scan(self._scan)
        # Another run sends its message, which begins the file.
        self._writer.file_at(stamp_ns(self._scan))
        super().append()
