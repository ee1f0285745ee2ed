"""One MCAP file with PointCloud2, Imu and /tf_static of ROS 2 (docs/sources/outputs.md).

Recorded messages are forwarded unchanged, also those of ROS 1: MCAP can contain both.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.message_writer import MessageWriter, extras_of, record_of

FORMAT = "mcap"
SUFFIX: str | None = ".mcap"
COMPRESSES = True
extras = partial(extras_of, ("cdr", "ros1"))
record_layout = record_of


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start an MCAP file."""
    # Imported here, so that naming the format does not load the library.
    from mlbatch.writers.mcap_container import McapContainer

    new = partial(McapContainer, compression=options.compression)
    return MessageWriter(target, info, options, new)
