"""The command line as its users see it: what is printed where, and what is left when it stops."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.builders.sessions import CAPTURE, FIX, REPOSITORY, RIG, Report, Shell, names, report_of


def without_timing(report: Report) -> Report:
    """What does not depend on the machine."""
    return {
        key: value for key, value in report.items() if key not in ("timing", "command", "identity")
    }


# -- what is printed ------------------------------------------------------------------------------


def test_a_dry_run_prints_the_report_that_a_run_writes(shell: Shell) -> None:
    outcome = shell(f"convert {FIX} --dry-run")
    assert (outcome.code, outcome.err) == (0, "")
    assert list(Path().iterdir()) == []
    printed = without_timing(json.loads(outcome.out))
    to_file = shell(f"convert {FIX} --dry-run --report report.json")
    assert to_file.out.splitlines()[0].startswith("sensor ")
    assert names(".", "") == ["report.json"]
    assert without_timing(report_of("report.json")) == printed
    assert shell(f"convert {FIX} -o out.mcap").code == 0
    assert without_timing(report_of("out.mcap.report.json")) == printed


def test_sensors_as_table_and_as_json_agree(shell: Shell) -> None:
    table = shell("sensors")
    listed = json.loads(shell("sensors --json").out)
    lines = table.out.splitlines()
    assert lines[0].split() == list(listed[0])
    # Columns of the table are two blanks or more apart; names have one at most.
    cells = [re.split(r" {2,}", line)[0] for line in lines[1:]]
    assert cells == [row["model"] for row in listed]
    assert {"OS0-32", "VLP-16", "PandarXT-32", "Helios 16", "Livox SDK2"} <= set(cells)


# -- progress, interruption, disks ----------------------------------------------------------------


SLOW = """\
import time
from mlbatch import cli
from mlbatch.pipeline import conversion
tasks = conversion.Conversion.tasks
def slowly(self, progress=None):
    for task in tasks(self, progress):
        yield task
        print("a scan", flush=True)
        time.sleep(0.5)
conversion.Conversion.tasks = slowly
cli.main()
"""


def test_an_interrupted_run_leaves_nothing_under_the_final_name(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLOW, "convert", str(CAPTURE), "--rig", str(RIG), "-o", "out"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        text=True,
    ) as process:
        until_s = time.monotonic() + 300
        while not list(tmp_path.glob("out.partial/*.npz")) and time.monotonic() < until_s:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert out.splitlines()[0] == "a scan"
    assert err == (
        "mlbatch: error: interrupted; finished scans are kept in .partial, from where "
        "--resume continues\n"
    )
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["out.partial"]


@pytest.mark.parametrize("words", [("convert", "--dry-run"), ("compare",)])
def test_an_interrupt_of_what_writes_nothing_speaks_of_no_output(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mlbatch.pipeline.conversion.Batcher.push", interrupt)
    outcome = shell(*words, CAPTURE, "--rig", RIG)
    assert (outcome.code, outcome.out) == (130, "")
    assert outcome.err == "mlbatch: error: interrupted\n"


def test_an_interrupt_while_a_class_is_made(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python up to 3.11 wraps what a `__set_name__` raises in a RuntimeError."""

    def interrupt(*_: object) -> None:
        raise RuntimeError("Error calling __set_name__") from KeyboardInterrupt()

    monkeypatch.setattr("mlbatch.pipeline.conversion.Batcher.push", interrupt)
    outcome = shell("convert", "--dry-run", CAPTURE, "--rig", RIG)
    assert (outcome.code, outcome.err) == (130, "mlbatch: error: interrupted\n")


def test_a_reader_that_goes_away_is_no_error_worth_a_traceback() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "mlbatch", "sensors"],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 1


def _with_free_bytes(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free))


def test_too_little_disk_is_said_before_anything_is_read(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorded = CAPTURE.stat().st_size
    _with_free_bytes(monkeypatch, recorded // 4 - 1)
    outcome = shell(f"convert {FIX} -o out")
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.err == (
        "mlbatch: error: out: expected about 0 MB of free disk, found 0 MB; free space or choose "
        "another output\n"
    )
    assert list(tmp_path.iterdir()) == []
    _with_free_bytes(monkeypatch, recorded // 4)
    outcome = shell(f"convert {FIX} -o out")
    assert (outcome.code, outcome.warnings) == (0, ["disk"])
    _with_free_bytes(monkeypatch, recorded)
    assert shell(f"convert {FIX} -o out --overwrite").err == ""


@pytest.mark.parametrize("part", ["--end +0.1", "--only left", "--max-range 5", "--dry-run"])
def test_a_part_of_a_recording_may_need_little_disk(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    _with_free_bytes(monkeypatch, 1)
    outcome = shell(f"convert {FIX} -o out {part}")
    assert (outcome.code, outcome.err) == (0, "")
