"""A folder of .pcd.bin files as in the nuScenes data set, with times and lidars of the points.

Source: H. Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020, and
docs/sources/outputs.md section 6. Its readers expect five float32 per point and no more: x, y, z,
intensity, ring. Time and lidar of each point are in a second file, as nuScenes has labels of
points (lidarseg) in files of their own.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions, fixed
from mlbatch.writers.point_layouts import ROWS_NUSCENES, ROWS_TIME
from mlbatch.writers.scan_folder import (
    TIMES_TXT,
    FolderWriter,
    RecordEncoder,
    check_dense,
    times_text,
)

FORMAT = "nuscenes"
SUFFIX: str | None = None
COMPRESSES = False
FILE_SUFFIXES = ("pcd.bin", "time.bin")
extras = fixed(frozenset[str]())


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of .pcd.bin and .time.bin files."""
    check_dense(FORMAT, info)
    points, times = FILE_SUFFIXES
    encoder, others = partial(RecordEncoder, ROWS_NUSCENES), partial(RecordEncoder, ROWS_TIME)
    lists = {TIMES_TXT: times_text}
    return FolderWriter(
        target, info, options, FORMAT, encoder, suffix=points, others={times: others}, lists=lists
    )
