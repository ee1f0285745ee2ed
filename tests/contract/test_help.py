"""Every command explains itself, and does so without loading what only a run needs."""

from __future__ import annotations

import re

import pytest
from typer.core import TyperCommand
from typer.main import get_command
from typer.testing import CliRunner

from mlbatch.cli.app import COMMANDS, command_line
from tests.contract.tree import run_python

# The options of this version, and a pattern of their help.
OPTIONS: dict[str, dict[str, str]] = {
    "convert": {
        "--output": r"\.mcap.*folder",
        "--rig": "YAML",
        "--rate": "Hz",
        "--format": "mcap, npz, ply, pcd, las, laz, kitti, nuscenes, rosbag1, rosbag2",
        "--layout": "dense.*organized",
        "--sort": "columns.*points",
        "--point-layout": "preset",
        "--ply-style": "standard, cloudcompare, float",
        "--slices": "window",
        "--split": "sensor",
        "--keep-partial": "first and last",
        "--max-wait": r"\bs\b.*inf",
        "--start": r"epoch s.*ISO.*\+S",
        "--end": "--start",
        "--clock": "sensor.*host",
        "--align-clocks": "twice",
        "--align-to": "host.*first",
        "--on-jump": "error.*split",
        "--min-range": r"\bm\b",
        "--max-range": r"\bm\b",
        "--exclude-box": r"x0,y0,z0,x1,y1,z1, m, body frame.*repeatable",
        "--keep-repeated": "second",
        "--drop-incomplete": "%",
        "--pass": "topic",
        "--metadata": "repeatable",
        "--identity-extrinsics": "without extrinsics",
        "--decode": "KEY=VALUE.*repeatable",
        "--only": "repeatable",
        "--ignore": "repeatable",
        "--fault": "repeatable",
        "--fault-seed": "random",
        "--html": "page.*HTML",
        "--dry-run": "report.*split.*line.*segment",
        "--report": "JSON",
        "--jobs": "same time",
        "--compression": "none, lz4, zstd.*LEVEL",
        "--engine": "auto, numpy, or native",
        "--strict": "error",
        "--fail-on": r"3.*loss>0\.1%.*repeatable",
        "--overwrite": "existing",
        "--resume": "interrupted.*OUTPUT",
        "--no-fsync": "on the disk",
        "--quiet": "progress",
        "--verbose": "chosen",
    },
    "inspect": {
        "--whole": "whole",
        "--metadata": "repeatable",
        "--json": "JSON",
        "--write-rig": "convert",
    },
    "compare": {
        "--rig": "YAML",
        "--rate": "Hz",
        "--metadata": "repeatable",
        "--clock": "sensor.*host",
        "--tolerance": r"\bs\b.*other",
        "--timeout": r"\bs\b",
        "--json": "JSON",
    },
    "sensors": {"--json": "JSON"},
    "verify": {"--report": "JSON.*next to", "--json": "JSON"},
    "report": {
        "--output": r"page.*OUTPUT\.html",
        "--report": "JSON.*next to",
        "--overwrite": "existing",
    },
    "bench": {
        "--seconds": r"\bs\b",
        "--repeat": "program",
        "--case": "repeatable",
        "--engine": "numpy, native",
        "--peer-python": "ouster-sdk or velodyne-decoder.*repeatable",
        "--keep": "recordings",
        "--against": "Earlier.*JSON",
        "--json": "JSON",
    },
}
HEAVY = ("numpy", "yaml", "mcap", "zstandard", "rich.progress")


def _help(*arguments: str) -> str:
    app = command_line(*arguments[:1])
    result = CliRunner().invoke(app, [*arguments, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    return " ".join(result.stdout.split())


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


@pytest.mark.parametrize("first", ["", "convrt", "--help"])
def test_other_words_leave_all_commands(first: str) -> None:
    assert tuple(_commands(first)) == COMMANDS


def test_the_first_page_names_every_command() -> None:
    page = _help()
    for command in (*OPTIONS, "--version"):
        assert re.search(rf" {command} \S", page), command


@pytest.mark.parametrize("command", OPTIONS)
def test_the_options_are_those_of_the_contract(command: str) -> None:
    found = _described(command)
    assert set(found) - {"--help"} == set(OPTIONS[command])
    for name, words in OPTIONS[command].items():
        assert re.search(words, found[name]), f"{command} {name}: {found[name]!r}"


@pytest.mark.parametrize("command", OPTIONS)
def test_help_shows_every_option(command: str) -> None:
    page = _help(command)
    for name in OPTIONS[command]:
        assert re.search(rf"{name}\b", page), name


def test_help_loads_nothing_heavy() -> None:
    loaded = run_python(
        "import sys\nfrom mlbatch.cli.app import command_line\ncommand_line()\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_the_root_offers_its_names_without_loading_them() -> None:
    printed = run_python(
        "import sys, mlbatch\n"
        "assert 'numpy' not in sys.modules\n"
        "print(sorted(name for name in mlbatch.__all__ if getattr(mlbatch, name) is not None))"
    )
    names = [*("MlbatchError", "Recording", "Run", "Scan", "convert", "inspect", "open", "read")]
    assert printed.strip() == str([*names, "scans", "verify"])
