"""A folder of binary PLY files with the properties of `point_layouts.PLY_LAYOUTS`.

Source: G. Turk, "The PLY Polygon File Format", 1994, and docs/sources/outputs.md; one element
`vertex`, scalars only.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import RecordLayout, RunInfo, Scan
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.point_layouts import PLY_LAYOUTS, Layout, ScanRecords, record_bytes
from mlbatch.writers.scan_comments import scan_comments
from mlbatch.writers.scan_folder import FolderWriter, check_dense

FORMAT = "ply"
SUFFIX: str | None = None
COMPRESSES = False


def extras(options: WriterOptions) -> frozenset[str]:
    """Return nothing: the properties are fixed."""
    return frozenset()


def record_layout(options: WriterOptions) -> RecordLayout | None:
    """Return the vertices."""
    return PLY_LAYOUTS[options.ply_style].record


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of PLY files."""
    check_dense(FORMAT, info)
    layout = PLY_LAYOUTS[options.ply_style]
    return FolderWriter(target, info, options, FORMAT, lambda: PlyEncoder(layout))


class PlyEncoder:
    """Encodes scans as a header and vertices."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._vertices = ScanRecords(layout)

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the header and all points as vertices."""
        packed = self._vertices.of(scan)
        head = self._layout.ply_head(scan_comments(scan), packed.shape[0])
        return [head, record_bytes(packed)]
