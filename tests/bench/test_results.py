"""The document of a benchmark, and reading an earlier one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.bench.measure import BenchError
from mlbatch.bench.results import CPU, Changed, Ratio, document, read_document
from tests.bench.made import STAGES, result, row, run

KEYS = ["schema", "date", "machine", "seconds", "repeat"]
LISTS = ["rows", "ratios", "changes", "notes", "failed"]


def test_the_document_holds_every_run() -> None:
    told = json.loads(
        json.dumps(document(result(row("numpy", [run(1.0, stages_s=STAGES), run(2.0)]))))
    )
    assert list(told) == [*KEYS, *LISTS]
    assert told["schema"] == "mlbatch.bench/1"
    assert told["machine"]["cpu"] == "Abacus"
    (only,) = told["rows"]
    assert (only["case"], only["program"], only["cpu_s"]) == ("dual-4", "numpy", [1.0, 2.0])
    assert (only["slots"], only["recorded_s"], only["read_bytes"]) == (1_000_000, 10.0, 4_000_000)
    assert only["stages_s"]["decode"] == [0.4, 0.0]


def test_ratios_and_changes_are_in_it() -> None:
    told = document(
        replace(
            result(row("numpy", [run(1.0)])),
            ratios=(Ratio("dual-4", "numpy", "sdk", CPU, (0.5, 0.75)),),
            changes=(Changed("dual-4", "numpy", CPU, 4.0, 1.0),),
        )
    )
    pair = {"case": "dual-4", "program": "numpy", "to": "sdk", "of": CPU}
    assert told["ratios"] == [{**pair, "values": (0.5, 0.75), "median": 0.625}]
    (change,) = json.loads(json.dumps(told["changes"]))
    assert change["ratio"] == 0.25


def test_an_earlier_document_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "old.json"
    path.write_text(json.dumps(document(result(row("numpy", [run(1.0), run(2.0)])))))
    found = read_document(path)
    assert list(found) == [("dual-4", "numpy")]
    assert found["dual-4", "numpy"]["cpu_s"] == [1.0, 2.0]
    assert found["dual-4", "numpy"]["rss_mb"] == [80.0, 80.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "wanted what `mlbatch bench --json` printed"),
        ("[]", "wanted what `mlbatch bench --json` printed"),
        ("{}", "KeyError"),
        ('{"schema": "mlbatch.bench/9", "rows": []}', "wanted schema mlbatch.bench/1, got"),
        ('{"schema": "mlbatch.bench/1", "rows": [1]}', "TypeError"),
        ('{"schema": "mlbatch.bench/1", "rows": [{"case": "a"}]}', "KeyError"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "old.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BenchError, match="wanted") as caught:
        read_document(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="wanted an earlier result, got No such file"):
        read_document(tmp_path / "none.json")
