"""Whether the report's counts and figures are those of the scans and of scans.csv."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.verify.document import Document
from mlbatch.verify.grid import Lines
from mlbatch.verify.table import Table
from mlbatch.verify.tally import Tally

_NS_PER_MS = 1e6
# Windows without a scan: nothing was in them, or too little (`--drop-incomplete`).
_UNWRITTEN = ("empty", "dropped_incomplete")


def check_report(report: Document, tally: Tally, table: Table | None, lines: Lines | None) -> None:
    """Hold the report against everything that was met."""
    judge = report.judge
    _equal(report, ("scans", "points"), tally.points)
    count = report.length("sensors")
    if tally.knows_points:
        for i in range(min(count, len(tally.points_of))):
            _equal(report, ("sensors", i, "points", "written"), int(tally.points_of[i]))
    if tally.knows_owners:
        for i in range(min(count, len(tally.columns_of))):
            _equal(report, ("sensors", i, "columns", "written"), int(tally.columns_of[i]))
    written = [report.number("sensors", i, "columns", "written") for i in range(count)]
    if tally.knows_columns and None not in written:
        judge.passed("report")
        total = sum(number or 0 for number in written)
        if total != tally.columns:
            name = report.name("sensors", "columns", "written")
            judge.blame("report", f"{name}, all", tally.columns, total)
    _check_slots(report, tally)
    if table is not None:
        _check_table(report, table, lines)


def _equal(report: Document, path: tuple[str | int, ...], wanted: int) -> None:
    said = report.number(*path)
    if said is not None:
        report.judge.equal("report", report.name(*path), wanted, said)


def _check_slots(report: Document, tally: Tally) -> None:
    """Every column of a sensor has equally many slots, and no more rings than slots."""
    judge = report.judge
    for i in range(min(report.length("sensors"), len(tally.points_of))):
        slots = report.number("sensors", i, "points", "slots")
        columns = report.number("sensors", i, "columns", "written")
        if not slots or not columns:
            continue
        name = report.name("sensors", i, "points", "slots")
        if slots % columns:
            judge.blame("report", name, f"a multiple of {columns} columns", slots)
            continue
        judge.passed("report")
        # A column of one point may be of any ring of its sensor.
        span = int(tally.rings.high[i]) - int(tally.rings.low[i])
        if slots > columns and tally.rings.high_at.get(i) and span >= slots // columns:
            low = int(tally.rings.low[i])
            judge.blame(
                "rings",
                tally.rings.high_at[i],
                f"a ring less than {slots // columns} slots above {low}, the sensor's lowest",
                int(tally.rings.high[i]),
            )


def _check_table(report: Document, table: Table, lines: Lines | None) -> None:
    count = report.length("sensors")
    _equal(report, ("scans", "written"), len(table))
    _equal(report, ("scans", "points"), int(table.points.sum()))
    _equal(report, ("scans", "incomplete"), int(np.count_nonzero(~table.complete)))
    for i in range(min(count, len(table.sensors))):
        written = int(table.columns_of[:, i].sum())
        _equal(report, ("sensors", i, "columns", "written"), written)
    span_ms: F64Array = (table.last_ns - table.first_ns) / _NS_PER_MS
    _check_spread(report, "span_ms", span_ms)
    if lines is None:
        return
    step: I64Array = table.index * lines.slices + table.slice
    steps = np.diff(step)
    if (steps > 0).all():
        period_ms: F64Array = np.diff(table.start_ns) / steps / _NS_PER_MS
        _check_spread(report, "period_ms", period_ms)
        inside = step[step >= 0]
        unwritten = [report.number("scans", name) for name in _UNWRITTEN]
        gaps = int(inside[-1] - inside[0]) + 1 - len(inside) if len(inside) else 0
        total = sum(number or 0 for number in unwritten)
        report.judge.passed("report")
        if gaps > total:
            name = report.name("scans", " + ".join(_UNWRITTEN))
            wanted = f"{gaps} or more, the windows that are left out of {table.where}"
            report.judge.blame("report", name, wanted, total)


def _check_spread(report: Document, name: str, values_ms: F64Array) -> None:
    """Median, 99 % and largest: values that occurred."""
    if not len(values_ms):
        return
    ranks = np.sort(values_ms)
    share = {"p50": 0.5, "p99": 0.99, "max": 1.0}
    for key, part in share.items():
        wanted = float(ranks[max(0, int(np.ceil(len(ranks) * part)) - 1)])
        said = report.at("scans", name, key)
        report.judge.passed("report")
        close = isinstance(said, (int, float)) and abs(said - wanted) <= 1e-9 * abs(wanted)
        if not close:
            report.judge.blame("report", report.name("scans", name, key), wanted, said)
