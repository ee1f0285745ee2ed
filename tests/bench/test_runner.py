"""The order of runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench import runner
from tests.bench.cases import Case, Conversion
from tests.bench.results import Run, Workload


def test_programs_alternate_in_both_directions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []

    def record(session: runner.BenchSession, conversion: Conversion) -> Run:
        order.append(conversion.name)
        return Run(1.0, 1.0, 1.0, 1.0, Workload(slots=1))

    monkeypatch.setattr(runner.BenchSession, "_convert", record)
    pair = (Conversion("a", "three-vlp16"), Conversion("b", "three-vlp16"))
    case = Case("small", ("three-vlp16",), "", (), pair)
    settings = runner.Settings((case,), 1.0, 3, keep=tmp_path)
    assert [row.program for row in runner.bench(settings).rows] == ["a", "b"]
    # After runs that are not measured, which compile.
    assert order[2:] == ["a", "b", "b", "a", "a", "b"]
    assert sorted(order[:2]) == ["a", "b"]
