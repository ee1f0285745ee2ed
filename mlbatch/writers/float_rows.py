"""Files of float32 rows without a header, and the list of their times."""

from __future__ import annotations

from collections.abc import Sequence

from mlbatch.types import Scan
from mlbatch.units import NS_PER_S
from mlbatch.writers.output_file import Bytes
from mlbatch.writers.point_layouts import Layout, ScanRecords, record_bytes
from mlbatch.writers.scan_folder import Entry

TIMES_TXT = "times.txt"


class RowEncoder:
    """Encodes scans as one row of float32 per point."""

    def __init__(self, layout: Layout) -> None:
        self._rows = ScanRecords(layout)

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the rows of all points."""
        return [record_bytes(self._rows.of(scan))]


def times_text(entries: Sequence[Entry]) -> str:
    """Return one line per scan: its start in seconds of the common clock, with 9 decimals."""
    return "".join(
        f"{entry.start_ns // NS_PER_S}.{entry.start_ns % NS_PER_S:09d}\n" for entry in entries
    )
