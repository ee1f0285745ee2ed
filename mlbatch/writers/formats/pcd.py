"""A folder of binary PCD files, with the fields of the point layout `standard`.

Source: PCL, "The PCD (Point Cloud Data) file format", version 0.7, and docs/sources/outputs.md
section 6. Field names are those of PCL's point types; lines that begin with # are comments.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import DEFAULT_POINT_LAYOUT, ScanWriter, WriterOptions, fixed
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS
from mlbatch.writers.scan_folder import FolderWriter, RecordEncoder

FORMAT = "pcd"
SUFFIX: str | None = None
COMPRESSES = False

# Its fields follow each other without gaps, as PCD requires.
_LAYOUT = CLOUD_LAYOUTS[DEFAULT_POINT_LAYOUT]
extras = fixed(_LAYOUT.extras)
record_layout = fixed(_LAYOUT.record)


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of PCD files."""
    encoder = partial(RecordEncoder, _LAYOUT, _LAYOUT.pcd_head)
    return FolderWriter(target, info, options, FORMAT, encoder)
