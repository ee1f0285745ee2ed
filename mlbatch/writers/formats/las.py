"""A folder of LAS files.

Source: ASPRS, "LAS specification 1.4 R15" (point data record format 6, extra bytes), and
docs/sources/outputs.md section 6.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import RecordLayout, RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.las_encoder import LAS_EXTRAS, RECORD, LasEncoder
from mlbatch.writers.scan_folder import FolderWriter, check_dense

FORMAT = "las"
SUFFIX: str | None = None
COMPRESSES = False


def extras(options: WriterOptions) -> frozenset[str]:
    """Return what extra bytes store."""
    return LAS_EXTRAS


def record_layout(options: WriterOptions) -> RecordLayout | None:
    """Return the records of all points."""
    return RECORD


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of LAS files."""
    check_dense(FORMAT, info)
    return FolderWriter(target, info, options, FORMAT, LasEncoder)
