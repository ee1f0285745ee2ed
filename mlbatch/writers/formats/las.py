"""A folder of LAS files; needs the extra `las`.

Source: ASPRS, "LAS specification 1.4 R15" (point data record format 6, extra bytes), and
docs/sources/outputs.md section 6.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.las_encoder import LAS_EXTRAS, LasEncoder, load_laspy
from mlbatch.writers.scan_folder import FolderWriter, check_dense

FORMAT = "las"
SUFFIX: str | None = None
COMPRESSES = False
IS_SLOW = True


def extras(options: WriterOptions) -> frozenset[str]:
    """Return what extra bytes store."""
    return LAS_EXTRAS


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of LAS files."""
    check_dense(FORMAT, info)
    laspy = load_laspy(FORMAT)
    return FolderWriter(target, info, options, FORMAT, lambda: LasEncoder(laspy, compresses=False))
