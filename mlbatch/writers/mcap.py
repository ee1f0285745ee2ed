"""One MCAP file with PointCloud2, Imu and /tf_static of ROS 2 (facts/outputs.md, section 4).

Recorded messages are passed on as they are, also those of ROS 1: MCAP can hold both.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.ros.encoding import Cdr
from mlbatch.types import RunInfo
from mlbatch.writers._atomic import prepare
from mlbatch.writers._bag_writer import BagWriter, Sink, extras_of, layout_of
from mlbatch.writers._options import ScanWriter, WriterOptions

FORMAT = "mcap"
SUFFIX: str | None = ".mcap"
COMPRESSES = True


def extras(options: WriterOptions) -> frozenset[str]:
    """What the fields of the point layout are made of, IMU samples and messages."""
    return extras_of(options, "cdr", "ros1")


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start an MCAP file."""
    layout_of(options)
    output = prepare(target, options.overwrite, folder=False, keep=options.kept_bytes is not None)
    return BagWriter(output, info, options, Cdr, partial(_sink, options.compression))


def _sink(compression: str, path: Path, kept_bytes: int | None) -> Sink:
    # The library comes in here, so that naming the format does not load it.
    from mlbatch.writers._mcap_sink import McapSink

    return McapSink(path, kept_bytes, compression)
