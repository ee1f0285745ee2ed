"""`mlbatch verify` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mlbatch.cli.verify import SHOWN
from mlbatch.verification import CHECKS
from tests.builders.run import ROOT, command
from tests.builders.verify_outputs import Arrays, arrays, copied, made
from tests.verification.edits import edit_of


def test_a_clean_output(tmp_path: Path) -> None:
    result = command("verify", made("npz"))
    assert (result.code, result.err) == (0, "")
    first, head, *rows = result.out.splitlines()
    assert first.startswith(f"{made('npz')}: npz, 4 scans, ")
    assert head.split() == ["check", "checked", "outcome", "not", "checkable"]
    assert [row.split()[0] for row in rows] == list(CHECKS)
    assert "not checkable" in next(row for row in rows if row.startswith("imu"))


def test_a_violation_names_its_place(tmp_path: Path) -> None:
    path = copied("npz", tmp_path)
    edit_of("add 000001.npz start_ns () 1")(path)
    result = command("verify", path)
    assert result.code == 1
    values = "expected 1777881600200000000, found 1777881600200000001"
    assert f"grid: 000001.npz start_ns: {values}" in result.out
    (line,) = result.err.splitlines()
    assert line.startswith("mlbatch: error: ")
    assert str(path) in line


def test_many_violations_are_counted(tmp_path: Path) -> None:
    path = copied("npz-slices", tmp_path)

    def damage(found: Arrays) -> None:
        found["start_ns"] += 1
        found["lidar_id"] = np.full_like(found["lidar_id"], 9)
        found["return_type"] = np.full_like(found["return_type"], 9)

    for name in sorted(path.glob("*.npz")):
        arrays(name.name, damage)(path)
    result = command("verify", path)
    broken = [line for line in result.out.splitlines() if ": expected " in line]
    assert len(broken) == SHOWN
    assert result.out.splitlines()[-1].startswith("and ")
    found = json.loads(command("verify", path, "--json").out)
    counted = sum(check["violations"] for check in found["checks"])
    assert counted == len(found["violations"]) > SHOWN
    assert result.out.splitlines()[-1] == f"and {counted - SHOWN} more"


def test_json(tmp_path: Path) -> None:
    result = command("verify", made("scans.mcap"), "--json")
    found = json.loads(result.out)
    assert result.code == 0
    assert found["schema"] == "mlbatch.verdict/2"
    assert (found["ok"], found["format"], found["scans"]) == (True, "mcap, standard", 4)
    assert found["columns"] is None
    assert [check["name"] for check in found["checks"]] == list(CHECKS)
    by_name = {check["name"]: check for check in found["checks"]}
    assert by_name["grid"]["outcome"] == "ok"
    assert by_name["duplicates"]["outcome"] == "not checkable"
    assert "column" in by_name["duplicates"]["limit"]


def test_the_page_names_every_check() -> None:
    page = (ROOT / "docs" / "verify.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    named = [name.strip(" `") for row in rows for name in row.split(",")]
    assert named == list(CHECKS)
