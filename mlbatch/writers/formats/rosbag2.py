"""A ROS 2 bag: a folder with MCAP files and metadata.yaml (docs/sources/outputs.md).

There is one file, or with `--max-bag-duration` one for each so many windows (`bag_writer.py`).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import ExportError
from mlbatch.ros.encoding import Wire
from mlbatch.types import RunInfo, Topic
from mlbatch.writers.bag_metadata import METADATA, file_of_container, metadata_text
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.message_writer import MessageFile, MessageWriter, extras_of, record_of

if TYPE_CHECKING:
    from mlbatch.writers.mcap_container import McapContainer

FORMAT = "rosbag2"
SUFFIX: str | None = None
COMPRESSES = True
extras = partial(extras_of, ("cdr",))
record_layout = record_of


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start the folder of a ROS 2 bag."""
    if options.max_bag_s:
        from mlbatch.writers.bag_writer import BagWriter

        return BagWriter(target, info, options, check_topic)

    def open_file(folder: Path) -> MessageFile:
        # Imported here, so that naming the format does not load the library.
        from mlbatch.writers.mcap_container import McapContainer

        path = folder / f"{target.name}_0.mcap"

        def write_metadata(container: McapContainer) -> None:
            text = metadata_text([file_of_container(container, path.name)])
            (folder / METADATA).write_text(text, encoding="utf-8", newline="\n")

        return McapContainer(path, options.compression, check_topic, write_metadata)

    return MessageWriter(target, info, options, Wire, open_file, folder=True)


def check_topic(topic: Topic) -> None:
    """Refuse messages of ROS 1: a player of ROS 2 bags cannot read them."""
    if topic.encoding != "cdr":
        raise ExportError(
            f"{topic.name}: expected messages of ROS 2 (cdr) for a ROS 2 bag, found "
            f"{topic.encoding!r}; do not pass the topic, or write a .mcap, which takes both"
        )
