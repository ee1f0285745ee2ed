"""scans.csv: every damage is found, and named with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.builders.verify_outputs import PERIOD_NS, Case, cases, check_case, removed, row, text

TABLE: dict[str, Case] = {
    "no table": (removed("scans.csv"), "table", "scans.csv"),
    "points of a line": (row(1, "points", lambda n: n + 1), "table", "line 3 points"),
    "stamp of a line": (row(1, "last_stamp_ns", lambda n: n - 1), "table", "last_stamp_ns"),
    "stamp past its line": (row(1, "last_stamp_ns", lambda n: n + PERIOD_NS), "columns", "line 3"),
    "start of a line": (row(1, "start_ns", lambda n: n + 1), "grid", "line 3 start_ns"),
    "end of a line": (row(2, "end_ns", lambda n: n + 1), "grid", "line 4 end_ns"),
    "columns of a line": (row(1, "columns", lambda n: n + 1), "table", "line 3 columns"),
    "columns of a sensor": (row(1, "columns_left", lambda n: n - 1), "table", "columns_left"),
    "gap of a line": (row(1, "max_gap_ns_right", lambda n: n + 1), "table", "max_gap_ns_right"),
    "gap over windows": (row(2, "max_gap_ns_left", lambda n: n - 1), "table", "line 4 max_gap_ns"),
    "fill of a line": (row(1, "fill_left", 0.5), "table", "line 3 fill_left"),
    "fill of no whole number": (row(1, "fill_right", 0.999), "table", "line 3 fill"),
    "fill above 1": (row(1, "fill_right", 1.5), "table", "line 3 fill"),
    "fill of 0": (row(1, "fill_right", 0), "table", "line 3 fill"),
    "fill in words": (row(1, "fill_left", "full"), "table", "scans.csv fill"),
    "line out of order": (row(1, "index", 7), "table", "line 4 index and slice"),
    "no number in a line": (row(1, "points", "many"), "table", "line 3 points"),
    "word in a line": (row(1, "complete", "yes"), "table", "line 3 complete"),
    "header of the table": (text("scans.csv", "index,", "no,"), "table", "scans.csv line 1"),
    "line cut off": (text("scans.csv", ",true", ""), "table", "scans.csv"),
}


@pytest.mark.parametrize(("kind", "case"), cases({"npz": TABLE}))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)
