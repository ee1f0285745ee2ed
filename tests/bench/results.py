"""Results of a benchmark: values, comparisons, the JSON document (`mlbatch.bench/1`), tables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Final, TypeAlias

from mlbatch.errors import one_line
from mlbatch.units import NS_PER_S
from tests.bench.measure import BenchError

Json: TypeAlias = bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"] | None

SCHEMA: Final = "mlbatch.bench/1"
STAGES: Final = ("read", "decode", "merge", "write")

# Roles of programs.
OURS: Final = "mlbatch"
FLOOR: Final = "floor"
PEER: Final = "peer"

# Names of floors, and of the conversion without output.
COPY: Final = "memory copy"
WRITE: Final = "plain write"
LIBRARY: Final = "mcap library"
START: Final = "python with numpy"
DRY_RUN: Final = "dry run"

# Figures that are compared.
CPU: Final = "CPU"
OWN_CPU: Final = "CPU without start"
WALL: Final = "time"
MEMORY: Final = "peak memory"
WRITING: Final = "CPU above the dry run"

# Field of Run, and of the document, by figure.
_FIELDS: Final[Mapping[str, str]] = {
    CPU: "cpu_s",
    OWN_CPU: "own_cpu_s",
    WALL: "wall_s",
    MEMORY: "rss_mb",
}
_PEER_FIGURES: Final = (CPU, OWN_CPU)
_BASE_FIGURES: Final = (CPU, WALL)
_FLOOR_FIGURE: Final[Mapping[str, str]] = {START: MEMORY, COPY: OWN_CPU, WRITE: WALL}

# -- values ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Workload:
    """What a program processed; equal in every run."""

    # (channel, return) positions.
    slots: int = 0
    # Valid returns.
    points: int = 0
    # Scans, sweeps or messages.
    scans: int = 0
    # Length of the recording.
    recorded_s: float = 0.0
    read_bytes: int = 0
    written_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a program.

    cpu_s, wall_s, rss_mb: of the whole process; own_cpu_s: without start and imports; stages_s:
    time by stage (STAGES), from the report of a conversion.
    """

    cpu_s: float
    wall_s: float
    rss_mb: float
    own_cpu_s: float
    workload: Workload
    stages_s: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Row:
    """A program of a case with all its runs; base: the program to compare it with, or empty."""

    case: str
    program: str
    role: str
    base: str
    workload: Workload
    runs: tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class Ratio:
    """A program over another one (`to`) of its case in one figure (`of`), run by run."""

    case: str
    program: str
    to: str
    of: str
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Change:
    """Median of a figure (`of`) in an earlier document and now."""

    case: str
    program: str
    of: str
    before: float
    now: float

    @property
    def ratio(self) -> float:
        """Now over before; below 1: less."""
        return self.now / self.before


@dataclass(frozen=True, slots=True)
class Result:
    """A whole benchmark.

    machine: texts and numbers by name; notes: what was not measured, with reasons; failed:
    conversions that ended with an error.
    """

    date: str
    machine: Mapping[str, Json]
    seconds: float
    repeat: int
    rows: tuple[Row, ...]
    ratios: tuple[Ratio, ...]
    notes: tuple[str, ...]
    failed: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()


# -- comparisons ----------------------------------------------------------------------------------


def ratios(rows: Sequence[Row]) -> Iterator[Ratio]:
    """All comparisons within the cases, in the order of the rows.

    Runs are compared in pairs, so that a slow minute of the machine slows both sides.
    """
    for row in rows:
        if row.role == OURS and row.program != DRY_RUN:
            others = [other for other in rows if other.case == row.case and other is not row]
            for other in others:
                yield from _between(row, other, others)


def _between(row: Row, other: Row, others: Sequence[Row]) -> Iterator[Ratio]:
    """Comparisons of one program with another one of its case."""
    writes = row.workload.written_bytes > 0
    if other.role == PEER and other.workload.read_bytes == row.workload.read_bytes:
        yield from (_ratio(row, other, of) for of in _PEER_FIGURES)
    elif other.role == FLOOR and other.program == LIBRARY:
        dry = next((one for one in others if one.program == DRY_RUN), None)
        if writes and dry is not None:
            yield _writing_ratio(row, dry, other)
    elif other.role == FLOOR and (writes or other.program != WRITE):
        yield _ratio(row, other, _FLOOR_FIGURE[other.program])
    elif other.program == row.base:
        yield from (_ratio(row, other, of) for of in _BASE_FIGURES)


def _figures(row: Row, of: str) -> list[float]:
    """One figure of all runs."""
    return [getattr(run, _FIELDS[of]) for run in row.runs]


def _ratio(row: Row, other: Row, of: str) -> Ratio:
    pairs = zip(_figures(row, of), _figures(other, of), strict=True)
    values = tuple(value / max(reference, 1e-9) for value, reference in pairs)
    return Ratio(row.case, row.program, other.program, of, values)


def _writing_ratio(row: Row, dry: Row, library: Row) -> Ratio:
    """CPU of an output above that of the dry run, over that of a library that only writes."""
    figures = zip(*(_figures(one, OWN_CPU) for one in (row, dry, library)), strict=True)
    values = tuple((ours - dry_s) / max(library_s, 1e-9) for ours, dry_s, library_s in figures)
    return Ratio(row.case, row.program, library.program, WRITING, values)


def changes(
    rows: Sequence[Row], before: Mapping[tuple[str, str], Mapping[str, Sequence[float]]]
) -> Iterator[Change]:
    """Compare medians with those of an earlier document, for programs that are in both."""
    for row in rows:
        earlier = before.get((row.case, row.program))
        if earlier is None:
            continue
        for of, name in _FIELDS.items():
            if earlier[name] and median(earlier[name]) > 0:
                now = median(_figures(row, of))
                yield Change(row.case, row.program, of, median(earlier[name]), now)


# -- JSON -----------------------------------------------------------------------------------------


def document(result: Result) -> dict[str, Json]:
    """The result as a JSON document."""
    return {
        "schema": SCHEMA,
        "date": result.date,
        "machine": result.machine,
        "seconds": result.seconds,
        "repeat": result.repeat,
        "rows": [_row_document(row) for row in result.rows],
        "ratios": [{**asdict(one), "median": median(one.values)} for one in result.ratios],
        "changes": [{**asdict(one), "ratio": one.ratio} for one in result.changes],
        "notes": list(result.notes),
        "failed": list(result.failed),
    }


_RUN_FIELDS: Final = ("cpu_s", "wall_s", "rss_mb", "own_cpu_s")


def _row_document(row: Row) -> dict[str, Json]:
    return {
        "case": row.case,
        "program": row.program,
        "role": row.role,
        "base": row.base,
        **asdict(row.workload),
        **{name: [getattr(run, name) for run in row.runs] for name in _RUN_FIELDS},
        "stages_s": {
            name: [run.stages_s.get(name, 0.0) for run in row.runs] for name in row.runs[0].stages_s
        },
    }


def read_document(path: Path) -> dict[tuple[str, str], dict[str, list[float]]]:
    """Figures of all runs in an earlier document, by case and program."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["schema"] != SCHEMA:
            raise BenchError(
                f"{path}: expected schema {SCHEMA}, found {found['schema']}; "
                "measure again with this version"
            )
        return {
            (str(row["case"]), str(row["program"])): {
                name: [float(value) for value in row[name]] for name in _RUN_FIELDS
            }
            for row in found["rows"]
        }
    except OSError as err:
        raise BenchError(
            f"{path}: expected an earlier result, found {err.strerror}; check the path"
        ) from err
    except (ValueError, KeyError, TypeError) as err:
        raise BenchError(
            f"{path}: expected the output of `python -m tests.bench --json`, found something else "
            f"({type(err).__name__}: {err}); give another file"
        ) from err


# -- text -----------------------------------------------------------------------------------------

_ROW_HEAD: Final = ("case", "program", "CPU s", "own s", "time s", "ns/slot", "x real", "MB")
_RATIO_HEAD: Final = ("case", "program", "to", "of", "ratio", "least", "most")
_CHANGE_HEAD: Final = ("case", "program", *(f"{of}, now/before" for of in _FIELDS))
# Cells aligned to the left, the others to the right.
_LEFT_CELLS: Final = 2
_LEFT_RATIO_CELLS: Final = 4
_MACHINE_LINE: Final = ("cpu", "cpu_flags", "cores", "memory_mb", "system", "load")


def lines(result: Result) -> list[str]:
    """The result as text: machine, programs, ratios, changes, notes."""
    machine = result.machine
    versions = (f"{name} {value}" for name, value in machine.items() if name not in _MACHINE_LINE)
    head = [
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_mb']} MB, "
        f"{machine['system']}",
        f"vector instructions: {machine['cpu_flags'] or 'unknown'}",
        f"{result.date}, load {machine['load']:.1f}, {', '.join(versions)}",
        f"{result.seconds:g} s of recording, medians of {result.repeat}, MB: largest; "
        "own: CPU without start and imports; read to write: time of the stages, ns/slot",
    ]
    rows = aligned([(*_ROW_HEAD, *STAGES), *map(_row_cells, result.rows)], _LEFT_CELLS)
    parts = [head, rows]
    if result.ratios:
        table = [_RATIO_HEAD, *map(_ratio_cells, result.ratios)]
        parts.append(aligned(table, _LEFT_RATIO_CELLS))
    if result.changes:
        parts.append(aligned([_CHANGE_HEAD, *_change_rows(result.changes)], _LEFT_CELLS))
    if result.notes:
        parts.append([f"note: {note}" for note in result.notes])
    return [one_line(line) for part in parts for line in (*part, "")][:-1]


def _row_cells(row: Row) -> tuple[str, ...]:
    workload = row.workload
    cpu_s = median(_figures(row, CPU))
    wall_s = median(_figures(row, WALL))
    has_stages = bool(row.runs[0].stages_s)
    stages_s = [median(run.stages_s[name] for run in row.runs) for name in STAGES if has_stages]
    return (
        row.case,
        row.program,
        f"{cpu_s:.3f}",
        f"{median(_figures(row, OWN_CPU)):.3f}",
        f"{wall_s:.3f}",
        _ns_per_slot(cpu_s, workload),
        f"{workload.recorded_s / wall_s:.1f}" if wall_s > 0 else "",
        f"{max(_figures(row, MEMORY)):.0f}",
        *([_ns_per_slot(stage_s, workload) for stage_s in stages_s] or [""] * len(STAGES)),
    )


def _ns_per_slot(time_s: float, workload: Workload) -> str:
    return f"{time_s * NS_PER_S / workload.slots:.2f}" if workload.slots else ""


def _ratio_cells(ratio: Ratio) -> tuple[str, ...]:
    return (
        ratio.case,
        ratio.program,
        ratio.to,
        ratio.of,
        f"{median(ratio.values):.2f}",
        f"{min(ratio.values):.2f}",
        f"{max(ratio.values):.2f}",
    )


def _change_rows(changes: Sequence[Change]) -> Iterator[tuple[str, ...]]:
    """One row per program."""
    by_program: dict[tuple[str, str], dict[str, float]] = {}
    for change in changes:
        ratio_by_figure = by_program.setdefault((change.case, change.program), {})
        ratio_by_figure[change.of] = change.ratio
    for (case, program), ratio_by_figure in by_program.items():
        cells = (f"{ratio_by_figure[of]:.2f}" if of in ratio_by_figure else "" for of in _FIELDS)
        yield (case, program, *cells)


def aligned(rows: Sequence[Sequence[str]], left: int) -> list[str]:
    """Rows as lines; the first `left` cells are aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
