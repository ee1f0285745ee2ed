"""Two outputs, array by array: where they differ first, and by how much at most."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mlbatch.digests.comparison import Difference, Json, scan_name, walk
from mlbatch.digests.golden import Values, describe_run, fields_of, values
from mlbatch.errors import UsageError
from mlbatch.outputs.read import read
from mlbatch.outputs.run_files import RunFiles
from mlbatch.outputs.scan import Scan
from mlbatch.units import NS_PER_S


class _Key(NamedTuple):
    """Window and sensor, by which scans of two outputs are matched."""

    window: tuple[int, int]  # index in the first output, slice
    sensor: str


@dataclass(slots=True)
class FieldDifference:
    """A field that differs; a, b and point are at its first difference."""

    field: str
    scan: str
    point: int | None  # None: the number of values differs
    a: Json
    b: Json
    by: float | None  # largest absolute difference of all scans; None: not of numbers
    scans: int = 1
    values: int = 0  # in all scans, where numbers of values are equal


@dataclass(slots=True)
class OutputDiff:
    """Differences between two outputs."""

    compared: int = 0  # scans in both
    run: list[Difference] = field(default_factory=list)  # grid, accounts, warnings
    only_in_a: list[str] = field(default_factory=list)
    only_in_b: list[str] = field(default_factory=list)
    fields: dict[str, FieldDifference] = field(default_factory=dict)

    @property
    def same(self) -> bool:
        """True without a difference."""
        return not (self.run or self.only_in_a or self.only_in_b or self.fields)

    @property
    def first(self) -> FieldDifference | None:
        """The first field that differs in the first scan that differs."""
        return next(iter(self.fields.values()), None)


def check_tolerance(tolerance: float) -> None:
    """Refuse a `--tolerance` that is not a finite number from 0."""
    if not 0 <= tolerance < math.inf:
        raise UsageError(f"--tolerance: expected 0 or more, found {tolerance}; write 0.0001")


def diff(a: Path, b: Path, tolerance: float = 0.0) -> OutputDiff:
    """Compare all scans of two outputs in the fields that both store; tolerance: of reals.

    Scans of one window of time are compared, whatever their numbers. Raises RecordingError where
    one of them is damaged.
    """
    result = OutputDiff()
    old, new = (describe_run(output, RunFiles.of(output).texts()[0]) for output in (a, b))
    result.run += walk("", old, new, tolerance)
    for one, other in _pairs(_Side(a), _Side(b, _windows_between(old, new))):
        name = _name(one, other)
        if one is None or other is None:
            (result.only_in_b if one is None else result.only_in_a).append(name)
        else:
            result.compared += 1
            _compare(result, name, one, other, tolerance)
    return result


def _name(*scans: Scan | None) -> str:
    """The name of a scan in the first output that has it."""
    return next(scan_name(one.index, one.slice, one.sensor) for one in scans if one is not None)


# -- scans in both ----------------------------------------------------------------------------


def _windows_between(a: Any, b: Any) -> int:
    """How many windows later `b` begins; 0 where their grids differ."""
    try:
        rate, other = (Fraction(run["grid"]["rate_hz"]) for run in (a, b))
        begin_ns, other_ns = (int(run["grid"]["t_init_ns"]) for run in (a, b))
    except (KeyError, TypeError, ValueError):
        # Without a report.
        return 0
    count = round((other_ns - begin_ns) * rate / NS_PER_S)
    # Bounds are rounded up to whole nanoseconds.
    is_one_grid = rate == other and abs(count * NS_PER_S / rate - (other_ns - begin_ns)) < 1
    return count if is_one_grid else 0


def _pairs(a: _Side, b: _Side) -> Iterator[tuple[Scan | None, Scan | None]]:
    """Scans of both outputs by window, with None where one output lacks the scan.

    Scans wait for their counterpart while that can come: folders have them sensor by sensor, other
    outputs window by window.
    """
    sides = (a, b)
    while not all(side.is_done for side in sides):
        for side, other in (sides, sides[::-1]):
            scan = side.next()
            if scan is None:
                continue
            key = side.key
            match = other.waiting.pop(key, None)
            if match is None:
                side.waiting[key] = scan
            else:
                yield (scan, match) if side is a else (match, scan)
        yield from _unmatched(sides)
    yield from _unmatched(sides)


class _Side:
    """One output; waiting: scans without a counterpart so far; later: windows to the first."""

    def __init__(self, output: Path, later: int = 0) -> None:
        self._scans = read(output)
        self._later = later
        self.waiting: dict[_Key, Scan] = {}
        self.key = _Key((later - 2, 0), "")
        self.is_done = False
        self.is_by_sensor = output.is_dir() and any(one.is_dir() for one in output.iterdir())

    def next(self) -> Scan | None:
        """The next scan; None at the end."""
        scan = next(self._scans, None)
        if scan is None:
            self.is_done = True
        else:
            self.key = _Key((scan.index + self._later, scan.slice), scan.sensor)
        return scan

    def has_passed(self, key: _Key) -> bool:
        """Whether no scan of this window follows."""
        if self.is_done:
            return True
        return not self.is_by_sensor and self.key.window > key.window


def _unmatched(sides: tuple[_Side, _Side]) -> Iterator[tuple[Scan | None, Scan | None]]:
    for side, other in (sides, sides[::-1]):
        for key in [key for key in side.waiting if other.has_passed(key)]:
            scan = side.waiting.pop(key)
            yield (scan, None) if side is sides[0] else (None, scan)


# -- values -----------------------------------------------------------------------------------


def _compare(result: OutputDiff, name: str, a: Scan, b: Scan, tolerance: float) -> None:
    for key in ("start_ns", "end_ns", "complete"):
        result.run += walk(f"scan {name} {key}", getattr(a, key), getattr(b, key), 0.0)
    others = dict(fields_of(b))
    for field_name, one in fields_of(a):
        other = others.get(field_name)
        if other is None:
            continue
        found = _first_difference(field_name, name, one, other, tolerance)
        if found is None:
            continue
        known = result.fields.setdefault(field_name, found)
        if known is not found:
            known.scans += 1
            known.values += found.values
            known.by = _larger(known.by, found.by)


def _larger(one: float | None, other: float | None) -> float | None:
    return max((value for value in (one, other) if value is not None), default=None)


def _first_difference(
    name: str, scan: str, a: Values, b: Values, tolerance: float
) -> FieldDifference | None:
    """The first point at which two arrays differ; None if they do not."""
    if a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes():
        return None
    count = min(len(a), len(b))
    differs, amount = _different(a[:count], b[:count], tolerance)
    rows = np.flatnonzero(differs.reshape(count, -1).any(axis=1)) if count else np.zeros(0, int)
    if a.shape != b.shape:
        # All points after a missing one differ.
        shapes = (list(a.shape), list(b.shape))
        point = int(rows[0]) if rows.size else count
        return FieldDifference(name, scan, point, *shapes, None)
    if not rows.size:
        return None
    first = int(rows[0])
    return FieldDifference(
        name,
        scan,
        first,
        values(a[first]),
        values(b[first]),
        amount,
        values=int(np.count_nonzero(differs)),
    )


def _different(a: Values, b: Values, tolerance: float) -> tuple[Values, float]:
    """Which values differ, and the largest difference; empty slots (NaN) are equal."""
    if a.shape != b.shape:
        return np.zeros(len(a), bool), 0.0
    if a.dtype.kind == "f" or b.dtype.kind == "f":
        both = np.isnan(a) & np.isnan(b)
        amount = np.abs(b.astype(np.float64) - a.astype(np.float64))
        differs = ~both & ~(amount <= tolerance)
    else:
        # Stamps need all 64 bits.
        amount = np.abs(b.astype(np.int64) - a.astype(np.int64))
        differs = amount > 0
    finite = amount[differs & np.isfinite(amount)]
    return differs, float(finite.max(initial=0))
