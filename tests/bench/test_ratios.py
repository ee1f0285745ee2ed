"""Ratios by hand."""

from __future__ import annotations

import pytest

from mlbatch.bench.results import (
    COPY,
    CPU,
    DRY_RUN,
    FLOOR,
    LIBRARY,
    MEMORY,
    OWN_CPU,
    PEER,
    START,
    WALL,
    WRITE,
    WRITING,
    Counted,
    Row,
    changes,
    ratios,
)
from tests.bench.made import row, run

WRITTEN = Counted(1_000_000, 800_000, 100, 10.0, 4_000_000, 20_000_000)
FLOORED = Counted(1_000_000, 800_000, 100, 10.0, 0, 20_000_000)


def found(*rows: Row) -> dict[tuple[str, str, str], tuple[float, ...]]:
    """Ratios by program, the other, and what is compared."""
    return {(one.program, one.to, one.of): one.values for one in ratios(rows)}


def test_runs_are_compared_one_by_one() -> None:
    ours = row("numpy", [run(1.0, 0.5), run(3.0, 2.0)])
    theirs = row("sdk", [run(2.0, 2.0), run(3.0, 1.0)], PEER)
    assert found(ours, theirs) == {
        ("numpy", "sdk", CPU): (0.5, 1.0),
        ("numpy", "sdk", OWN_CPU): (0.25, 2.0),
    }


def test_a_peer_on_another_recording_is_not_compared() -> None:
    other = Counted(1_000_000, 800_000, 100, 10.0, 5_000_000)
    ours = row("numpy, fragments", [run(1.0, counted=other)], base="numpy")
    assert found(ours, row("sdk", [run(2.0)], PEER)) == {}


def test_what_extends_another_program_is_compared_with_it() -> None:
    plain = row("numpy", [run(2.0, wall_s=4.0)])
    fragments = row("numpy, fragments", [run(2.5, wall_s=4.0)], base="numpy")
    assert found(plain, fragments) == {
        ("numpy, fragments", "numpy", CPU): (1.25,),
        ("numpy, fragments", "numpy", WALL): (1.0,),
    }


def test_floors_of_a_dry_run() -> None:
    ours = row("numpy", [run(1.0, 0.6)])
    copied = row(COPY, [run(9.0, 0.1, counted=FLOORED)], FLOOR)
    started = row(START, [run(9.0, 0.1, counted=FLOORED)], FLOOR)
    values = found(ours, copied, started)
    assert values == {
        ("numpy", COPY, OWN_CPU): (pytest.approx(6.0),),
        ("numpy", START, MEMORY): (1.0,),
    }


def test_floors_of_an_output() -> None:
    dry = row(DRY_RUN, [run(1.0, 0.6)])
    ours = row("mcap", [run(2.0, 1.0, wall_s=3.0, counted=WRITTEN)], base=DRY_RUN)
    written = row(WRITE, [run(9.0, 0.1, wall_s=2.0, counted=FLOORED)], FLOOR)
    library = row(LIBRARY, [run(9.0, 1.6, counted=FLOORED)], FLOOR)
    assert found(dry, ours, written, library) == {
        ("mcap", DRY_RUN, CPU): (2.0,),
        ("mcap", DRY_RUN, WALL): (1.5,),
        ("mcap", WRITE, WALL): (1.5,),
        # 1.0 - 0.6 of 1.6 s.
        ("mcap", LIBRARY, WRITING): (pytest.approx(0.25),),
    }


def test_changes_are_ratios_of_medians() -> None:
    rows = [row("numpy", [run(1.0), run(2.0), run(9.0)]), row("numba", [run(1.0)])]
    lists = {"cpu_s": [8.0, 4.0, 3.0], "own_cpu_s": [0.5], "wall_s": [1.0], "rss_mb": [0.0]}
    told = {one.of: one for one in changes(rows, {("dual-4", "numpy"): lists})}
    # No memory was told before.
    assert set(told) == {CPU, OWN_CPU, WALL}
    assert (told[CPU].before, told[CPU].now, told[CPU].ratio) == (4.0, 2.0, 0.5)
    assert told[WALL].ratio == 2.0
