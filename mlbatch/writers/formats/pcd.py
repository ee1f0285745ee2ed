"""A folder of binary PCD files, with the fields of the point layout `standard`.

Source: PCL, "The PCD (Point Cloud Data) file format", version 0.7, and docs/sources/outputs.md
section 6. Field names are those of PCL's point types; lines that begin with # are comments.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
_KINDS = {"f": "F", "u": "U"}


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
        shape = packed.shape
        return [_header(scan, shape[-1], _height(shape)).encode(), record_bytes(packed)]


def _height(shape: tuple[int, ...]) -> int:
    return shape[0] if len(shape) == 2 else 1


def _header(scan: Scan, width: int, height: int) -> str:
    """Return the header of a PCD file."""
    types = [np.dtype(field.dtype) for field in _LAYOUT.fields]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {line}" for line in scan_comments(scan)),
        "VERSION 0.7",
        f"FIELDS {' '.join(field.name for field in _LAYOUT.fields)}",
        f"SIZE {' '.join(str(one.itemsize) for one in types)}",
        f"TYPE {' '.join(_KINDS[one.kind] for one in types)}",
        f"COUNT {' '.join('1' for _ in types)}",
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {width * height}",
        "DATA binary",
    ]
    return "\n".join(lines) + "\n"
