"""Tables fit a terminal of any width; files and pipes get whole lines without escape codes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mlbatch.cli import tables
from tests.builders.sessions import CAPTURE, FIXTURE, REPOSITORY, Shell, Unit, twin, write_session

MAKERS = REPOSITORY / "fixtures" / "four_makers"
ESCAPE = re.compile(r"\x1b\[[\d;]*m")
HEAD = ("name", "first long head", "second long head", "number")
ROWS = [HEAD, ("left", "a word or two", "one", "1"), ("right", "three", "four words in all", "22")]
COMMANDS = (
    f"inspect {MAKERS / 'four_makers.pcap'}",
    f"inspect {MAKERS / 'four_makers.pcap'} --rig {MAKERS / 'rig.yaml'} --whole",
    f"compare {MAKERS / 'four_makers.pcap'} --rig {MAKERS / 'rig.yaml'} --tolerance 0.08",
    "sensors",
    f"convert {CAPTURE} --rig {FIXTURE / 'rig.yaml'} -o out.mcap --overwrite",
)


def _at(monkeypatch: pytest.MonkeyPatch, width: int | None) -> None:
    monkeypatch.setattr(tables, "terminal_width", lambda: width)
    monkeypatch.setattr("mlbatch.cli.summary.terminal_width", lambda: width)


def _lines(rows: tables.Rows, *, transposable: bool = False) -> list[str]:
    found = tables.table_lines(rows, transposable=transposable)
    return [ESCAPE.sub("", line).rstrip() for line in found]


@pytest.mark.parametrize("columns", [80, 100, 200])
@pytest.mark.parametrize("command", COMMANDS)
def test_commands_fit_the_terminal(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, command: str, columns: int
) -> None:
    _at(monkeypatch, columns)
    outcome = shell(command)
    assert outcome.code == 0
    lines = [ESCAPE.sub("", line).rstrip() for line in outcome.out.splitlines()]
    # Paths and commands are not wrapped.
    kept = ("wrote ", "mlbatch report ", "the page is ")
    too_long = [line for line in lines if len(line) > columns and not line.startswith(kept)]
    assert too_long == []


@pytest.mark.parametrize("command", COMMANDS)
def test_pipes_get_neither_colors_nor_another_width(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")
    narrow = shell(command)
    assert "\x1b" not in narrow.out + narrow.err
    monkeypatch.setenv("COLUMNS", "300")
    wide = shell(command)
    # Only times of a run differ.
    times = re.compile(r"\d[\d.]* (?:s recorded in .*|MB.*)")
    assert times.sub("", wide.out) == times.sub("", narrow.out)


def test_a_narrower_one_its_transpose(monkeypatch: pytest.MonkeyPatch) -> None:
    _at(monkeypatch, 40)
    rows = [
        ("joined by", "sets without a sensor", "sets with a stale one"),
        ("latest", "1", "20"),
        ("windows", "300", "4"),
    ]
    assert _lines(rows, transposable=True) == [
        "joined by              latest  windows",
        "sets without a sensor       1      300",
        "sets with a stale one      20        4",
    ]


def test_a_very_narrow_one_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    _at(monkeypatch, 32)
    assert _lines([*ROWS, ("rear", "", "", "3")]) == [
        "left",
        "  first long head a word or two",
        "  second long head one",
        "  number 1",
        "right",
        "  first long head three",
        "  second long head four words in",
        "  all",
        "  number 22",
        "rear",
        "  number 3",
    ]


def test_a_pipe_gets_whole_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    _at(monkeypatch, None)
    long = "x" * 500
    assert tables.table_lines([("a", "b"), (long, "2")]) == [f"a{' ' * 499}  b", f"{long}  2"]
    assert tables.paragraph(f"a {long}\nb") == f"a {long}\\nb"


def test_clocks_of_many_sensors_are_a_matrix(shell: Shell, tmp_path: Path) -> None:
    """Three lidars, each 3 ms ahead of the one before: six differences, worked out by hand."""
    first = Unit(turns=20)
    ahead = (twin(first.ahead(n * 3 * 10**6), 111 * (n + 1), f"10.0.0.{n + 1}") for n in (1, 2))
    capture = write_session(tmp_path, first, *ahead)
    outcome = shell(f"inspect {capture}")
    assert outcome.code == 0
    text = outcome.out[outcome.out.index("clock minus clock") :]
    rows = [re.split(r" {2,}", line) for line in text.splitlines()[:4]]
    assert rows[0] == ["clock minus clock", "1", "2", "3"]
    assert [row[0] for row in rows[1:]] == ["1 ouster_111", "2 ouster_222", "3 ouster_333"]
    found = [[float(cell.removesuffix(" ms")) for cell in row[1:]] for row in rows[1:]]
    expected = [[0, -3, -6], [3, 0, -3], [6, 3, 0]]
    for row, expected_row in zip(found, expected, strict=True):
        assert row == pytest.approx(expected_row, abs=0.1)
    # All are within 10 ms: no pair needs a line of its own.
    assert " and " not in outcome.out


def test_a_narrow_terminal_gets_one_column_of_the_matrix(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    _at(monkeypatch, 60)
    outcome = shell(f"inspect {MAKERS / 'four_makers.pcap'}")
    text = ESCAPE.sub("", outcome.out)
    assert "clock minus clock" not in text
    assert "minus clock of ouster_122648000456" in text
