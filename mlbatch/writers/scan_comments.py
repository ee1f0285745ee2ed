"""Files of records: metadata of a scan as lines of text, for headers that have comments."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

import mlbatch
from mlbatch.errors import one_line
from mlbatch.types import Scan
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.point_layouts import Layout, ScanRecords, record_bytes

# Fields in the units of all formats with seconds after the start of the scan.
UNITS = "x y z m; time s after start_ns; intensity as sent by the sensor"


class RecordEncoder:
    """Encodes scans as the records of a layout."""

    def __init__(self, layout: Layout, head: Callable[..., bytes] | None = None) -> None:
        """head: of comments, width and, of organized scans, height; None: there is none."""
        self._records = ScanRecords(layout)
        self._head = head

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the header and all points; an organized scan has a row for each slot."""
        packed = self._records.of(scan)
        *height, width = packed.shape
        head = () if self._head is None else [self._head(scan_comments(scan), width, *height)]
        return [*head, record_bytes(packed)]


def scan_comments(scan: Scan, units: str = UNITS) -> list[str]:
    """Return the lines: a name and its value each; units: of the fields."""
    info = scan.info
    names = " ".join(sensor.name for sensor in info.sensors)
    return [
        f"mlbatch {mlbatch.__version__}",
        f"start_ns {scan.start_ns}",
        f"end_ns {scan.end_ns}",
        f"index {scan.index} slice {scan.slice} of {scan.slices}",
        f"complete {str(scan.complete).lower()}",
        f"fill {' '.join(map(_share, scan.fill.tolist()))}",
        f"sort {info.sort}",
        *(f"{name} {value}" for name, value in info.variants),
        f"timescale {info.timescale}",
        f"rate_hz {info.rate_hz}",
        # Frame names come from recordings and may contain line ends.
        f"frame_id {one_line(info.frame_id)}",
        f"units: {units}",
        f"lidar_id from 0: {names}",
    ]


def _share(fill: float) -> str:
    """Return a fill as text, as in scans.csv."""
    return "unknown" if math.isnan(fill) else str(np.float32(fill))
