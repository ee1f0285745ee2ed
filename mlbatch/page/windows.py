"""The windows of a run, from scans.csv: columns present and expected, gaps, shares, delays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, median
from mlbatch.errors import ExportError
from mlbatch.outputs.table import Cells, TableError
from mlbatch.units import NS_PER_MS

# Values (windows x sensors) of a page; longer runs are summarised, several windows a value.
MOST_CELLS = 160_000
_LARGEST = 2**62
# Share of an estimated number of columns that is no loss, since rotors vary; and of a known one,
# if a single column lacks.
_NEARLY = 0.99
# No delay of a network.
_FAR_MS = 60_000.0


class Windows:
    """Rows of scans.csv, (n,) each; by sensor (n, s)."""

    def __init__(self, cells: Cells, slices: int) -> None:
        """slices: a window; TableError for another table."""

        def whole(name: str, empty: int | None = None) -> I64Array:
            """A column of integers that may be added."""
            values = cells.integers(name, empty)
            if (np.abs(values) > _LARGEST).any():
                raise TableError(name, f"numbers up to {_LARGEST}", "larger ones")
            return values

        def reals(name: str) -> F64Array:
            """A column of shares; NaN where the table has none."""
            return cells.reals(name) if name in cells.columns else np.full(len(cells), math.nan)

        self.sensors = cells.sensors
        self.slices = slices
        self.index = whole("index")
        self.slice = whole("slice")
        # Number on the grid of windows or slices.
        self.step: I64Array = self.index * slices + self.slice
        self.start_ns = whole("start_ns")
        self.end_ns = whole("end_ns")
        self.columns: I64Array = cells.by_sensor("columns_", whole).astype(np.int64)
        missing = cells.by_sensor("missing_", reals)
        # (s,): unknown, NaN, or empty in outputs of earlier versions.
        self.estimated: BoolArray = np.logical_not(np.all(np.isfinite(missing), axis=0))
        known = np.where(self.estimated, 0, missing).astype(np.int64)
        self.expected: I64Array = self.columns + known
        for i in np.flatnonzero(self.estimated).tolist():
            present = self.columns[self.columns[:, i] > 0, i]
            # The head and the tail are shorter; most windows are whole.
            self.expected[:, i] = 0 if not len(present) else int(median(present))
        # First to last column; empty in a scan without columns.
        span_ns = whole("last_stamp_ns", 0) - whole("first_stamp_ns", 0)
        self.span_ms: F64Array = span_ns / NS_PER_MS
        # Receive time of the packet that closed the window, minus its end; NaN if not recorded.
        has_times = "ready_host_ns" in cells.columns
        ready_ns = whole("ready_host_ns", 0) if has_times else 0 * self.end_ns
        delay_ms = (ready_ns - self.end_ns) / NS_PER_MS
        self.delay_ms: F64Array = np.where(ready_ns == 0, math.nan, delay_ms)
        self.points = whole("points")
        self.complete = cells.flags("complete")
        # Columns per expected column, 0 to 1.
        fill = cells.by_sensor("fill_", reals)
        self.fill = _fill(self.columns, self.expected, self.estimated, fill)
        # Longest time without a column, also of earlier windows.
        self.gap_ms: F64Array = cells.by_sensor("max_gap_ns_", whole) / NS_PER_MS
        # NaN where the table has none.
        self.coverage: F64Array = cells.by_sensor("coverage_", reals)

    def __len__(self) -> int:
        return len(self.index)

    def seconds(self, row: int) -> float:
        """Start of a window after the first one, s."""
        return int(self.start_ns[row] - self.start_ns[0]) / 1e9

    @property
    def has_head(self) -> bool:
        """Whether the first window is partial, by `--keep-partial`."""
        return int(self.index[0]) < 0

    @property
    def far_ms(self) -> float:
        """Smallest delay, if it is only the offset of a clock with another date; else 0."""
        known = self.delay_ms[np.isfinite(self.delay_ms)]
        least = float(known.min()) if len(known) else 0.0
        return least if abs(least) > _FAR_MS else 0.0

    def worst(self) -> int:
        """The window with the lowest fill of any sensor; without a gap, that with fewest points.

        Of several windows neither the head nor an incomplete last one, which are partial.
        """
        rows = np.arange(len(self))
        kept = rows[int(self.has_head) : len(self) - (not self.complete[-1])]
        if not len(kept):
            kept = rows
        lowest = self.fill[kept].min(axis=1, initial=1.0)
        ranked = lowest if lowest.min() < 1.0 else self.points[kept]
        return int(kept[int(ranked.argmin())])


def read_windows(text: str, slices: int) -> Windows | None:
    """Read scans.csv; None without a row. Raises ExportError."""
    if len(text.splitlines()) < 2:
        return None
    if slices > _LARGEST:
        raise ExportError(
            f"scans.csv: expected up to {_LARGEST} slices, found {slices}; convert again"
        )
    try:
        return Windows(Cells.of(text), max(1, slices))
    except TableError as err:
        raise ExportError(f"{err.at('scans.csv')}: {err}; convert again") from err


def _fill(columns: I64Array, expected: I64Array, estimated: BoolArray, known: F64Array) -> F64Array:
    """The fill in the table; where it has none, by the expected columns."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share: F64Array = columns / expected
    # Where the grid cuts between two columns, a whole window has one less.
    is_whole = (expected == 0) | ((columns > 0) & (expected - columns <= 1))
    is_whole |= estimated & (share >= _NEARLY)
    own = np.where(is_whole, 1.0, share)
    table = np.where(is_whole & (known >= _NEARLY), 1.0, known)
    return np.clip(np.where(np.isfinite(known), table, own), 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Summary:
    """Windows as the page stores them, (m,) and (m, s): groups of `group` windows.

    values: of `Windows`, by name: the worst, and sums of columns; count, incomplete: windows.
    """

    group: int
    count: I64Array
    incomplete: I64Array
    values: dict[str, F64Array]


def summarise(windows: Windows) -> Summary:
    """Join windows into groups so that a page has at most MOST_CELLS values of each kind."""
    rows = len(windows)
    group = max(1, -(-rows * max(1, len(windows.sensors)) // MOST_CELLS))
    at = np.arange(0, rows, group)
    count = np.diff(np.append(at, rows))

    values = {
        name: join.reduceat(getattr(windows, name), at, axis=0)
        for join, names in (
            (np.fmin, ("fill", "coverage")),
            (np.fmax, ("span_ms", "delay_ms", "gap_ms")),
            (np.add, ("points", "columns", "expected")),
        )
        for name in names
    }
    values |= {"step": windows.step[at], "points": values["points"] / count}
    incomplete = np.add.reduceat((~windows.complete).astype(np.int64), at)
    return Summary(group, count, incomplete, values)
