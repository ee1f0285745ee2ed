"""What was measured, as values and as a document (schema `mlbatch.bench/1`)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import TypeAlias

from mlbatch.bench.measure import BenchError

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
