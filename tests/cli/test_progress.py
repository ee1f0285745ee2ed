"""Progress: stages, scans and remaining time, as lines where stderr is no terminal."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mlbatch.cli import progress
from mlbatch.cli.progress import Lines, Reporter
from tests.builders.sessions import CAPTURE, REPOSITORY, RIG, Shell

MB = 10**6


class Clock:
    """A clock that stands until it is set."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def _ignore(reporter: Reporter) -> None:
    pass


def test_a_line_has_stage_share_scans_and_remaining_time() -> None:
    clock = Clock()
    reporter = Reporter(("clocks", "convert"), "MB", _ignore, clock)
    assert reporter.line() == "1/2 clocks: 0.0/0.0 MB"
    clock.now_s += 30
    reporter(100 * MB, 400 * MB, 0)
    # 100 MB in 30 s, 300 MB to go.
    assert reporter.line() == "1/2 clocks: 25 %, 100.0/400.0 MB, 1:30 left"
    reporter(400 * MB, 400 * MB, 0)
    clock.now_s += 30
    reporter(0, 400 * MB, 0)
    clock.now_s += 10
    reporter(4 * MB, 400 * MB, 7)
    # The second pass has a speed of its own: 99 times 10 s.
    assert reporter.line() == "2/2 convert: 1 %, 4.0/400.0 MB, 7 scans, 16:30 left"


def test_lines_come_once_a_minute(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    reporter = Reporter(("convert",), "MB", Lines(clock), clock)
    for _ in range(250):
        clock.now_s += 1
        reporter(reporter.done + MB, 1000 * MB)
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines() == [
        f"mlbatch: convert: {done / 10:.0f} %, {done}.0/1000.0 MB, {left} left"
        for done, left in ((60, "15:40"), (120, "14:40"), (180, "13:40"), (240, "12:40"))
    ]


COMMANDS = (
    f"convert {CAPTURE} --rig {RIG} -o out.mcap",
    f"compare {CAPTURE} --rig {RIG}",
    f"inspect {CAPTURE} --whole",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_lines_need_v(shell: Shell, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)
    assert shell(command).err == ""
    said = shell(f"{command} -v" + (" --overwrite" if "-o" in command.split() else "")).err
    assert said.startswith(f"mlbatch: {command.split()[0]}: ")
    assert "2.5/2.5 MB" in said


def test_verify_counts_scans(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shell(COMMANDS[0]).code == 0
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)
    assert shell("verify out.mcap").err == ""
    lines = shell("verify out.mcap -v").err.splitlines()
    assert lines[-1] == "mlbatch: verify: 100 %, 7/7 scans, 0:00 left"
    assert len(lines) == 7


def test_both_passes_are_shown(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.0)
    said = shell(f"{COMMANDS[0]} --align-clocks -v").err
    assert "mlbatch: 1/2 clocks: 100 %, 2.5/2.5 MB, 0:00 left\n" in said
    assert "mlbatch: 2/2 convert: 0 %, 0.0/2.5 MB\n" in said
    assert re.search(r"mlbatch: 2/2 convert: 100 %, 2\.5/2\.5 MB, \d scans, 0:00 left\n", said)


def _on_a_terminal(folder: Path, command: str) -> tuple[int, bytes]:
    """Exit code of a command whose stderr is a terminal, and what comes there."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "mlbatch", *command.split()],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=theirs,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "TERM": "xterm", "COLUMNS": "80"},
    ) as process:
        os.close(theirs)
        said = b""
        # The end of a terminal is an error of the device.
        with contextlib.suppress(OSError):
            while piece := os.read(ours, 65536):
                said += piece
    os.close(ours)
    return process.returncode, said


BATCH = f"batch {CAPTURE} --rig {RIG} -o out"
# Where a command counts something other than bytes.
AMOUNTS = {"verify done.mcap": b"7/7 scans", BATCH: b"1/1 sessions"}


@pytest.mark.parametrize("command", [*COMMANDS, *AMOUNTS])
def test_a_terminal_shows_a_bar(shell: Shell, tmp_path: Path, command: str) -> None:
    assert shell(f"convert {CAPTURE} --rig {RIG} -o done.mcap").code == 0
    code, said = _on_a_terminal(tmp_path, command)
    assert code == 0
    assert (b"sessions" if command == BATCH else command.split()[0].encode()) in said
    assert AMOUNTS.get(command, b"2.5/2.5 MB") in said
    assert b"ETA" in said
    # The bar disappears: its line is erased at the end.
    assert said.rstrip().endswith(b"\x1b[2K")


def test_quiet_shows_no_bar(tmp_path: Path) -> None:
    assert _on_a_terminal(tmp_path, f"{COMMANDS[0]} --quiet") == (0, b"")
