"""The command line of the benchmark."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections import namedtuple
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.bench.__main__ import main, parser, settings_from
from tests.bench.cases import Case, Conversion

SHORT = ("--seconds", "1", "--repeat", "1", "--case", "three-vlp16")


class Output(NamedTuple):
    """Output of a benchmark, and its exit code."""

    code: int
    out: str
    err: str


def command(*words: str | Path) -> Output:
    """Run it with these words in this process."""
    out = io.StringIO()
    err = io.StringIO()
    code: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(word) for word in words])
        except SystemExit as leave:
            code = leave.code
    return Output(int(str(code)), out.getvalue(), err.getvalue())


def test_a_short_run_and_another_against_it(tmp_path: Path) -> None:
    done = command(*SHORT, "--json", "--keep", tmp_path)
    assert (done.code, done.err) == (0, "")
    found = json.loads(done.out)
    rows = {row["program"]: row for row in found["rows"]}
    assert list(rows) == ["mlbatch", "python with numpy", "memory copy"]
    ours = rows["mlbatch"]
    copied = rows["memory copy"]
    assert ours["scans"] > 5
    # 32 slots in a block of 110.592 us, of three sensors, in whole windows.
    assert ours["slots"] == pytest.approx(3 * 32 * ours["scans"] * 0.1 / 110.592e-6, rel=0.001)
    capture = tmp_path / "three-vlp16-1s" / "capture.pcap"
    assert ours["read_bytes"] == capture.stat().st_size
    assert copied["written_bytes"] == ours["read_bytes"] + 24 * ours["points"]
    assert len(ours["cpu_s"]) == len(ours["stages_s"]["decode"]) == 1
    assert 0 < ours["own_cpu_s"][0] < ours["cpu_s"][0]
    assert {"cpu", "cores", "memory_mb", "python", "numpy", "mlbatch"} <= set(found["machine"])
    assert any("velodyne-decoder was not measured" in note for note in found["notes"])
    earlier = tmp_path / "earlier.json"
    earlier.write_text(done.out, encoding="utf-8")
    before_ns = capture.stat().st_mtime_ns
    done = command(*SHORT, "--keep", tmp_path, "--against", earlier)
    assert (done.code, done.err) == (0, "")
    assert "before" in done.out
    # The recording was used again, and nothing else is left.
    assert capture.stat().st_mtime_ns == before_ns
    assert sorted(path.name for path in tmp_path.iterdir()) == ["earlier.json", "three-vlp16-1s"]


def test_outputs_are_measured_and_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case("small", ("three-vlp16",), "mcap", ("plain write", "mcap library"))
    monkeypatch.setattr("tests.bench.__main__.CASES", (case,))
    done = command("--seconds", "1", "--repeat", "2", "--json", "--keep", tmp_path)
    assert done.code == 0
    found = json.loads(done.out)
    rows = {row["program"]: row for row in found["rows"]}
    assert list(rows) == ["dry run", "mcap", "plain write", "mcap library"]
    assert rows["mcap"]["written_bytes"] == rows["plain write"]["written_bytes"]
    # 24 bytes a point, and a little around them.
    assert 1 < rows["mcap"]["written_bytes"] / (24 * rows["mcap"]["points"]) < 1.02
    assert [path.name for path in tmp_path.iterdir()] == ["three-vlp16-1s"]


def test_a_failed_conversion_is_reported_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = Conversion("wrong", "three-vlp16", options=("--rate", "0.01"))
    case = Case("small", ("three-vlp16",), "", (), (Conversion("right", "three-vlp16"), wrong))
    monkeypatch.setattr("tests.bench.__main__.CASES", (case,))
    done = command("--seconds", "1", "--repeat", "1", "--keep", tmp_path)
    assert done.code == 1
    assert "small  right" in done.out
    assert "note: small: wrong: expected exit code 0, found 2: mlbatch: error: --rate" in done.out
    assert done.err.startswith("bench: error: 1 conversion(s) failed, small: wrong first")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--seconds", "0.5"), 2, "--seconds: expected 1 to 3600, found 0.5"),
        (("--seconds", "nan"), 2, "--seconds: expected 1 to 3600, found nan"),
        (("--repeat", "0"), 2, "--repeat: expected 1 to 1000, found 0"),
        (("--case", "none"), 2, "--case: expected one of dual-4, "),
        (("--against", "/no/file"), 1, "/no/file: expected an earlier result"),
        (("--peer-python", "/no/python"), 1, "--peer-python: expected a program, found /no/python"),
        (("--keep", "/dev/null"), 1, "/dev/null: expected a folder to write to, found File exists"),
    ],
)
def test_mistakes(words: tuple[str, ...], code: int, message: str) -> None:
    done = command(*words)
    assert done.code == code
    assert done.err.startswith(f"bench: error: {message}")
    assert done.err.count("\n") == 1


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", ["total", "used", "free"])
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(2, 1, 5_000_000))
    done = command("--case", "pandar64", "--seconds", "10", "--keep", tmp_path)
    assert done.code == 1
    # 3000 packets of 1198 bytes and 58 around them, in 10 s.
    assert "expected about 37 MB of free disk, found 5 MB; choose another with --keep" in done.err
    assert not list(tmp_path.iterdir())


def test_a_case_that_is_named_twice_is_measured_once() -> None:
    """Otherwise its rows would be compared with each other."""
    names = ["--case", "pandar64", "--case", "mixed", "--case", "pandar64"]
    settings = settings_from(parser().parse_args(names))
    assert [case.name for case in settings.cases] == ["pandar64", "mixed"]
