"""A folder of binary PCD files, with the fields of the point layout `standard`.

Source: PCL, "The PCD (Point Cloud Data) file format", version 0.7, and docs/sources/outputs.md
section 6. Field names are those of PCL's point types; lines that begin with # are comments.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import RecordLayout, RunInfo, Scan
from mlbatch.writers.base import DEFAULT_POINT_LAYOUT, ScanWriter, WriterOptions
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, ScanRecords, record_bytes
from mlbatch.writers.scan_comments import scan_comments
from mlbatch.writers.scan_folder import FolderWriter

FORMAT = "pcd"
SUFFIX: str | None = None
COMPRESSES = False

# Its fields follow each other without gaps, as PCD requires.
_LAYOUT = CLOUD_LAYOUTS[DEFAULT_POINT_LAYOUT]


def extras(options: WriterOptions) -> frozenset[str]:
    """Return nothing: the fields are fixed."""
    return _LAYOUT.extras


def record_layout(options: WriterOptions) -> RecordLayout | None:
    """Return the records of all points."""
    return _LAYOUT.record


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of PCD files."""
    return FolderWriter(target, info, options, FORMAT, PcdEncoder)


class PcdEncoder:
    """Encodes scans as a header and records."""

    def __init__(self) -> None:
        self._records = ScanRecords(_LAYOUT)

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the header and all points; an organized scan has a row for each slot."""
        packed = self._records.of(scan)
        *height, width = packed.shape
        head = _LAYOUT.pcd_head(scan_comments(scan), width, *height)
        return [head, record_bytes(packed)]
