"""Two outputs, array by array: where they differ first, and by how much at most."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from mlbatch.digests.comparison import Difference, Json, scan_name, walk
from mlbatch.digests.golden import Values, describe_run, fields_of, values
from mlbatch.errors import UsageError
from mlbatch.outputs.read import IndexedScans, opened
from mlbatch.outputs.run_files import RunFiles
from mlbatch.outputs.scan import Scan
from mlbatch.units import NS_PER_S


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
    one, other = opened(a), opened(b)
    numbers, others = _by_window(one, 0), _by_window(other, _windows_between(old, new))
    for key, number in numbers.items():
        if key in others:
            result.compared += 1
            scan = one.scan(number)
            _compare(result, _name(scan), scan, other.scan(others[key]), tolerance)
        else:
            result.only_in_a.append(_name(one.scan(number)))
    result.only_in_b += [_name(other.scan(others[key])) for key in others if key not in numbers]
    return result


def _name(scan: Scan) -> str:
    return scan_name(scan.index, scan.slice, scan.sensor)


def _by_window(scans: IndexedScans, later: int) -> dict[tuple[int, int, str], int]:
    """Numbers of scans by window in the first output, slice and sensor; later: windows to it."""
    return {
        (place.window + later, place.slice, place.sensor): number
        for number, place in enumerate(scans.places)
    }


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
