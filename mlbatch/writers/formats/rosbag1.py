"""A ROS 1 bag, written by `rosbags` (docs/sources/outputs.md).

Connections have the MD5 and full definition of their type, as `rosbag play` expects; /tf_static is
latched.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.ros.encoding import Wire
from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.message_writer import MessageWriter, extras_of, record_of
from mlbatch.writers.rosbag1_container import Rosbag1Container

FORMAT = "rosbag1"
SUFFIX: str | None = ".bag"
COMPRESSES = False
extras = partial(extras_of, ("ros1",))
record_layout = record_of


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a ROS 1 bag."""
    return MessageWriter(target, info, options, Rosbag1Container, partial(Wire, "ros1"))
