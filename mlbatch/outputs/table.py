"""scans.csv: its cells by column, all of them as an array of rows, and the row of a scan."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.errors import RecordingError
from mlbatch.outputs.damage import DamageError

# A structured array; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
# Empty cells of integer columns, which have no negative values.
UNKNOWN = -1
COLUMNS = "columns_"
_FIRST = ("index", "slice", "start_ns", "end_ns", "first_stamp_ns", "last_stamp_ns")
_REALS = ("coverage_", "overlap_", "missing_", "fill_")
_WORDS = {"true": True, "false": False}


class TableError(DamageError):
    """A table that is damaged; place: line and column, "" for all of it."""

    def __init__(self, place: str, expected: str, found: str) -> None:
        super().__init__(expected, found)
        self.place = place

    def at(self, where: str) -> str:
        """The place, in a table of this name."""
        return f"{where} {self.place}".strip()


@dataclass(frozen=True, slots=True)
class Cells:
    """The texts of scans.csv by column, (n,) each, in the order of the head line.

    Methods raise TableError for a cell of another type.
    """

    columns: dict[str, tuple[str, ...]]

    @classmethod
    def of(cls, text: str) -> Cells:
        """The cells of a table; TableError for another text."""
        try:
            lines = list(csv.reader(text.splitlines()))
        except csv.Error as err:
            raise TableError("", "lines of comma-separated values", str(err)) from err
        head = lines[0] if lines else []
        if tuple(head[: len(_FIRST)]) != _FIRST:
            raise TableError("line 1", ",".join(_FIRST), ",".join(head))
        for number, line in enumerate(lines):
            if len(line) != len(head):
                raise TableError(f"line {number + 1}", f"{len(head)} cells", str(len(line)))
        cells = zip(*lines[1:], strict=True) if len(lines) > 1 else [()] * len(head)
        return cls(dict(zip(head, cells, strict=True)))

    def __len__(self) -> int:
        return len(self.columns["index"])

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors, in the order of `lidar_id`."""
        return tuple(
            name.removeprefix(COLUMNS) for name in self.columns if name.startswith(COLUMNS)
        )

    def integers(self, name: str, empty: int | None = None) -> I64Array:
        """A column of integers; empty: the value of empty cells, None: they are damage."""
        values: I64Array = np.zeros(len(self), np.int64)

        def value(cell: str) -> int:
            return int(cell) if cell or empty is None else empty

        return self._filled(name, values, value, "a number")

    def reals(self, name: str) -> F64Array:
        """A column of numbers; NaN where a cell is empty."""
        values: F64Array = np.zeros(len(self), np.float64)
        return self._filled(
            name, values, lambda cell: float(cell) if cell else math.nan, "a number"
        )

    def flags(self, name: str) -> BoolArray:
        """A column of words."""
        values: BoolArray = np.zeros(len(self), bool)
        return self._filled(name, values, _WORDS.__getitem__, "true or false")

    def _filled(
        self, name: str, values: Rows, value: Callable[[str], float], expected: str
    ) -> Rows:
        if name not in self.columns:
            raise TableError("", f"a column {name}", "none")
        row = 0
        cell = ""
        try:
            for row, cell in enumerate(self.columns[name]):
                values[row] = value(cell)
        except (KeyError, ValueError, OverflowError) as err:
            raise TableError(f"line {row + 2} {name}", expected, cell) from err
        return values

    def by_sensor(self, prefix: str, column: Callable[[str], Rows]) -> Rows:
        """Columns of all sensors side by side, (n, s)."""
        found = [column(prefix + sensor) for sensor in self.sensors]
        return np.stack(found, axis=1) if found else np.zeros((len(self), 0))

    def rows(self) -> Rows:
        """All cells, (n,), with the fields of the head line.

        Integers are int64, -1 where a cell is empty; shares and missing columns are float64, NaN
        where a cell is empty.
        """
        found = {name: self._column(name) for name in self.columns}
        rows: Rows = np.zeros(len(self), [(name, one.dtype) for name, one in found.items()])
        for name, one in found.items():
            rows[name] = one
        return rows

    def _column(self, name: str) -> Rows:
        if name == "complete":
            return self.flags(name)
        return self.reals(name) if name.startswith(_REALS) else self.integers(name, UNKNOWN)


def read_table(text: str, where: str) -> Rows:
    """The rows of scans.csv, as `Cells.rows`; RecordingError for another file."""
    try:
        return Cells.of(text).rows()
    except TableError as err:
        raise RecordingError(f"{err.at(where)}: {err}; restore it, or convert again") from err


class TableOfRun:
    """Rows of a run; sensors: names in the order of `lidar_id`."""

    def __init__(self, rows: Rows, sensors: tuple[str, ...]) -> None:
        self.rows = rows
        self._sensors = sensors
        keys = zip(rows["index"].tolist(), rows["slice"].tolist(), strict=True)
        self._numbers = {key: number for number, key in enumerate(keys)}

    def row(self, index: int, part: int) -> Any:
        """The row of a window or slice; None if it has none."""
        number = self._numbers.get((index, part))
        return None if number is None else self.rows[number]

    def of_scan(self, index: int, part: int, only: int | None) -> dict[str, Any] | None:
        """What a row says of a scan, by the names of `Scan`; only: its sensor with `--split`."""
        row = self.row(index, part)
        if row is None:
            return None

        def of(prefix: str, *, other: float | None = None) -> tuple[Any, ...]:
            """Values of all sensors; other: that of sensors which are not in the scan."""
            names = [prefix + sensor for sensor in self._sensors]
            known = [row[name].item() for name in names if name in (row.dtype.names or ())]
            if only is None or other is None:
                return tuple(known)
            return tuple(value if i == only else other for i, value in enumerate(known))

        return {
            "complete": bool(row["complete"]),
            "columns_per_sensor": of(COLUMNS, other=0),
            # Of the window, as is fill: also of sensors that are not in this scan.
            "max_gap_ns": of("max_gap_ns_"),
            "coverage": of("coverage_", other=0.0),
            "overlap": of("overlap_", other=0.0),
            "fill": np.array(of("fill_"), np.float32),
            "ready_host_ns": int(row["ready_host_ns"]),
        }
