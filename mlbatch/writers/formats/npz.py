"""A folder of npz files, one array per key (docs/formats.md); PKWARE APPNOTE 6.3, NEP 1."""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import EXTRAS, RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions, fixed
from mlbatch.writers.npz_encoder import NpzEncoder
from mlbatch.writers.scan_folder import FolderWriter

FORMAT = "npz"
SUFFIX: str | None = None
COMPRESSES = False
extras = fixed(EXTRAS)


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of npz files."""
    return FolderWriter(
        target, info, options, FORMAT, lambda: NpzEncoder(info, split=options.split)
    )
