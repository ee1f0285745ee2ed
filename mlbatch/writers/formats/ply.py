"""A folder of binary PLY files with the properties of `point_layouts.PLY_LAYOUT`.

Source: G. Turk, "The PLY Polygon File Format", 1994, and docs/sources/outputs.md; one element
`vertex`, scalars only.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

import mlbatch
from mlbatch.errors import UsageError, one_line
from mlbatch.types import RunInfo, Scan
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.point_layouts import PLY_LAYOUT, points_of
from mlbatch.writers.scan_folder import FolderWriter

FORMAT = "ply"
SUFFIX: str | None = None
COMPRESSES = False

# Names of PLY types as of 1994, which all readers know.
_TYPES = {"<f4": "float", "<f8": "double", "<i4": "int", "u1": "uchar"}


def extras(options: WriterOptions) -> frozenset[str]:
    """Return nothing: the properties are fixed."""
    return frozenset()


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of PLY files."""
    if info.layout == "organized":
        raise UsageError(
            "--layout organized: expected dense for ply, found organized; write npz or mcap"
        )
    return FolderWriter(target, info, options, FORMAT, PlyEncoder)


class PlyEncoder:
    """Encodes scans in a buffer of vertices that is reused."""

    def __init__(self) -> None:
        self._vertices = np.zeros(0, dtype=PLY_LAYOUT.dtype)

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the header and all points as vertices."""
        count = len(scan.time_ns)
        if len(self._vertices) < count:
            self._vertices = np.zeros(count * 5 // 4, dtype=PLY_LAYOUT.dtype)
        vertices = self._vertices[:count]
        PLY_LAYOUT.pack(points_of(scan), vertices)
        return [header(scan, count).encode(), vertices.view(np.uint8).data]


def header(scan: Scan, count: int) -> str:
    """Return the header of a PLY file of `count` vertices."""
    info = scan.info
    names = " ".join(sensor.name for sensor in info.sensors)
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment mlbatch {mlbatch.__version__}",
        f"comment start_ns {scan.start_ns}",
        f"comment end_ns {scan.end_ns}",
        f"comment index {scan.index} slice {scan.slice} of {scan.slices}",
        f"comment complete {str(scan.complete).lower()}",
        f"comment fill {' '.join(map(_share, scan.fill.tolist()))}",
        f"comment sort {info.sort}",
        f"comment timescale {info.timescale}",
        f"comment rate_hz {info.rate_hz}",
        # Frame names come from recordings and may contain line ends.
        f"comment frame_id {one_line(info.frame_id)}",
        "comment units: x y z m; time s after start_ns; intensity as sent by the sensor",
        f"comment lidar_id from 0: {names}",
        f"element vertex {count}",
        *(f"property {_TYPES[field.dtype]} {field.name}" for field in PLY_LAYOUT.fields),
        "end_header",
    ]
    return "\n".join(lines) + "\n"


def _share(fill: float) -> str:
    """Return a fill as text, as in scans.csv."""
    return "unknown" if math.isnan(fill) else str(np.float32(fill))
