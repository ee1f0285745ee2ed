"""Comparisons: a program with others that ran in turn with it, and now with before.

Runs are compared one by one, so that a slower minute of the machine slows both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import median
from typing import Final

from mlbatch.bench.results import FLOOR, OURS, PEER, Changed, Ratio, Row, Run

COPY, WRITE, LIBRARY = "memory copy", "plain write", "mcap library"
START, DRY_RUN = "python with numpy", "dry run"
CPU, OWN_CPU, WALL, MEMORY = "CPU", "CPU without start", "time", "peak memory"
WRITING: Final = "CPU above the dry run"
_MEASURES: Final[Mapping[str, Callable[[Run], float]]] = {
    CPU: lambda run: run.cpu_s,
    OWN_CPU: lambda run: run.own_cpu_s,
    WALL: lambda run: run.wall_s,
    MEMORY: lambda run: run.rss_mb,
}
OFS: Final = tuple(_MEASURES)
# What is compared with a peer, with the program that another one extends, and with a floor.
_WITH_PEER: Final = (CPU, OWN_CPU)
_WITH_BASE: Final = (CPU, WALL)
_WITH_FLOOR: Final[Mapping[str, str]] = {START: MEMORY, COPY: OWN_CPU, WRITE: WALL}
_NOW_AND_BEFORE: Final[Mapping[str, str]] = {
    "cpu_s": CPU,
    "own_cpu_s": OWN_CPU,
    "wall_s": WALL,
    "rss_mb": MEMORY,
}


def ratios(rows: Sequence[Row]) -> Iterator[Ratio]:
    """All comparisons within the cases, in the order of the rows."""
    for row in rows:
        if row.role == OURS and row.program != DRY_RUN:
            others = [other for other in rows if other.case == row.case and other is not row]
            for other in others:
                yield from _between(row, other, others)


def _between(row: Row, other: Row, others: Sequence[Row]) -> Iterator[Ratio]:
    writes = row.counted.written_bytes > 0
    if other.role == PEER and other.counted.read_bytes == row.counted.read_bytes:
        yield from (_ratio(row, other, of) for of in _WITH_PEER)
    elif other.role == FLOOR and other.program == LIBRARY:
        dry = next((one for one in others if one.program == DRY_RUN), None)
        if writes and dry is not None:
            yield _above(row, dry, other)
    elif other.role == FLOOR and (writes or other.program != WRITE):
        yield _ratio(row, other, _WITH_FLOOR[other.program])
    elif other.program == row.base:
        yield from (_ratio(row, other, of) for of in _WITH_BASE)


def _ratio(row: Row, other: Row, of: str) -> Ratio:
    value = _MEASURES[of]
    pairs = zip(row.runs, other.runs, strict=True)
    return Ratio(row.case, row.program, other.program, of, tuple(_over(value, *p) for p in pairs))


def _over(value: Callable[[Run], float], run: Run, other: Run) -> float:
    return value(run) / max(value(other), 1e-9)


def _above(row: Row, dry: Row, library: Row) -> Ratio:
    """What writing costs, against a library that only writes."""
    runs = zip(row.runs, dry.runs, library.runs, strict=True)
    values = tuple((a.own_cpu_s - b.own_cpu_s) / max(c.own_cpu_s, 1e-9) for a, b, c in runs)
    return Ratio(row.case, row.program, library.program, WRITING, values)


def changes(
    rows: Sequence[Row], before: Mapping[tuple[str, str], Mapping[str, Sequence[float]]]
) -> Iterator[Changed]:
    """Medians of now and of an earlier document, where both have the program."""
    for row in rows:
        old = before.get((row.case, row.program))
        for name, of in _NOW_AND_BEFORE.items():
            if old is not None and old[name] and median(old[name]) > 0:
                now = median(getattr(run, name) for run in row.runs)
                yield Changed(row.case, row.program, of, median(old[name]), now)
