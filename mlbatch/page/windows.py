"""The windows of a run, from scans.csv: columns present and expected, gaps, shares, delays."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, median
from mlbatch.errors import ExportError
from mlbatch.units import NS_PER_MS

# Values (windows x sensors) of a page; longer runs are summarised, several windows a value.
MOST_CELLS = 160_000
_LARGEST = 2**62
# Share of an estimated number of columns that is no loss: rotors vary.
_NEARLY = 0.99
# No delay of a network.
_FAR_MS = 60_000.0


@dataclass(frozen=True, slots=True)
class Windows:
    """Rows of scans.csv, (n,) each; by sensor (n, s)."""

    sensors: tuple[str, ...]
    slices: int  # a window
    index: I64Array
    slice: I64Array
    # Number on the grid of windows or slices.
    step: I64Array
    start_ns: I64Array
    end_ns: I64Array
    points: I64Array
    complete: BoolArray
    # First to last column.
    span_ms: F64Array
    # Receive time of the packet that closed the window, minus its end; NaN if not recorded.
    delay_ms: F64Array
    columns: I64Array
    expected: I64Array
    # (s,): `expected` is not in the table, and is the median of the windows with columns.
    estimated: BoolArray
    # Columns per expected column, 0 to 1.
    fill: F64Array
    # Longest time without a column, also of earlier windows.
    gap_ms: F64Array
    # NaN where the table has none.
    coverage: F64Array
    overlap: F64Array

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
    """Parse scans.csv; None without a row. Raises ExportError."""
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as err:
        raise ExportError(f"scans.csv: expected a table, found {err}; convert again") from err
    if len(lines) < 2:
        return None
    head = lines[0]
    if any(len(line) != len(head) for line in lines):
        raise ExportError(
            f"scans.csv: expected {len(head)} cells in every line, found others; convert again"
        )
    cells = dict(zip(head, zip(*lines[1:], strict=True), strict=True))
    names = tuple(name.removeprefix("columns_") for name in head if name.startswith("columns_"))
    try:
        return _windows(cells, names, max(1, slices))
    except (KeyError, ValueError, OverflowError) as err:
        raise ExportError(
            f"scans.csv: expected the columns of docs/formats.md, found {type(err).__name__}: "
            f"{err}; convert again"
        ) from err


def _windows(cells: dict[str, tuple[str, ...]], names: tuple[str, ...], slices: int) -> Windows:
    rows = len(cells["index"])
    index = _whole(cells["index"])
    part = _whole(cells["slice"])
    start_ns = _whole(cells["start_ns"])
    end_ns = _whole(cells["end_ns"])
    columns = np.zeros((rows, len(names)), dtype=np.int64)
    gap_ms = np.zeros((rows, len(names)))
    expected = np.zeros((rows, len(names)), dtype=np.int64)
    estimated = np.zeros(len(names), dtype=bool)
    for i, name in enumerate(names):
        columns[:, i] = _whole(cells[f"columns_{name}"])
        gap_ms[:, i] = _numbers(cells[f"max_gap_ns_{name}"]) / NS_PER_MS
        missing = cells.get(f"missing_{name}", ("",) * rows)
        # Unknown: NaN, or empty in outputs of earlier versions.
        if all(cell not in ("", "NaN") for cell in missing):
            expected[:, i] = columns[:, i] + _whole(missing)
        else:
            present = columns[columns[:, i] > 0, i]
            # The head and the tail are shorter; most windows are whole.
            expected[:, i] = 0 if not len(present) else int(median(present))
            estimated[i] = True
    # Empty in a scan without columns.
    first_ns = _whole([text or "0" for text in cells["first_stamp_ns"]])
    last_ns = _whole([text or "0" for text in cells["last_stamp_ns"]])
    return Windows(
        sensors=names,
        slices=slices,
        index=index,
        slice=part,
        step=index * slices + part,
        start_ns=start_ns,
        end_ns=end_ns,
        points=_whole(cells["points"]),
        complete=np.array([cell == "true" for cell in cells["complete"]], dtype=bool),
        span_ms=(last_ns - first_ns) / NS_PER_MS,
        delay_ms=_delays_ms(cells.get("ready_host_ns"), end_ns),
        columns=columns,
        expected=expected,
        estimated=estimated,
        fill=_fill(columns, expected, estimated, _shares(cells, "fill", names, rows)),
        gap_ms=gap_ms,
        coverage=_shares(cells, "coverage", names, rows),
        overlap=_shares(cells, "overlap", names, rows),
    )


def _fill(columns: I64Array, expected: I64Array, estimated: BoolArray, known: F64Array) -> F64Array:
    """The fill in the table; where it has none, by the expected columns."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share: F64Array = columns / expected
    # Where the grid cuts between two columns, a whole window has one less.
    is_whole = (expected == 0) | ((columns > 0) & (expected - columns <= 1))
    is_whole |= estimated & (share >= _NEARLY)
    own = np.where(is_whole, 1.0, share)
    return np.clip(np.where(np.isfinite(known), known, own), 0.0, 1.0)


def _whole(texts: Sequence[str]) -> I64Array:
    values = [int(text) for text in texts]
    if any(abs(value) > _LARGEST for value in values):
        raise ValueError("a number of more than 62 bits")
    return np.array(values, dtype=np.int64)


def _numbers(texts: Sequence[str]) -> F64Array:
    return np.array([float(text) if text else math.nan for text in texts])


def _delays_ms(texts: Sequence[str] | None, end_ns: I64Array) -> F64Array:
    if texts is None or not all(texts):
        return np.full(len(end_ns), math.nan)
    ready_ns = _whole(texts)
    # 0: the packets have no receive times.
    return np.where(ready_ns == 0, math.nan, (ready_ns - end_ns) / NS_PER_MS)


def _shares(
    cells: dict[str, tuple[str, ...]], word: str, names: tuple[str, ...], rows: int
) -> F64Array:
    absent = ("",) * rows
    columns = [_numbers(cells.get(f"{word}_{name}", absent)) for name in names]
    return np.stack(columns, axis=1) if columns else np.zeros((rows, 0))


@dataclass(frozen=True, slots=True)
class Summary:
    """Windows as the page stores them, (m,) and (m, s): groups of `group` windows, worst values."""

    group: int
    step: I64Array
    # Of its windows: number, incomplete ones.
    count: I64Array
    incomplete: I64Array
    points: F64Array
    span_ms: F64Array
    delay_ms: F64Array
    columns: I64Array
    expected: I64Array
    fill: F64Array
    gap_ms: F64Array
    coverage: F64Array
    overlap: F64Array


def summarise(windows: Windows) -> Summary:
    """Join windows into groups so that a page has at most MOST_CELLS values of each kind."""
    rows = len(windows)
    group = max(1, -(-rows * max(1, len(windows.sensors)) // MOST_CELLS))
    at = np.arange(0, rows, group)
    count = np.diff(np.append(at, rows))

    def lowest(values: F64Array) -> F64Array:
        found: F64Array = np.fmin.reduceat(values, at, axis=0)
        return found

    def highest(values: F64Array) -> F64Array:
        found: F64Array = np.fmax.reduceat(values, at, axis=0)
        return found

    return Summary(
        group=group,
        step=windows.step[at],
        count=count,
        incomplete=np.add.reduceat((~windows.complete).astype(np.int64), at),
        points=np.add.reduceat(windows.points, at) / count,
        span_ms=highest(windows.span_ms),
        delay_ms=highest(windows.delay_ms),
        columns=np.add.reduceat(windows.columns, at, axis=0),
        expected=np.add.reduceat(windows.expected, at, axis=0),
        fill=lowest(windows.fill),
        gap_ms=highest(windows.gap_ms),
        coverage=lowest(windows.coverage),
        overlap=highest(windows.overlap),
    )
