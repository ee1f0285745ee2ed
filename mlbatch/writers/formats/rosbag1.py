"""A ROS 1 bag, written by `rosbags` (docs/sources/outputs.md).

Connections have the MD5 and full definition of their type, as `rosbag play` expects; /tf_static is
latched.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.ros.encoding import Ros1
from mlbatch.types import RecordLayout, RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.message_writer import MessageWriter, extras_of, record_of
from mlbatch.writers.rosbag1_container import Rosbag1Container

FORMAT = "rosbag1"
SUFFIX: str | None = ".bag"
COMPRESSES = False


def extras(options: WriterOptions) -> frozenset[str]:
    """Return the inputs of the point layout, IMU samples and messages."""
    return extras_of(options, "ros1")


def record_layout(options: WriterOptions) -> RecordLayout | None:
    """Return the records of the point layout."""
    return record_of(options)


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a ROS 1 bag."""
    return MessageWriter(target, info, options, Ros1, Rosbag1Container)
