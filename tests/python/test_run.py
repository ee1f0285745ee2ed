"""`mlbatch.convert`, `verify` and `inspect` do what the commands do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import mlbatch
from mlbatch.errors import UsageError
from mlbatch.pipeline import preflight
from tests.builders.sessions import CAPTURE, RIG


def test_the_report_of_a_run(tmp_path: Path) -> None:
    run = mlbatch.convert(CAPTURE, tmp_path / "scans", rig=RIG)
    left = run.report.sensors["left"]
    # docs/tutorials/first-merge.md: 271 packets, 3584 columns and 752 dropped, 90790 points.
    assert (left.packets, left.lost, left.rejected) == (271, 0, {})
    assert (left.columns, sum(left.dropped.values()), left.points) == (3584, 752, 90790)
    assert run.report.scans.written == 7
    assert run.report.warnings == ()
    assert run.report_path == tmp_path / "scans" / "report.json"
    stored = json.loads(run.report_path.read_text(encoding="utf-8"))
    assert stored == json.loads(json.dumps(run.report.as_json()))
    assert str(run.report).splitlines()[1].split()[0] == "left"


def test_a_warning_names_the_line_of_the_caller(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preflight, "free_bytes", lambda path: CAPTURE.stat().st_size - 1)
    with pytest.warns(UserWarning, match="disk: .* may not be enough") as warned:
        mlbatch.convert(CAPTURE, tmp_path / "scans.mcap", rig=RIG)
    own = [one for one in warned if one.category is UserWarning]
    assert [one.filename for one in own] == [__file__]


def test_options_of_an_opened_recording_are_given_there(tmp_path: Path) -> None:
    rec = mlbatch.open(CAPTURE, rig=RIG)
    with pytest.raises(UsageError, match=r"give it to mlbatch\.open"):
        mlbatch.convert(rec, tmp_path / "scans.mcap", rig=RIG)
    with pytest.raises(UsageError, match="--stamp: expected start for npz"):
        mlbatch.convert(rec, tmp_path / "out", stamp="end")
    with pytest.raises(UsageError, match="jobs: expected 1 to 64, or auto, found 0"):
        mlbatch.convert(rec, tmp_path / "scans.mcap", jobs=0)


def test_verify_is_a_function_before_and_after_its_import(tmp_path: Path) -> None:
    output = tmp_path / "scans.mcap"
    mlbatch.convert(CAPTURE, output, rig=RIG)
    assert mlbatch.verify(output).ok
    import mlbatch.verification as package

    assert mlbatch.verify is package.verify
    assert mlbatch.verify(str(output)).format == "mcap, standard"
    data = bytearray(output.read_bytes())
    data[len(data) // 2] ^= 1
    output.write_bytes(data)
    assert not mlbatch.verify(output).ok
