"""Table of the scans of a run: scans.csv, and statistics for the report."""

from __future__ import annotations

import csv
import io
import math
import tempfile
import weakref
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from operator import add
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, median
from mlbatch.errors import ExportError
from mlbatch.types import CLOUDS, RunInfo, Scan
from mlbatch.units import NS_PER_MS, NS_PER_S

# A number in every reader of CSV: a column of empty cells would be one of texts.
UNKNOWN = "NaN"
# In the column `checksum`: of a writer that gives none.
NO_CHECKSUM = -1
_CHECKSUMS = 1 << 32
# A scan with less of any sensor's columns is underfilled.
UNDERFILLED = 0.5
# scans.csv is kept in memory up to this size, then in a temporary file.
_SPOOL_BYTES = 2**20
# Rows are formatted together, in half of the time of one by one: what formats them, and scans of
# some MB, do not fit into the cache together.
_ROWS = 64


class Spread(NamedTuple):
    """Distribution of a time over scans, ms; None without a value."""

    p50: float | None = None
    p99: float | None = None
    max: float | None = None


class ScanStatistics(NamedTuple):
    """The scans of a run; span: last minus first column timestamp; period: between scan starts."""

    written: int
    empty: int
    incomplete: int
    dropped_incomplete: int
    # Scans with less than half of the columns of a sensor, or of its usual ones where its rate is
    # unknown. Neither the head nor the tail, which are partial, counts in this and the following.
    underfilled: int
    # By sensor: scans with less than half of its columns, without any, with columns but no points.
    underfilled_by_sensor: dict[str, int]
    without: dict[str, int]
    no_points: dict[str, int]
    # Written scans (with `--split` of any sensor) without a point.
    empty_clouds: int
    points: int
    span_ms: Spread
    period_ms: Spread


class ScanTable:
    """Rows of scans.csv, and statistics of the scans.

    Consecutive scans of one window or slice (`--split`) share a row.
    """

    def __init__(self, info: RunInfo, columns_per_s: Sequence[float | None] = ()) -> None:
        """columns_per_s: nominal rate of each sensor; None if unknown."""
        # `text` gives the content.
        self._file = tempfile.SpooledTemporaryFile(_SPOOL_BYTES)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._slices = info.slices
        # Of the last windows, not yet formatted; another scan may join the last of them.
        self._pending: list[_Row] = []
        self._last: tuple[int, int] | None = None
        self._spans_ns = array("q")
        self._periods_ns = array("d")
        self._written = 0
        self.first_start_ns: int | None = None  # of the first scan
        self._incomplete = 0
        self._points = 0
        self._empty_clouds = 0
        self._totals = [_SensorTotals(sensor.name, sensor.model) for sensor in info.sensors]
        # Of each scan that is not partial: whether a fill is too low.
        self._low = bytearray()
        names = [sensor.name for sensor in info.sensors]
        start = ["index", "slice", "start_ns", "end_ns", "first_stamp_ns", "last_stamp_ns"]
        counts = ["points", "columns", *(f"columns_{name}" for name in names), "complete"]
        gaps = (f"max_gap_ns_{name}" for name in names)
        words = ("coverage", "overlap", "missing", "fill")
        shares = (f"{word}_{name}" for word in words for name in names)
        header = io.StringIO()
        # Names may need quotes; the cells of rows are numbers.
        writer = csv.writer(header, lineterminator="\n")
        writer.writerow([*start, *counts, *gaps, *shares, "checksum", "ready_host_ns"])
        self._append(header.getvalue())
        self._columns_per_s = tuple(columns_per_s) or (None,) * len(names)

    def add(self, scan: Scan, checksum: int | None = None, is_listed: bool = True) -> None:
        """Add a scan; checksum: see `writers.ScanJob`.

        is_listed: False for a scan of another shard, whose points are unknown: it has no row.
        """
        row = _Row.of(scan, checksum, is_listed)
        if self.first_start_ns is None:
            self.first_start_ns = scan.start_ns
        self._empty_clouds += is_listed and not scan.points
        pending = self._pending
        if pending and pending[-1].key == row.key:
            pending[-1] = pending[-1].joined(row)
            return
        if len(pending) >= _ROWS:
            self._format()
        pending.append(row)

    @property
    def rows(self) -> int:
        """Number of windows or slices written; any thread may ask while another adds scans."""
        return self._written + len(self._pending)

    def text(self) -> str:
        """The whole table."""
        self._format()
        self._file.seek(0)
        text = self._file.read().decode()
        self._file.seek(0, io.SEEK_END)
        return text

    def statistics(self, empty: int, dropped_incomplete: int = 0) -> ScanStatistics:
        """Figures for the report.

        empty: windows without a column; dropped_incomplete: those left out by `--drop-incomplete`.
        Neither are written.
        """
        self._format()
        low: BoolArray = np.array(self._low, np.bool_)
        underfilled = {one.name: one.underfilled for one in self._totals}
        for one in self._totals:
            scans = one.unusual()
            underfilled[one.name] += len(scans)
            low[scans] = True
        return ScanStatistics(
            self._written,
            empty,
            self._incomplete,
            dropped_incomplete,
            int(np.count_nonzero(low)),
            _counted(underfilled),
            _counted({one.name: one.without for one in self._totals}),
            _counted({one.name: one.no_points for one in self._totals}),
            self._empty_clouds,
            self._points,
            _spread(np.frombuffer(self._spans_ns, dtype=np.int64) / NS_PER_MS),
            _spread(np.frombuffer(self._periods_ns, dtype=np.float64) / NS_PER_MS),
        )

    @property
    def fill(self) -> list[float | None]:
        """Mean fill of each sensor over the scans; None: unknown."""
        self._format()
        return [one.mean_fill for one in self._totals]

    def _format(self) -> None:
        """Append the pending rows to the table and to the statistics."""
        rows = self._pending
        self._append("".join(self._line(row) for row in rows if row.is_listed))
        for row in rows:
            self._incomplete += not row.complete
            self._points += row.points
            self._add_totals(row)
            if row.columns:
                self._spans_ns.append(row.last_stamp_ns - row.first_stamp_ns)
            # Divided by the number of slices, so that empty windows do not change the period.
            step = row.key[0] * self._slices + row.key[1]
            if self._last is not None and step > self._last[0]:
                self._periods_ns.append((row.start_ns - self._last[1]) / (step - self._last[0]))
            self._last = (step, row.start_ns)
        self._written += len(rows)
        rows.clear()

    def _line(self, row: _Row) -> str:
        length_ns = row.end_ns - row.start_ns
        shares = _share_cells(
            *(row.coverage, row.overlap, row.columns, self._columns_per_s, length_ns, row.fill)
        )
        stamps = f"{row.first_stamp_ns},{row.last_stamp_ns}" if any(row.columns) else ","
        places = f"{row.key[0]},{row.key[1]},{row.start_ns},{row.end_ns},{stamps},{row.points}"
        counts = _count_cells(row.columns, row.complete)
        gaps = ",".join(map(str, row.max_gap_ns))
        return f"{places},{counts},{gaps},{shares},{row.checksum},{row.ready_host_ns}\n"

    def _add_totals(self, row: _Row) -> None:
        if row.is_partial:
            return
        is_underfilled = False
        filled = zip(self._totals, row.columns, row.points_of, row.fill, strict=True)
        for one, columns, points, fill in filled:
            one.add(len(self._low), columns, points if row.is_listed else None, fill)
            is_underfilled |= fill < UNDERFILLED
        self._low.append(is_underfilled)

    def _append(self, text: str) -> None:
        try:
            self._file.write(text.encode())
        except OSError as err:
            raise ExportError(
                f"{tempfile.gettempdir()}: expected space for the rows of scans.csv, found "
                f"{err.strerror!r}; free space there or set TMPDIR"
            ) from err


@dataclass(slots=True)
class _SensorTotals:
    """Sums of one sensor over scans that are not partial."""

    name: str
    model: str
    underfilled: int = 0
    without: int = 0
    no_points: int = 0
    known: int = 0  # scans whose fill is known
    fill: float = 0.0  # sum over them
    # Numbers and columns of scans whose fill is unknown.
    _scans: array[int] = field(default_factory=partial(array, "q"))
    _columns: array[int] = field(default_factory=partial(array, "q"))

    def add(self, scan: int, columns: int, points: int | None, fill: float) -> None:
        """scan: its number; points: None if unknown."""
        self.without += not columns
        self.no_points += bool(columns) and points == 0
        self.underfilled += fill < UNDERFILLED
        if not math.isnan(fill):
            self.known += 1
            self.fill += fill
        elif columns:
            self._scans.append(scan)
            self._columns.append(columns)

    def unusual(self) -> I64Array:
        """Scans of unknown fill that have less than half of the usual columns: a lost sweep.

        Only of decoded clouds: other lidars measure less in some scans by their mode.
        """
        if self.model not in CLOUDS or not self._columns:
            return np.zeros(0, np.int64)
        columns = np.array(self._columns, np.int64)
        found: I64Array = np.array(self._scans, np.int64)[columns < UNDERFILLED * median(columns)]
        return found

    @property
    def mean_fill(self) -> float | None:
        return round(self.fill / self.known, 6) if self.known else None


class _Row(NamedTuple):
    """A row of scans.csv; timestamps are only valid if there are columns."""

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
    # By sensor; all scans of a window have the same fill.
    fill: tuple[float, ...]
    points_of: tuple[int, ...]
    is_partial: bool
    checksum: int
    is_listed: bool

    @classmethod
    def of(cls, scan: Scan, checksum: int | None, is_listed: bool) -> _Row:
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
            tuple(scan.fill.tolist()) or (math.nan,) * len(nothing),
            scan.points_per_sensor,
            scan.is_partial,
            NO_CHECKSUM if checksum is None else checksum,
            is_listed,
        )

    def joined(self, other: _Row) -> _Row:
        """This row and that of another sensor in the same window."""
        sums = (self.checksum, other.checksum)
        return self._replace(
            first_stamp_ns=min(self.first_stamp_ns, other.first_stamp_ns),
            last_stamp_ns=max(self.last_stamp_ns, other.last_stamp_ns),
            points=self.points + other.points,
            columns=tuple(map(add, self.columns, other.columns)),
            complete=self.complete and other.complete,
            max_gap_ns=tuple(map(max, self.max_gap_ns, other.max_gap_ns)),
            ready_host_ns=max(self.ready_host_ns, other.ready_host_ns),
            coverage=tuple(map(max, self.coverage, other.coverage)),
            overlap=tuple(map(max, self.overlap, other.overlap)),
            points_of=tuple(map(add, self.points_of, other.points_of)),
            # A sum, as readers may have the scans of a window in another order.
            checksum=NO_CHECKSUM if NO_CHECKSUM in sums else sum(sums) % _CHECKSUMS,
        )


# Few of these cells differ from row to row, and to format them costs more than to look them up.
@lru_cache(maxsize=1024)
def _count_cells(columns: tuple[int, ...], complete: bool) -> str:
    return ",".join(map(str, (sum(columns), *columns, str(complete).lower())))


@lru_cache(maxsize=1024)
def _share_cells(
    coverage: tuple[float, ...],
    overlap: tuple[float, ...],
    columns: tuple[int, ...],
    columns_per_s: tuple[float | None, ...],
    length_ns: int,
    fill: tuple[float, ...],
) -> str:
    """The cells after the gaps, of each sensor; columns_per_s: nominal, None: unknown."""
    seconds = length_ns / NS_PER_S
    missing = (
        UNKNOWN if rate is None else max(0, round(rate * seconds) - count)
        for rate, count in zip(columns_per_s, columns, strict=True)
    )
    shares = (f"{share:.3f}" for share in (*coverage, *overlap))
    # The shortest text of a float32.
    fills = (UNKNOWN if math.isnan(one) else np.float32(one) for one in fill)
    return ",".join(map(str, (*shares, *missing, *fills)))


def merged_table(tables: Sequence[str]) -> str:
    """Join the tables of shards, which share no row."""
    header = ""
    rows: list[tuple[int, int, str]] = []
    for table in tables:
        header, *lines = table.splitlines(keepends=True)
        for line in lines:
            index, slice_, _ = line.split(",", 2)
            rows.append((int(index), int(slice_), line))
    return header + "".join(line for *_, line in sorted(rows))


def _counted(counts: dict[str, int]) -> dict[str, int]:
    return {name: count for name, count in counts.items() if count}


def _spread(values_ms: F64Array) -> Spread:
    if not len(values_ms):
        return Spread()
    # Nearest rank: a measured value, the same on every machine.
    p50, p99 = np.quantile(values_ms, [0.5, 0.99], method="inverted_cdf").tolist()
    return Spread(p50, p99, float(values_ms.max()))
