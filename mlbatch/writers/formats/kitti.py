"""A folder of .bin files as in the KITTI odometry data set, with the times of the scans.

Source: A. Geiger et al., "Vision meets robotics: the KITTI dataset", IJRR 2013 (rows of float32
x, y, z, reflectance), and docs/sources/outputs.md section 6.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions, fixed
from mlbatch.writers.point_layouts import ROWS_KITTI
from mlbatch.writers.scan_folder import (
    TIMES_TXT,
    FolderWriter,
    RecordEncoder,
    check_dense,
    times_text,
)

FORMAT = "kitti"
SUFFIX: str | None = None
COMPRESSES = False
FILE_SUFFIXES = ("bin",)
extras = fixed(frozenset[str]())
record_layout = fixed(ROWS_KITTI.record)


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of .bin files."""
    check_dense(FORMAT, info)
    (suffix,) = FILE_SUFFIXES
    encoder, lists = partial(RecordEncoder, ROWS_KITTI), {TIMES_TXT: times_text}
    return FolderWriter(target, info, options, FORMAT, encoder, suffix=suffix, lists=lists)
