"""The table of a run's scans: scans.csv and figures for the report (CONTRACT.md, section 3)."""

from __future__ import annotations

import csv
import io
import tempfile
from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import ExportError
from mlbatch.types import RunInfo, Scan
from mlbatch.units import NS_PER_MS, NS_PER_S

# scans.csv stays in memory up to this size, then goes to a temporary file.
_SPOOL_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of a time over scans, ms; None when there was nothing to measure."""

    p50: float | None = None
    p99: float | None = None
    max: float | None = None


@dataclass(frozen=True, slots=True)
class ScanStatistics:
    """The scans of a run; span: last minus first column stamp; period: between scan starts."""

    written: int
    empty: int
    incomplete: int
    dropped_incomplete: int
    points: int
    span_ms: Spread
    period_ms: Spread


class ScanTable:
    """Rows of scans.csv and what the report says of scans.

    Scans of one window or slice that are added one after the other (`--split`) share a row.
    """

    def __init__(self, info: RunInfo, columns_per_s: Sequence[float | None] = ()) -> None:
        """columns_per_s: what each sensor sends where nothing is lost; None where unknown."""
        # The table itself must not outlive this object: its text leaves by `text`.
        self._file = tempfile.SpooledTemporaryFile(_SPOOL_BYTES)  # noqa: SIM115
        self._slices = info.slices
        self._open: _Row | None = None
        self._last: tuple[int, int] | None = None
        self._spans_ns = array("q")
        self._periods_ns = array("d")
        self._written = self._incomplete = self._points = 0
        names = [sensor.name for sensor in info.sensors]
        start = ["index", "slice", "start_ns", "end_ns", "first_stamp_ns", "last_stamp_ns"]
        counts = ["points", "columns", *(f"columns_{name}" for name in names), "complete"]
        gaps = (f"max_gap_ns_{name}" for name in names)
        turns = (f"{word}_{name}" for word in ("coverage", "overlap", "missing") for name in names)
        self._append([*start, *counts, *gaps, *turns, "ready_host_ns"])
        self._columns_per_s = tuple(columns_per_s) or (None,) * len(names)

    def add(self, scan: Scan) -> None:
        """Add a scan that was written."""
        row = _Row.of(scan)
        if self._open is not None and self._open.key == row.key:
            self._open = self._open.joined(row)
            return
        self._close_row()
        self._open = row

    @property
    def rows(self) -> int:
        """Windows or slices that were written."""
        self._close_row()
        return self._written

    def text(self) -> str:
        """The whole table."""
        self._close_row()
        self._file.seek(0)
        text = self._file.read().decode()
        self._file.seek(0, io.SEEK_END)
        return text

    def statistics(self, empty: int, dropped_incomplete: int = 0) -> ScanStatistics:
        """Figures for the report.

        empty: windows without any column; dropped_incomplete: those left out by
        `--drop-incomplete`. Neither are written.
        """
        self._close_row()
        return ScanStatistics(
            self._written,
            empty,
            self._incomplete,
            dropped_incomplete,
            self._points,
            _spread(np.frombuffer(self._spans_ns, dtype=np.int64) / NS_PER_MS),
            _spread(np.frombuffer(self._periods_ns, dtype=np.float64) / NS_PER_MS),
        )

    def _close_row(self) -> None:
        row, self._open = self._open, None
        if row is None:
            return
        self._append([*row.cells(), *self._missing(row), row.ready_host_ns])
        self._written += 1
        self._incomplete += not row.complete
        self._points += row.points
        if row.columns:
            self._spans_ns.append(row.last_stamp_ns - row.first_stamp_ns)
        # Steps count slices: over a gap of empty windows the period stays what it was.
        step = row.key[0] * self._slices + row.key[1]
        if self._last is not None and step > self._last[0]:
            self._periods_ns.append((row.start_ns - self._last[1]) / (step - self._last[0]))
        self._last = (step, row.start_ns)

    def _missing(self, row: _Row) -> list[int | str]:
        """Columns that each sensor should have sent in a window and did not; "" where unknown."""
        seconds = (row.end_ns - row.start_ns) / NS_PER_S
        return [
            "" if rate is None else max(0, round(rate * seconds) - count)
            for rate, count in zip(self._columns_per_s, row.columns, strict=True)
        ]

    def _append(self, cells: Sequence[int | str]) -> None:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(cells)
        try:
            self._file.write(line.getvalue().encode())
        except OSError as err:
            raise ExportError(
                f"{tempfile.gettempdir()}: wanted room for the rows of scans.csv, got "
                f"{err.strerror!r}; free space there or set TMPDIR"
            ) from err


@dataclass(slots=True)
class _Row:
    """A row of scans.csv; stamps mean nothing without columns."""

    key: tuple[int, int]
    start_ns: int
    end_ns: int
    first_stamp_ns: int
    last_stamp_ns: int
    points: int
    columns: tuple[int, ...]
    complete: bool
    max_gap_ns: tuple[int, ...]
    ready_host_ns: int
    coverage: tuple[float, ...]
    overlap: tuple[float, ...]

    @classmethod
    def of(cls, scan: Scan) -> _Row:
        """The row of one scan."""
        stamps = scan.column_stamp_ns
        nothing = (0.0,) * len(scan.columns_per_sensor)
        return cls(
            (scan.index, scan.slice),
            scan.start_ns,
            scan.end_ns,
            int(stamps[0]) if len(stamps) else scan.end_ns,
            int(stamps[-1]) if len(stamps) else scan.start_ns,
            scan.points,
            scan.columns_per_sensor,
            scan.complete,
            scan.max_gap_ns,
            scan.ready_host_ns,
            scan.coverage or nothing,
            scan.overlap or nothing,
        )

    def joined(self, other: _Row) -> _Row:
        """This row with another sensor's part of the same window."""
        return _Row(
            self.key,
            self.start_ns,
            self.end_ns,
            min(self.first_stamp_ns, other.first_stamp_ns),
            max(self.last_stamp_ns, other.last_stamp_ns),
            self.points + other.points,
            tuple(a + b for a, b in zip(self.columns, other.columns, strict=True)),
            self.complete and other.complete,
            tuple(max(pair) for pair in zip(self.max_gap_ns, other.max_gap_ns, strict=True)),
            max(self.ready_host_ns, other.ready_host_ns),
            tuple(max(pair) for pair in zip(self.coverage, other.coverage, strict=True)),
            tuple(max(pair) for pair in zip(self.overlap, other.overlap, strict=True)),
        )

    def cells(self) -> list[int | str]:
        """Values in the order of the header, but what the table adds."""
        total = sum(self.columns)
        stamps = (self.first_stamp_ns, self.last_stamp_ns) if total else ("", "")
        start = (*self.key, self.start_ns, self.end_ns, *stamps)
        complete = str(self.complete).lower()
        counts = (self.points, total, *self.columns, complete)
        shares = (f"{share:.3f}" for share in (*self.coverage, *self.overlap))
        return [*start, *counts, *self.max_gap_ns, *shares]


def _spread(values_ms: F64Array) -> Spread:
    if not len(values_ms):
        return Spread()
    # Nearest rank: a value that occurred, the same on every machine.
    p50, p99 = np.quantile(values_ms, [0.5, 0.99], method="inverted_cdf").tolist()
    return Spread(p50, p99, float(values_ms.max()))
