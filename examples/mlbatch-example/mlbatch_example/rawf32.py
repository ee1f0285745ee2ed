"""A folder of binary files: little-endian float32 x, y, z (m, body frame), intensity per point.

Source: own format, docs/formats.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mlbatch.types import RunInfo, Scan
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.scan_folder import FolderWriter

FORMAT = "rawf32"
SUFFIX: str | None = None
COMPRESSES = False


def extras(options: WriterOptions) -> frozenset[str]:
    """Return none: x, y, z and intensity are always decoded."""
    return frozenset()


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of binary files."""
    return FolderWriter(target, info, options, FORMAT, RawEncoder)


class RawEncoder:
    """Encodes scans as rows of float32."""

    def encode(self, scan: Scan) -> list[bytes]:
        """Return one row a point; empty slots of organized scans are left out."""
        rows = np.column_stack([scan.xyz.reshape(-1, 3), scan.intensity.reshape(-1)])
        rows = rows[np.isfinite(rows[:, 0])]
        return [rows.astype("<f4").tobytes()]
