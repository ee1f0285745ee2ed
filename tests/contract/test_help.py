"""Every command explains itself, and does so without loading what only a run needs."""

from __future__ import annotations

import re

import pytest
from typer.core import TyperCommand
from typer.main import get_command
from typer.testing import CliRunner

from mlbatch.cli.app import COMMANDS, command_line
from mlbatch.cli.help import COMMON
from tests.contract.tree import run_python

# The options of this version.
OPTIONS: dict[str, set[str]] = {
    command: {f"--{name}" for name in names.split()}
    for command, names in {
        "convert": """
            output rig dataset rate format layout sort deskew deskew-to stamp batching
            batching-times point-layout ply-style max-bag-duration slices split keep-partial
            max-wait
            start end clock align-clocks align-to on-jump min-range max-range exclude-box
            keep-repeated drop-incomplete pass copy-topic metadata identity-extrinsics
            decode only include-sensor ignore exclude-sensor fault fault-seed html dry-run
            html-scans report shard jobs compression strict no-pose-check fail-on overwrite
            resume no-fsync quiet
            verbose accumulate voxel crs
        """,
        "merge": "output fail-on overwrite no-fsync quiet",
        "batch": """
            output rig dataset workers jobs retries part only plan fail-fast retry-failed no-pages
            scheduler cache quiet time-limit disk-limit list
        """,
        "batch-status": "json page",
        "inspect": "rig dataset whole verbose metadata json write-rig",
        "compare": """rig rate metadata clock tolerance timeout html figures speed overwrite verbose
            json""",
        "sensors": "json",
        "datasets": "json",
        "verify": "report json verbose",
        "report": "output report html-scans overwrite",
        "view": """
            rig metadata identity-extrinsics rate deskew start end only include-sensor
            ignore exclude-sensor min-range exclude-box clock align-clocks port no-browser
        """,
        "extract": """
            output rig metadata only ignore start end duration pass overwrite quiet verbose
        """,
        "simulate": "output duration seed overwrite quiet",
        "schema": "",
        "calibrate": """
            rig output metadata only clock align-clocks start end time-offset
            from-motion html overwrite
            json quiet verbose
        """,
        "digest": "output against overwrite",
        "diff": "tolerance json",
    }.items()
}
# Options of `convert` that a batch passes on; the others are its own, or have no meaning there.
_OWN = ("--output", "--rig", "--jobs", "--overwrite", "--resume", "--quiet", "--verbose")
_PASSED = OPTIONS["convert"] - {*_OWN, "--report", "--html", "--dry-run", "--shard"}
_PASSED -= {"--accumulate", "--voxel", "--crs"}
# There `--only` names sessions.
_PASSED -= {"--only", "--include-sensor"}
OPTIONS["batch"] |= _PASSED
HEAVY = ("numpy", "yaml", "mcap", "zstandard", "rich.progress")


def _whole(command: str = "") -> str:
    """What shows all options of a command."""
    return "--help-all" if command in COMMON else "--help"


def _commands(first: str = "") -> dict[str, TyperCommand]:
    group = get_command(command_line(first))
    found: dict[str, TyperCommand] = getattr(group, "commands")  # noqa: B009 - typer hides its type
    return found


def _described(command: str) -> dict[str, str]:
    """Help text by the long name of each option of a command."""
    return {
        name: getattr(parameter, "help", None) or ""
        for parameter in _commands()[command].params
        for name in parameter.opts
        if name.startswith("--")
    }


def test_every_command_has_its_options_here() -> None:
    assert sorted(COMMANDS) == sorted(OPTIONS)
    assert tuple(_commands()) == COMMANDS


@pytest.mark.parametrize("command", OPTIONS)
def test_a_command_is_the_same_without_the_others(command: str) -> None:
    alone = _commands(command)
    assert list(alone) == [command]
    options = [one.opts for one in alone[command].params]
    assert options == [one.opts for one in _commands()[command].params]


@pytest.mark.parametrize("command", OPTIONS)
def test_the_options_are_those_of_the_contract(command: str) -> None:
    found = _described(command)
    # Ignored with a note, and hidden.
    assert set(found) - {"--help", "--engine", "--cache-gb"} == OPTIONS[command]
    assert all(found.values())
    for parameter in _commands()[command].params:
        if getattr(parameter, "multiple", False):
            assert "repeatable" in (getattr(parameter, "help", None) or ""), parameter.opts


@pytest.mark.parametrize("command", COMMON)
def test_long_commands_show_what_people_use(command: str) -> None:
    result = CliRunner().invoke(command_line(command), [command, "-h"], env={"COLUMNS": "100"})
    shown = set(re.findall(r"--[a-z-]+", result.stdout))
    assert {"--output", "--rig", "--rate", "--format", "--help-all"} <= shown
    assert shown < {*OPTIONS[command], "--help", "--help-all"}
    assert len(result.stdout.splitlines()) <= 45


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_both_words_show_the_same_help(word: str) -> None:
    runner = CliRunner()
    page = runner.invoke(command_line("convert"), ["convert", word])
    assert page.exit_code == 0
    assert page.stdout.startswith("Usage: ")
    first = runner.invoke(command_line(word), [word])
    assert first.exit_code == 0
    # Summaries are whole, and those of the commands themselves.
    words = " ".join(first.stdout.split())
    for name, command in _commands().items():
        assert f"{name} {' '.join((command.help or '').split())}" in words


GROUPS = ("Input", "Batching", "Selection", "Output", "Clocks", "Run")


def test_every_option_of_convert_is_in_a_group() -> None:
    page = CliRunner().invoke(command_line("convert"), ["convert", "--help-all"]).stdout
    assert tuple(re.findall(r"^(\w+):$", page, re.MULTILINE)) == GROUPS, (
        "list the option in _OTHERS of mlbatch/cli/help.py"
    )


SHORT = {
    "convert": {
        *("-o --output", "-r --rig", "-f --format", "-j --jobs", "-m --metadata"),
        *("-q --quiet", "-v --verbose"),
    },
    "inspect": {"-r --rig", "-m --metadata", "-v --verbose"},
    "compare": {"-r --rig", "-m --metadata", "-v --verbose"},
    "verify": {"-v --verbose"},
    "merge": {"-o --output", "-q --quiet"},
    "batch": {
        *("-o --output", "-r --rig", "-f --format", "-j --jobs", "-m --metadata"),
        *("-q --quiet",),
    },
}


@pytest.mark.parametrize("command", SHORT)
def test_short_options(command: str) -> None:
    names = [param.opts for param in _commands()[command].params]
    short = {" ".join(sorted(one, key=len)) for one in names if any(len(name) == 2 for name in one)}
    assert short == SHORT[command]


@pytest.mark.parametrize("columns", [80, 100, 200])
@pytest.mark.parametrize("command", ["", *OPTIONS])
def test_help_fits_the_terminal(
    monkeypatch: pytest.MonkeyPatch, command: str, columns: int
) -> None:
    monkeypatch.setattr("mlbatch.cli.help.is_drawn", lambda: True)
    words = [command, _whole(command)] if command else ["-h"]
    environment = {"COLUMNS": str(columns), "TERM": "xterm", "NO_COLOR": "1"}
    result = CliRunner().invoke(command_line(words[0]), words, env=environment)
    assert result.exit_code == 0
    lines = [re.sub(r"\x1b\[\d*m", "", line) for line in result.stdout.splitlines()]
    assert max(map(len, lines)) <= min(columns, 120)
    for name in OPTIONS.get(command, COMMANDS):
        assert any(re.search(rf"[ │]{name}\b", line) for line in lines), name


def test_a_shell_completes_words_of_options() -> None:
    # Layouts, formats and decoder options by docs/commands.md and docs/sensors.md.
    completed = {
        "--layout": {"dense", "organized"},
        "--format": {"mcap", "npz", "ply", "rosbag1", "rosbag2"},
        "--point-layout": {"standard", "kiss-icp"},
        "--decode": {"crc=check", "firing_azimuth=off"},
    }
    for option, words in completed.items():
        printed = run_python(
            "import os, sys\n"
            "os.environ |= {'_MLBATCH_COMPLETE': 'complete_bash', 'COMP_CWORD': '3', "
            f"'COMP_WORDS': 'mlbatch convert {option} '}}\n"
            "sys.argv = ['mlbatch']\n"
            "from mlbatch.cli import main\n"
            "main()\n"
        )
        assert words <= set(printed.split()), option


def test_drawn_help_loads_no_parser_of_markdown() -> None:
    """It takes longer than all else in `--help`; old versions of typer load it themselves."""
    loaded = run_python(
        "import sys, typer.main\nbefore = set(sys.modules)\n"
        "from mlbatch.cli import help\nfrom mlbatch.cli.app import command_line\n"
        "help.is_drawn = lambda: True\n"
        "command_line('convert')(['convert', '-h'], standalone_mode=False)\n"
        f"print([name for name in {(*HEAVY, 'markdown_it', 'rich.markdown')!r} "
        "if name in set(sys.modules) - before])"
    )
    assert loaded.splitlines()[-1] == "[]"


def test_the_root_offers_its_names_without_loading_them() -> None:
    printed = run_python(
        "import sys, mlbatch\n"
        "assert 'numpy' not in sys.modules\n"
        "print(sorted(name for name in mlbatch.__all__ if getattr(mlbatch, name) is not None))"
    )
    names = [
        *("Calibration", "Dataset", "MlbatchError", "Recording", "Run", "Scan", "calibrate"),
        *("compare", "convert", "dataset", "digest", "extract", "inspect", "open"),
    ]
    assert printed.strip() == str([*names, "read", "report", "scans", "verify"])
