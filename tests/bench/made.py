"""Measurements that nobody made, for tests of tables and documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mlbatch.bench.results import OURS, Counted, Json, Result, Row, Run

STAGES = {"read": 0.1, "decode": 0.4, "merge": 0.2, "write": 0.0}


def run(
    cpu_s: float,
    own_cpu_s: float = 0.5,
    wall_s: float = 2.0,
    counted: Counted | None = None,
    stages_s: Mapping[str, float] | None = None,
) -> Run:
    """A run of a million slots in 10 s."""
    counted = Counted(1_000_000, 800_000, 100, 10.0, 4_000_000) if counted is None else counted
    return Run(cpu_s, wall_s, 80.0, own_cpu_s, counted, {} if stages_s is None else stages_s)


def row(program: str, runs: Sequence[Run], role: str = OURS, base: str = "") -> Row:
    """A program of the case `dual-4`."""
    return Row("dual-4", program, role, base, runs[0].counted, tuple(runs))


def result(*rows: Row) -> Result:
    """These rows on a machine that nobody has."""
    machine: dict[str, Json] = {
        "cpu": "Abacus",
        "cores": 2,
        "memory_mb": 1000,
        "system": "S",
        "load": 0.5,
    }
    machine |= {"mlbatch": "0.1.0", "python": "3.11.7"}
    return Result("2026-01-02T03:04:05Z", machine, 10.0, 3, rows, (), ())
