"""scans.csv as it stands in an output (CONTRACT.md, section 3): parsed, and held against itself.

Columns that later versions add are left alone.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.verify.grid import Lines
from mlbatch.verify.verdict import Judge

START = ("index", "slice", "start_ns", "end_ns", "first_stamp_ns", "last_stamp_ns")
COUNTS = ("points", "columns")
_COLUMNS, _GAP = "columns_", "max_gap_ns_"
# csv refuses longer cells than 128 KiB by itself.
_WORDS = {"true": True, "false": False}


@dataclass(slots=True)
class Table:
    """Rows of scans.csv, (n,) int64 each; columns_of, gap_ns: (n, s); complete: (n,) bool."""

    where: str
    sensors: tuple[str, ...]
    index: I64Array
    slice: I64Array
    start_ns: I64Array
    end_ns: I64Array
    first_ns: I64Array
    last_ns: I64Array
    points: I64Array
    columns: I64Array
    columns_of: I64Array
    gap_ns: I64Array
    complete: BoolArray
    _rows: dict[tuple[int, int], int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.index)

    def row(self, index: int, part: int) -> int | None:
        """Row of a window or slice."""
        if not self._rows:
            keys = zip(self.index.tolist(), self.slice.tolist(), strict=True)
            self._rows.update((key, number) for number, key in enumerate(keys))
        return self._rows.get((index, part))

    def name(self, row: int) -> str:
        """A row as a person finds it; the first line is the header."""
        return f"{self.where} line {row + 2}"


def read_table(judge: Judge, where: str, text: str) -> Table | None:
    """Parse scans.csv; what cannot be used is blamed."""
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as err:
        judge.blame("table", where, "lines of comma-separated values", str(err))
        return None
    if not lines or tuple(lines[0][: len(START)]) != START:
        judge.blame(
            "table", f"{where} line 1", ",".join(START), ",".join(lines[0] if lines else [])
        )
        return None
    head = lines[0]
    sensors = tuple(name[len(_COLUMNS) :] for name in head if name.startswith(_COLUMNS))
    wanted = [*COUNTS, *(_COLUMNS + name for name in sensors), "complete"]
    wanted += [_GAP + name for name in sensors]
    missing = [name for name in wanted if name not in head]
    short = next((i for i, line in enumerate(lines) if len(line) != len(head)), None)
    if missing or short is not None or not sensors:
        got = f"{len(lines[short])} cells in line {short + 1}" if short is not None else "none"
        judge.blame("table", where, f"columns {', '.join(missing) or 'in every line'}", got)
        return None
    cells = dict(zip(head, zip(*lines[1:], strict=True), strict=True)) if lines[1:] else {}
    if not cells:
        judge.blame("table", where, "a line for each scan", "none")
        return None
    return _numbers(judge, where, sensors, cells)


def _numbers(
    judge: Judge, where: str, sensors: tuple[str, ...], cells: dict[str, tuple[str, ...]]
) -> Table | None:
    names = [*START, *COUNTS, *(_COLUMNS + name for name in sensors)]
    names += [_GAP + name for name in sensors]
    found = {name: _column(judge, where, name, cells[name]) for name in names}
    if any(column is None for column in found.values()):
        return None
    number = {name: column for name, column in found.items() if column is not None}
    odd = next((i for i, cell in enumerate(cells["complete"]) if cell not in _WORDS), None)
    if odd is not None:
        got = cells["complete"][odd]
        judge.blame("table", f"{where} line {odd + 2} complete", "true or false", got)
        return None
    return Table(
        where=where,
        sensors=sensors,
        index=number["index"],
        slice=number["slice"],
        start_ns=number["start_ns"],
        end_ns=number["end_ns"],
        first_ns=number["first_stamp_ns"],
        last_ns=number["last_stamp_ns"],
        points=number["points"],
        columns=number["columns"],
        columns_of=np.stack([number[_COLUMNS + name] for name in sensors], axis=1),
        gap_ns=np.stack([number[_GAP + name] for name in sensors], axis=1),
        complete=np.array([_WORDS[cell] for cell in cells["complete"]]),
    )


def _column(judge: Judge, where: str, name: str, cells: tuple[str, ...]) -> I64Array | None:
    """A column of numbers; None where a cell is none, which is blamed."""
    try:
        return np.array([int(cell) for cell in cells], np.int64)
    except (ValueError, OverflowError):
        row = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        judge.blame("table", f"{where} line {row + 2} {name}", "a number", cells[row])
        return None


def _is_number(cell: str) -> bool:
    try:
        return -(2**63) <= int(cell) < 2**63
    except ValueError:
        return False


def check_table(judge: Judge, table: Table, lines: Lines | None, first: int | None) -> None:
    """Hold the table against itself; `first`: number of scan 0's window."""
    _check_columns(judge, table)
    key = table.index * (1 if lines is None else lines.slices) + table.slice
    back = key[1:] <= key[:-1]
    _none(judge, table, "table", 1, back, "index and slice", "later ones than before", key[1:])
    if lines is None:
        return
    if first is None:
        first = lines.number(int(table.start_ns[0])) // lines.slices - int(table.index[0])
    # Whole numbers of any size: what is claimed may lie anywhere.
    numbers = [number + first * lines.slices for number in key.tolist()]
    for name, column, after in (("start_ns", table.start_ns, 0), ("end_ns", table.end_ns, 1)):
        bounds = np.array([lines.bound(q + after) for q in numbers])
        wrong = column != bounds
        at = int(wrong.argmax()) if wrong.any() else 0
        _none(judge, table, "grid", 0, wrong, name, str(bounds[at]), column)
    strange = (table.slice < 0) | (table.slice >= lines.slices)
    wanted = f"a slice below {lines.slices}"
    _none(judge, table, "index", 0, strange, "slice", wanted, table.slice)
    _none(judge, table, "index", 0, table.index < -1, "index", "-1 or more", table.index)


def _check_columns(judge: Judge, table: Table) -> None:
    early = (table.first_ns < table.start_ns) | (table.first_ns > table.last_ns)
    wanted = "a stamp from start_ns to last_stamp_ns"
    _none(judge, table, "columns", 0, early, "first_stamp_ns", wanted, table.first_ns)
    late = table.last_ns >= table.end_ns
    wanted = "a stamp before end_ns"
    _none(judge, table, "columns", 0, late, "last_stamp_ns", wanted, table.last_ns)
    total: I64Array = table.columns_of.sum(axis=1)
    wrong = (table.columns != total) | (table.columns <= 0) | (table.columns_of < 0).any(axis=1)
    wanted = "the sum of the sensors', above 0"
    _none(judge, table, "table", 0, wrong, "columns", wanted, table.columns)
    _none(judge, table, "table", 0, table.points < 0, "points", "0 or more", table.points)
    span_ns = (table.last_ns - table.first_ns)[:, None]
    # Steps between columns, of which there are one less, add up to at most the span.
    wide: BoolArray = np.any((table.gap_ns < 0) | (table.gap_ns > span_ns), axis=1)
    widest: I64Array = table.gap_ns.max(axis=1)
    wanted = "a step no longer than from first to last stamp"
    _none(judge, table, "table", 0, wide, "max_gap_ns", wanted, widest)


def _none(
    judge: Judge,
    table: Table,
    check: str,
    shift: int,
    bad: BoolArray,
    name: str,
    wanted: str,
    values: I64Array,
) -> None:
    """Wanted: no row is bad; `shift`: rows that precede the first judged one."""
    judge.passed(check, len(bad))
    if bad.any():
        at = int(bad.argmax())
        count = int(np.count_nonzero(bad))
        more = f" ({count} lines)" if count > 1 else ""
        judge.blame(check, f"{table.name(at + shift)} {name}", wanted, f"{values[at]}{more}")
