"""The table for people."""

from __future__ import annotations

from dataclasses import replace

from mlbatch.bench.results import CPU, MEMORY, Changed, Counted, Ratio, aligned, lines
from tests.bench.made import STAGES, result, row, run


def test_a_line_holds_medians_in_the_units_of_the_head() -> None:
    runs = [run(cpu_s, stages_s=STAGES) for cpu_s in (1.0, 5.0, 2.0)]
    told = lines(result(row("numpy", runs)))
    head, line = (one.split("  ") for one in told[4:6])
    cells = dict(zip(filter(None, head), filter(None, line), strict=True))
    assert {name.strip(): cell.strip() for name, cell in cells.items()} == {
        **{"case": "dual-4", "program": "numpy", "CPU s": "2.000", "own s": "0.500"},
        # 2 s for a million slots; 10 s recorded in 2 s.
        **{"time s": "2.000", "ns/slot": "2000.00", "x real": "5.0", "MB": "80"},
        **{"read": "100.00", "decode": "400.00", "merge": "200.00", "write": "0.00"},
    }


def test_the_machine_and_the_date_come_first() -> None:
    told = lines(result(row("numpy", [run(1.0)])))
    assert told[0] == "Abacus, 2 cores, 1000 MB, S"
    assert told[1] == "2026-01-02T03:04:05Z, load 0.5, mlbatch 0.1.0, python 3.11.7"
    assert told[2].startswith("10 s of recording, medians of 3, ")


def test_programs_that_count_nothing_leave_cells_empty() -> None:
    told = lines(result(row("start", [run(1.0, counted=Counted())])))
    assert told[5].split() == ["dual-4", "start", "1.000", "0.500", "2.000", "0.0", "80"]


def test_ratios_changes_and_notes_follow() -> None:
    told = lines(
        replace(
            result(row("numpy", [run(1.0)])),
            ratios=(Ratio("dual-4", "numpy", "sdk", CPU, (0.5, 0.25, 4.0)),),
            changes=(
                Changed("dual-4", "numpy", CPU, 4.0, 1.0),
                Changed("dual-4", "numpy", MEMORY, 50.0, 60.0),
            ),
            notes=("no peers",),
        )
    )
    assert "dual-4  numpy    sdk  CPU   0.50   0.25  4.00" in told
    changed = next(line for line in told if "0.25 " in line and "sdk" not in line)
    assert changed.split() == ["dual-4", "numpy", "0.25", "1.20"]
    assert told[-1] == "note: no peers"


def test_numbers_end_below_each_other() -> None:
    assert aligned([("a", "b"), ("long", "1"), ("x", "22")], 1) == [
        "a      b",
        "long   1",
        "x     22",
    ]


def test_what_a_terminal_obeys_is_not_printed() -> None:
    told = lines(replace(result(row("numpy", [run(1.0)])), notes=("\x1b[31m",)))
    assert "\x1b" not in "".join(told)
