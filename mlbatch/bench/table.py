"""A result as text: a line a program, units in the head."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median

from mlbatch.bench.ratios import OFS
from mlbatch.bench.results import Changed, Ratio, Result, Row
from mlbatch.errors import one_line
from mlbatch.units import NS_PER_S

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
    rows = aligned([_HEAD, *map(_row, result.rows)], _LEFT)
    parts = [head, rows]
    if result.ratios:
        parts.append(aligned([_RATIO_HEAD, *map(_ratio, result.ratios)], _LEFT_OF_RATIOS))
    if result.changes:
        parts.append(aligned([_CHANGE_HEAD, *_changes(result.changes)], _LEFT))
    if result.notes:
        parts.append([f"note: {note}" for note in result.notes])
    return [one_line(line) for part in parts for line in (*part, "")][:-1]


_MACHINE = ("cpu", "cores", "memory_mb", "system", "load")
_RATIO_HEAD = ("case", "program", "to", "of", "ratio", "least", "most")
_CHANGE_HEAD = ("case", "program", *(f"{of}, now/before" for of in OFS))


def _row(row: Row) -> tuple[str, ...]:
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


def _ratio(ratio: Ratio) -> tuple[str, ...]:
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
