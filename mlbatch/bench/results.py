"""What was measured, as values and as a document (schema `mlbatch.bench/1`)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Final, TypeAlias

from mlbatch.bench.measure import BenchError
from mlbatch.errors import one_line
from mlbatch.units import NS_PER_S

Json: TypeAlias = bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"] | None

SCHEMA = "mlbatch.bench/1"
OURS, FLOOR, PEER = "mlbatch", "floor", "peer"


@dataclass(frozen=True, slots=True)
class Counted:
    """What a program worked on; it is the same in every run.

    slots: (channel, return) places read; points: valid ones; scans: or turns, or messages;
    recorded_s: length of the recording.
    """

    slots: int = 0
    points: int = 0
    scans: int = 0
    recorded_s: float = 0.0
    read_bytes: int = 0
    written_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a program.

    cpu_s, wall_s, rss_mb: of the whole process; own_cpu_s: without its start and imports;
    stages_s: read, decode, merge, write, as the report tells them.
    """

    cpu_s: float
    wall_s: float
    rss_mb: float
    own_cpu_s: float
    counted: Counted
    stages_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Row:
    """A program in a case, and all its runs; base: a program of the case that it extends."""

    case: str
    program: str
    role: str
    base: str
    counted: Counted
    runs: tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class Ratio:
    """A program compared with another one of its case, run by run; of: what is compared."""

    case: str
    program: str
    to: str
    of: str
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Changed:
    """A median of this document against that of an earlier one."""

    case: str
    program: str
    of: str
    before: float
    now: float

    @property
    def ratio(self) -> float:
        """Below 1: it has become less."""
        return self.now / self.before


@dataclass(frozen=True, slots=True)
class Result:
    """A whole benchmark.

    machine: texts and numbers by name; notes: what was left out, and why; failed: conversions that
    ended with an error.
    """

    date: str
    machine: Mapping[str, Json]
    seconds: float
    repeat: int
    rows: tuple[Row, ...]
    ratios: tuple[Ratio, ...]
    notes: tuple[str, ...]
    failed: tuple[str, ...] = ()
    changes: tuple[Changed, ...] = ()


def document(result: Result) -> dict[str, Json]:
    """The result for programs."""
    return {
        "schema": SCHEMA,
        "date": result.date,
        "machine": result.machine,
        "seconds": result.seconds,
        "repeat": result.repeat,
        "rows": [_row(row) for row in result.rows],
        "ratios": [{**asdict(one), "median": median(one.values)} for one in result.ratios],
        "changes": [{**asdict(one), "ratio": one.ratio} for one in result.changes],
        "notes": list(result.notes),
        "failed": list(result.failed),
    }


def _row(row: Row) -> dict[str, Json]:
    return {
        "case": row.case,
        "program": row.program,
        "role": row.role,
        "base": row.base,
        **asdict(row.counted),
        **{name: [getattr(run, name) for run in row.runs] for name in _LISTS},
        "stages_s": {
            name: [run.stages_s.get(name, 0.0) for run in row.runs] for name in row.runs[0].stages_s
        },
    }


_LISTS = ("cpu_s", "wall_s", "rss_mb", "own_cpu_s")


def read_document(path: Path) -> dict[tuple[str, str], dict[str, list[float]]]:
    """Of an earlier document, by case and program: the lists of its runs."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["schema"] != SCHEMA:
            raise BenchError(f"{path}: wanted schema {SCHEMA}, got {found['schema']}")
        return {
            (str(row["case"]), str(row["program"])): {
                name: [float(value) for value in row[name]] for name in _LISTS
            }
            for row in found["rows"]
        }
    except OSError as err:
        raise BenchError(f"{path}: wanted an earlier result, got {err.strerror}") from err
    except (ValueError, KeyError, TypeError) as err:
        raise BenchError(
            f"{path}: wanted what `mlbatch bench --json` printed, got something else "
            f"({type(err).__name__}: {err}); give another file"
        ) from err


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


_STAGES = ("read", "decode", "merge", "write")
_HEAD = ("case", "program", "CPU s", "own s", "time s", "ns/slot", "x real", "MB", *_STAGES)
_LEFT, _LEFT_OF_RATIOS = 2, 4


def lines(result: Result) -> list[str]:
    """Machine, programs, ratios, changes, notes."""
    told = result.machine
    versions = (f"{name} {value}" for name, value in told.items() if name not in _MACHINE)
    head = [
        f"{told['cpu']}, {told['cores']} cores, {told['memory_mb']} MB, {told['system']}",
        f"{result.date}, load {told['load']:.1f}, {', '.join(versions)}",
        f"{result.seconds:g} s of recording, medians of {result.repeat}, MB: largest; "
        "own: CPU without start and imports; read to write: time of the stages, ns/slot",
    ]
    rows = aligned([_HEAD, *map(_row_cells, result.rows)], _LEFT)
    parts = [head, rows]
    if result.ratios:
        parts.append(aligned([_RATIO_HEAD, *map(_ratio_cells, result.ratios)], _LEFT_OF_RATIOS))
    if result.changes:
        parts.append(aligned([_CHANGE_HEAD, *_changes(result.changes)], _LEFT))
    if result.notes:
        parts.append([f"note: {note}" for note in result.notes])
    return [one_line(line) for part in parts for line in (*part, "")][:-1]


_MACHINE = ("cpu", "cores", "memory_mb", "system", "load")
_RATIO_HEAD = ("case", "program", "to", "of", "ratio", "least", "most")
_CHANGE_HEAD = ("case", "program", *(f"{of}, now/before" for of in OFS))


def _row_cells(row: Row) -> tuple[str, ...]:
    runs, counted = row.runs, row.counted
    cpu_s = median(run.cpu_s for run in runs)
    wall_s = median(run.wall_s for run in runs)
    stages = [
        f"{median(run.stages_s[name] for run in runs) * NS_PER_S / counted.slots:.2f}"
        if runs[0].stages_s and counted.slots
        else ""
        for name in _STAGES
    ]
    return (
        row.case,
        row.program,
        f"{cpu_s:.3f}",
        f"{median(run.own_cpu_s for run in runs):.3f}",
        f"{wall_s:.3f}",
        f"{cpu_s * NS_PER_S / counted.slots:.2f}" if counted.slots else "",
        f"{counted.recorded_s / wall_s:.1f}" if wall_s > 0 else "",
        f"{max(run.rss_mb for run in runs):.0f}",
        *stages,
    )


def _ratio_cells(ratio: Ratio) -> tuple[str, ...]:
    figures = (median(ratio.values), min(ratio.values), max(ratio.values))
    return (
        ratio.case,
        ratio.program,
        ratio.to,
        ratio.of,
        *(f"{figure:.2f}" for figure in figures),
    )


def _changes(found: Sequence[Changed]) -> Iterator[tuple[str, ...]]:
    """A line a program."""
    by_program: dict[tuple[str, str], dict[str, float]] = {}
    for one in found:
        by_program.setdefault((one.case, one.program), {})[one.of] = one.ratio
    for (case, program), ratio in by_program.items():
        cells = (f"{ratio[of]:.2f}" if of in ratio else "" for of in OFS)
        yield (case, program, *cells)


def aligned(rows: Sequence[Sequence[str]], left: int) -> list[str]:
    """Rows as lines; the first cells start, the others end below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place < left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
