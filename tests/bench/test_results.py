"""Comparisons by hand, the document, reading an earlier one, and the table."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from tests.bench.measure import BenchError
from tests.bench.results import (
    COPY,
    CPU,
    DRY_RUN,
    FLOOR,
    LIBRARY,
    MEMORY,
    OURS,
    OWN_CPU,
    PEER,
    START,
    WALL,
    WRITE,
    WRITING,
    Change,
    Json,
    Ratio,
    Result,
    Row,
    Run,
    Workload,
    changes,
    document,
    lines,
    ratios,
    read_document,
)

STAGES = {"read": 0.1, "decode": 0.4, "merge": 0.2, "write": 0.0}
READ = Workload(1_000_000, 800_000, 100, 10.0, 4_000_000)
WRITTEN = replace(READ, written_bytes=20_000_000)
FLOORED = replace(WRITTEN, read_bytes=0)
MACHINE: dict[str, Json] = {
    "cpu": "Abacus",
    "cpu_flags": "sse2 avx",
    "cores": 2,
    "memory_mb": 1000,
    "system": "S",
    "load": 0.5,
    "mlbatch": "0.1.0",
    "python": "3.11.7",
}


def run(
    cpu_s: float,
    own_cpu_s: float = 0.5,
    wall_s: float = 2.0,
    workload: Workload = READ,
    stages_s: Mapping[str, float] | None = None,
) -> Run:
    """A run of a million slots in 10 s."""
    return Run(cpu_s, wall_s, 80.0, own_cpu_s, workload, stages_s or {})


def row(program: str, runs: Sequence[Run], role: str = OURS, base: str = "") -> Row:
    """A program of the case `dual-4`."""
    return Row("dual-4", program, role, base, runs[0].workload, tuple(runs))


def result(*rows: Row) -> Result:
    """A result with these rows."""
    return Result("2026-01-02T03:04:05Z", MACHINE, 10.0, 3, rows, (), ())


# -- comparisons ----------------------------------------------------------------------------------


OTHER = replace(READ, read_bytes=5_000_000)
PLAIN = row("numpy", [run(1.0, 0.6)])
DRY = row(DRY_RUN, [run(1.0, 0.6)])
WRITES = row("mcap", [run(2.0, 1.0, wall_s=3.0, workload=WRITTEN)], base=DRY_RUN)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        pytest.param(
            [
                row("numpy", [run(1.0, 0.5), run(3.0, 2.0)]),
                row("sdk", [run(2.0, 2.0), run(3.0, 1.0)], PEER),
            ],
            {("numpy", "sdk", CPU): (0.5, 1.0), ("numpy", "sdk", OWN_CPU): (0.25, 2.0)},
            id="runs in pairs",
        ),
        pytest.param(
            [row("numpy", [run(1.0, workload=OTHER)]), row("sdk", [run(2.0)], PEER)],
            {},
            id="a peer on another recording",
        ),
        pytest.param(
            [PLAIN, row("fragments", [run(1.25, wall_s=2.0)], base="numpy")],
            {("fragments", "numpy", CPU): (1.25,), ("fragments", "numpy", WALL): (1.0,)},
            id="a base",
        ),
        pytest.param(
            [
                PLAIN,
                row(COPY, [run(9.0, 0.1, workload=FLOORED)], FLOOR),
                row(START, [run(9.0, 0.1, workload=FLOORED)], FLOOR),
            ],
            {("numpy", COPY, OWN_CPU): pytest.approx((6.0,)), ("numpy", START, MEMORY): (1.0,)},
            id="floors of a dry run",
        ),
        pytest.param(
            [
                DRY,
                WRITES,
                row(WRITE, [run(9.0, 0.1, wall_s=2.0, workload=FLOORED)], FLOOR),
                row(LIBRARY, [run(9.0, 1.6, workload=FLOORED)], FLOOR),
            ],
            {
                ("mcap", DRY_RUN, CPU): (2.0,),
                ("mcap", DRY_RUN, WALL): (1.5,),
                ("mcap", WRITE, WALL): (1.5,),
                # (1.0 - 0.6) s of 1.6 s.
                ("mcap", LIBRARY, WRITING): pytest.approx((0.25,)),
            },
            id="floors of an output",
        ),
    ],
)
def test_comparisons(rows: list[Row], expected: dict[tuple[str, str, str], object]) -> None:
    assert {(one.program, one.to, one.of): one.values for one in ratios(rows)} == expected


def test_changes_are_ratios_of_medians() -> None:
    rows = [row("numpy", [run(1.0), run(2.0), run(9.0)]), row("native", [run(1.0)])]
    lists = {"cpu_s": [8.0, 4.0, 3.0], "own_cpu_s": [0.5], "wall_s": [1.0], "rss_mb": [0.0]}
    found = {one.of: one for one in changes(rows, {("dual-4", "numpy"): lists})}
    # The earlier document has no memory.
    assert set(found) == {CPU, OWN_CPU, WALL}
    assert (found[CPU].before, found[CPU].now, found[CPU].ratio) == (4.0, 2.0, 0.5)
    assert found[WALL].ratio == 2.0


# -- document -------------------------------------------------------------------------------------


def test_a_document_holds_every_run_and_is_read_back(tmp_path: Path) -> None:
    made = replace(
        result(row("numpy", [run(1.0, stages_s=STAGES), run(2.0)])),
        ratios=(Ratio("dual-4", "numpy", "sdk", CPU, (0.5, 0.75)),),
        changes=(Change("dual-4", "numpy", CPU, 4.0, 1.0),),
    )
    path = tmp_path / "old.json"
    path.write_text(json.dumps(document(made)))
    found = json.loads(path.read_text())
    head = ["schema", "date", "machine", "seconds", "repeat"]
    assert list(found) == [*head, "rows", "ratios", "changes", "notes", "failed"]
    assert (found["schema"], found["machine"]["cpu"]) == ("mlbatch.bench/1", "Abacus")
    (only,) = found["rows"]
    assert (only["case"], only["program"], only["cpu_s"]) == ("dual-4", "numpy", [1.0, 2.0])
    assert (only["slots"], only["recorded_s"], only["read_bytes"]) == (1_000_000, 10.0, 4_000_000)
    assert only["stages_s"]["decode"] == [0.4, 0.0]
    pair = {"case": "dual-4", "program": "numpy", "to": "sdk", "of": CPU}
    assert found["ratios"] == [{**pair, "values": [0.5, 0.75], "median": 0.625}]
    assert found["changes"][0]["ratio"] == 0.25
    figures = read_document(path)
    assert list(figures) == [("dual-4", "numpy")]
    assert figures["dual-4", "numpy"]["cpu_s"] == [1.0, 2.0]
    assert figures["dual-4", "numpy"]["rss_mb"] == [80.0, 80.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the output of `python -m tests.bench --json`"),
        ("[]", "expected the output of `python -m tests.bench --json`"),
        ("{}", "KeyError"),
        (
            '{"schema": "mlbatch.bench/9", "rows": []}',
            "expected schema mlbatch.bench/1, found mlbatch.bench/9; measure again with this",
        ),
        ('{"schema": "mlbatch.bench/1", "rows": [1]}', "TypeError"),
        ('{"schema": "mlbatch.bench/1", "rows": [{"case": "a"}]}', "KeyError"),
        (None, "expected an earlier result, found No such file or directory; check the path"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "old.json"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(BenchError, match="expected") as caught:
        read_document(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


# -- table ----------------------------------------------------------------------------------------


def test_a_line_has_medians_in_the_units_of_the_head() -> None:
    runs = [run(cpu_s, stages_s=STAGES) for cpu_s in (1.0, 5.0, 2.0)]
    head, line = (one.split("  ") for one in lines(result(row("numpy", runs)))[5:7])
    cells = dict(zip(filter(None, head), filter(None, line), strict=True))
    assert {name.strip(): cell.strip() for name, cell in cells.items()} == {
        "case": "dual-4",
        "program": "numpy",
        "CPU s": "2.000",
        "own s": "0.500",
        "time s": "2.000",
        # 2 s for a million slots.
        "ns/slot": "2000.00",
        # 10 s recorded in 2 s.
        "x real": "5.0",
        "MB": "80",
        "read": "100.00",
        "decode": "400.00",
        "merge": "200.00",
        "write": "0.00",
    }


def test_programs_without_counts_have_empty_cells() -> None:
    found = lines(result(row("start", [run(1.0, workload=Workload())])))
    assert found[6].split() == ["dual-4", "start", "1.000", "0.500", "2.000", "0.0", "80"]


def test_machine_first_then_ratios_changes_and_notes() -> None:
    found = lines(
        replace(
            result(row("numpy", [run(1.0)])),
            ratios=(Ratio("dual-4", "numpy", "sdk", CPU, (0.5, 0.25, 4.0)),),
            changes=(
                Change("dual-4", "numpy", CPU, 4.0, 1.0),
                Change("dual-4", "numpy", MEMORY, 50.0, 60.0),
            ),
            notes=("\x1b[31mno peers",),
        )
    )
    assert found[0] == "Abacus, 2 cores, 1000 MB, S"
    assert found[1] == "vector instructions: sse2 avx"
    assert found[2] == "2026-01-02T03:04:05Z, load 0.5, mlbatch 0.1.0, python 3.11.7"
    assert found[3].startswith("10 s of recording, medians of 3, ")
    assert "dual-4  numpy    sdk  CPU   0.50   0.25  4.00" in found
    changed = next(line for line in found if "0.25 " in line and "sdk" not in line)
    assert changed.split() == ["dual-4", "numpy", "0.25", "1.20"]
    # No escape sequences.
    assert found[-1] == "note: \\x1b[31mno peers"
