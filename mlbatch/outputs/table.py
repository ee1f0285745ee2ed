"""scans.csv as an array of rows, and the rows of a run by window."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.errors import RecordingError

# A structured array; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
# Empty cells of integer columns, which have no negative values.
UNKNOWN = -1
_REALS = ("coverage_", "overlap_", "missing_", "fill_")
_BOOLS = {"complete": {"true": True, "false": False}}
_KEYS = ("index", "slice", "start_ns", "end_ns")


def read_table(text: str, where: str) -> Rows:
    """The rows of scans.csv, (n,), with the fields of its head line.

    Integers are int64, -1 where a cell is empty; shares and missing columns are float64, NaN where
    a cell is empty. Raises RecordingError for another file.
    """
    lines = list(csv.reader(text.splitlines()))
    head = lines[0] if lines else []
    if tuple(head[: len(_KEYS)]) != _KEYS:
        raise RecordingError(
            f"{where}: expected the head line of scans.csv ({','.join(_KEYS)}, ...), found "
            f"{','.join(head)[:80]!r}; restore it, or convert again"
        )
    rows: Rows = np.zeros(len(lines) - 1, [(name, _type_of(name)) for name in head])
    for number, line in enumerate(lines[1:]):
        rows[number] = _row(head, line, f"{where} line {number + 2}")
    return rows


def _row(head: list[str], line: list[str], where: str) -> tuple[bool | float | int, ...]:
    try:
        return tuple(_value(name, cell) for name, cell in zip(head, line, strict=True))
    except (KeyError, ValueError) as err:
        raise RecordingError(
            f"{where}: expected {len(head)} values of a scan, found {','.join(line)[:80]!r}; "
            "restore it, or convert again"
        ) from err


def _type_of(name: str) -> str:
    if name in _BOOLS:
        return "?"
    return "<f8" if name.startswith(_REALS) else "<i8"


def _value(name: str, cell: str) -> bool | float | int:
    if name in _BOOLS:
        return _BOOLS[name][cell]
    if name.startswith(_REALS):
        return float(cell) if cell else np.nan
    return int(cell) if cell else UNKNOWN


@dataclass(slots=True)
class ScanRow:
    """What scans.csv has about a scan, by sensor."""

    complete: bool
    columns: tuple[int, ...] = ()
    max_gap_ns: tuple[int, ...] = ()
    coverage: tuple[float, ...] = ()
    overlap: tuple[float, ...] = ()
    fill: tuple[float, ...] = ()
    ready_host_ns: int = 0


@dataclass(slots=True)
class TableOfRun:
    """Rows of a run; sensors: names in the order of `lidar_id`."""

    rows: Rows
    sensors: tuple[str, ...]
    _numbers: dict[tuple[int, int], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        keys = zip(self.rows["index"].tolist(), self.rows["slice"].tolist(), strict=True)
        self._numbers.update((key, number) for number, key in enumerate(keys))

    def row(self, index: int, part: int) -> ScanRow | None:
        """The row of a window or slice."""
        number = self._numbers.get((index, part))
        if number is None:
            return None
        row = self.rows[number]
        return ScanRow(
            complete=bool(row["complete"]),
            columns=tuple(self._of("columns_", number)),
            max_gap_ns=tuple(self._of("max_gap_ns_", number)),
            coverage=tuple(self._of("coverage_", number)),
            overlap=tuple(self._of("overlap_", number)),
            fill=tuple(self._of("fill_", number)),
            ready_host_ns=int(row["ready_host_ns"]),
        )

    def _of(self, prefix: str, number: int) -> list[Any]:
        names = [prefix + sensor for sensor in self.sensors]
        known = self.rows.dtype.names or ()
        return [self.rows[name][number].item() for name in names if name in known]
