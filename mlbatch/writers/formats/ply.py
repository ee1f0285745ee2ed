"""A folder of binary PLY files with the properties of `point_layouts.PLY_LAYOUTS`.

Source: G. Turk, "The PLY Polygon File Format", 1994, and docs/sources/outputs.md; one element
`vertex`, scalars only.
"""

from __future__ import annotations

from pathlib import Path

from mlbatch.types import RecordLayout, RunInfo
from mlbatch.writers.base import ScanWriter, WriterOptions, fixed
from mlbatch.writers.point_layouts import PLY_LAYOUTS
from mlbatch.writers.scan_folder import FolderWriter, RecordEncoder, check_dense

FORMAT = "ply"
SUFFIX: str | None = None
COMPRESSES = False
extras = fixed(frozenset[str]())


def record_layout(options: WriterOptions) -> RecordLayout | None:
    """Return the vertices."""
    return PLY_LAYOUTS[options.ply_style].record


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of PLY files."""
    check_dense(FORMAT, info)
    layout = PLY_LAYOUTS[options.ply_style]
    return FolderWriter(
        target, info, options, FORMAT, lambda: RecordEncoder(layout, layout.ply_head)
    )
