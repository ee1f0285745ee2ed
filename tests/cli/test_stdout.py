"""`-` as a path: standard output, or refused; never a file of that name."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import typer.main

from mlbatch.cli.app import COMMANDS, PRINTABLE, command_line
from tests.builders.sessions import CAPTURE, NS_PER_S, RIG, Shell, Unit, report_of, write_session


def _paths() -> list[tuple[str, str, bool]]:
    """Command, option and whether it is an argument, of all parameters that are paths."""
    found: list[tuple[str, str, bool]] = []
    group = typer.main.get_command(command_line())
    for command in COMMANDS:
        for param in group.commands[command].params:  # type: ignore[attr-defined]
            is_argument = param.param_type_name == "argument"
            if param.type.name == "path" and (command, param.name) not in PRINTABLE:
                found += [(command, max(param.opts, key=len), is_argument)]
    return found


@pytest.mark.parametrize(("command", "option", "is_argument"), _paths())
def test_no_other_path_may_be_it(
    shell: Shell, tmp_path: Path, command: str, option: str, is_argument: bool
) -> None:
    words = ["-"] if is_argument else [option, "-"]
    if not is_argument:
        words.append(str(CAPTURE))
    if command == "diff":
        words = ["-", str(CAPTURE)] if option == "a" else [str(CAPTURE), "-"]
    if command in ("batch", "extract") or (command, option) == ("merge", "parts"):
        words += ["-o", "out"] * (option != "--output")
    if command == "calibrate" and option != "--rig":
        words += ["--rig", str(RIG)]
    outcome = shell(command, *words)
    assert (outcome.code, outcome.out) == (2, "")
    name = option.upper() if is_argument else option
    if command == "view" and is_argument:
        name = "OUTPUT|RECORDING..."
    assert outcome.err == (
        f"mlbatch: error: {name}: expected a path, found -: neither standard input nor standard "
        "output can be used here; give a file or folder\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_paths_of_all_commands_are_tested() -> None:
    assert {command for command, _, _ in _paths()} >= {"convert", "inspect", "compare", "verify"}
    assert ("convert", "--output", False) in _paths()


def test_a_line_for_each_segment(shell: Shell, tmp_path: Path) -> None:
    write_session(tmp_path, Unit(turns=40))
    words = "--fault jump:ouster_111:37s@2s --on-jump split --report -"
    outcome = shell(f"convert drive.pcap -o out {words}")
    assert outcome.code == 0, outcome.err
    reports = [json.loads(line) for line in outcome.out.splitlines()]
    starts = [one["grid"]["t_init_ns"] for one in reports]
    assert len(starts) == 2
    assert starts[1] - starts[0] > 37 * NS_PER_S
    assert reports == [report_of(f"out.seg{n}/report.json") for n in (1, 2)]


def _stdin(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))


def test_a_page_of_a_report_from_standard_input(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = shell(f"convert {CAPTURE} --rig {RIG} --dry-run").out
    _stdin(monkeypatch, report)
    assert shell("report - -o run.html").out == "wrote run.html\n"
    (tmp_path / "report.json").write_text(report)
    assert shell("report report.json -o same.html").code == 0
    page = (tmp_path / "run.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert page == (tmp_path / "same.html").read_text()
    _stdin(monkeypatch, report)
    assert shell("report - -o -").out == page
    assert not (tmp_path / "-").exists()


def test_a_page_of_standard_input_needs_a_name(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    _stdin(monkeypatch, "{}")
    outcome = shell("report -")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.startswith("mlbatch: error: -o: expected a name for the page of standard")


def test_standard_input_that_is_no_report(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    _stdin(monkeypatch, "nothing")
    outcome = shell("report - -o -")
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.err.startswith("mlbatch: error: standard input: expected a report in JSON")
