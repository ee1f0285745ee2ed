"""A folder of LAZ files: LAS, compressed by lazrs; needs the extra `las`.

Source: as of `las_encoder.py`, docs/sources/outputs.md section 6.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.las_encoder import extras, load_lazrs, open_folder, record_layout

__all__ = ["COMPRESSES", "FORMAT", "SUFFIX", "extras", "open_writer", "record_layout"]

FORMAT = "laz"
SUFFIX: str | None = None
COMPRESSES = False


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of LAZ files."""
    return open_folder(FORMAT, target, info, options, load_lazrs())
