"""A ROS 2 bag: a folder with MCAP files and metadata.yaml (docs/sources/outputs.md).

There is one file, or with `--max-bag-duration` one for each so many windows (`bag_writer.py`).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.message_writer import extras_of, record_of

FORMAT = "rosbag2"
SUFFIX: str | None = None
COMPRESSES = True
extras = partial(extras_of, ("cdr",))
record_layout = record_of


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start the folder of a ROS 2 bag."""
    # Imported here, so that naming the format does not load the library.
    from mlbatch.writers.bag_writer import BagPartsWriter, BagWriter

    writer = BagPartsWriter if options.max_bag_s else BagWriter
    return writer(target, info, options)
