"""Every block of the pages runs, one after another, as someone would type them.

Blocks that need a recording of the reader's own, or a foreign program, are marked; the options of
their mlbatch commands are parsed by the real command line all the same.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from typer.main import get_command

from mlbatch.cli.app import COMMANDS, command_line
from tests.bench.__main__ import parser as bench_options
from tests.builders.run import command as mlbatch
from tests.contract.blocks import LANGUAGES, PAGES, Block, blocks, calls
from tests.contract.test_help import OPTIONS
from tests.contract.tree import ROOT

BLOCKS = [block for page in PAGES for block in blocks(page)]
MAKE_TARGETS = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
NOT_RUN = [block for block in BLOCKS if block.reason]
# Differs from run to run: times, speed and memory of a run; the folder that is the page's.
VARYING = (
    (re.compile(r"recorded in .*"), "recorded in"),
    (re.compile(r"\b\d+(\.\d+)? m?s\b"), "TIME"),
)


def _runs(block: Block) -> bool:
    return not block.reason and block.language in ("console", "python", "yaml")


RUNNING = sorted({block.page for block in BLOCKS if _runs(block)})


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the fixtures, in which `mlbatch` and `python` are those of the tests."""
    programs = tmp_path / ".bin"
    programs.mkdir()
    for name, words in (("mlbatch", "-m mlbatch"), ("python", "")):
        script = programs / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n', encoding="utf-8")
        script.chmod(0o755)
    for name in ("fixtures", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", RUNNING, ids=_name)
def test_blocks_run(page: Path, place: Path) -> None:
    names: dict[str, object] = {}
    for block in filter(_runs, blocks(page)):
        if block.needs and importlib.util.find_spec(block.needs) is None:
            continue
        if block.title:
            (place / block.title).parent.mkdir(parents=True, exist_ok=True)
            (place / block.title).write_text(block.text, encoding="utf-8")
        elif block.language == "console":
            _type(block)
        elif block.language == "python":
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                exec(compile(block.text, block.place, "exec"), names)
        if block.language == "yaml":
            assert yaml.safe_load(block.text) is not None, block.place


def _type(block: Block) -> None:
    """Run the lines of a console block; what the page shows is what they print."""
    commands = block.commands()
    assert commands, f"{block.place}: expected lines that begin with $, found none"
    for command in commands:
        code, printed = _run(command.line)
        words = f"{block.place}: {command.line}\n{printed}"
        assert code == 0, words
        if command.printed.strip():
            assert re.fullmatch(_pattern(command.printed), _steady(printed)), words


def _run(line: str) -> tuple[int, str]:
    """Exit code and what is printed; what needs no shell runs in this process, which is faster."""
    if re.fullmatch(r"mlbatch [\w ./:=%+-]*", line):
        outcome = mlbatch(*line.split()[1:], together=True)
        return outcome.code, outcome.out
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", line],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout


def _steady(text: str) -> str:
    for pattern, name in VARYING:
        text = pattern.sub(name, text)
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


def _pattern(shown: str) -> str:
    """A line of three points stands for any lines."""
    lines = _steady(shown).split("\n")
    return "\n".join("(?s:.*)" if line == "..." else re.escape(line) for line in lines)


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_languages_are_known(page: Path) -> None:
    """A block of another language would not be run; an indented one is not seen."""
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{block.place}: expected one of {LANGUAGES}"
        typed = [line for line in block.text.splitlines() if re.match(r"(\$ )?mlbatch ", line)]
        is_script = block.language == "bash"
        assert block.language == "console" or is_script or not typed, (
            f"{block.place}: expected ```console"
        )
        assert block.reason or not is_script, f"{block.place}: expected <!-- not run: REASON -->"
    inside = False
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        inside ^= line.lstrip().startswith("```")
        typed_here = not inside and re.match(r"    (\$ )?(mlbatch|pip|python) ", line)
        assert not typed_here, f"{_name(page)}:{number}: expected a block ```console"


@pytest.mark.parametrize("block", NOT_RUN, ids=lambda block: block.place)
def test_blocks_that_do_not_run_have_options_that_exist(block: Block) -> None:
    assert len(block.reason.split()) >= 2
    if block.language == "python":
        compile(block.text, block.place, "exec")
    elif block.language == "console":
        assert block.commands(), f"{block.place}: expected lines that begin with $, found none"
    for command in block.commands():
        for arguments in calls(command.line, "mlbatch"):
            _parse(arguments)
        for words in calls(command.line, "make"):
            targets = {word for word in words if "=" not in word}
            assert targets <= MAKE_TARGETS, f"{block.place}: {command.line}"
            for word in words:
                if word.startswith("BENCH="):
                    bench_options().parse_args(shlex.split(word.removeprefix("BENCH=")))


def _parse(arguments: list[str]) -> None:
    """Parse the words after `mlbatch` as the command line does, without running the command."""
    if arguments[:1] in ([], ["--version"], ["--help"], ["--install-completion"]):
        return
    name, *rest = arguments
    assert name in COMMANDS, f"expected a command, found {name}"
    command = getattr(get_command(command_line(name)), "commands")[name]  # noqa: B009
    if "--help" in rest or "-h" in rest:
        return
    with command.make_context(name, rest):
        pass


# Options of other programs that the pages name.
FOREIGN_OPTIONS = {
    "--count",
    "--decimate",
    "--help",
    "--help-all",
    "--number",
    "--output-dir",
    "--seed",
} | {
    "--target",
    "--version",
    "--install-completion",
    # tests.bench.
    "--keep",
    "--seconds",
    # Examples and evo.
    "--evo",
    "--recordings",
    "--t_offset",
    "--truth",
    "--variants",
}
OPTION = re.compile(r"(?<![\w-])(--[a-z][\w-]*)")


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_options_in_the_text_exist(page: Path) -> None:
    known = {option for options in OPTIONS.values() for option in options} | FOREIGN_OPTIONS
    text = re.sub(r"^ *```.*?^ *```$", "", page.read_text("utf-8"), flags=re.M | re.S)
    text = re.sub(r"<!--.*?-->", "", text)
    for code in re.findall(r"`([^`]+)`", text):
        if not code.startswith(("ouster-cli", "make", "pip", "python", "tcpdump", "rosbag")):
            assert set(OPTION.findall(code)) <= known, code


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("convert a --rigg r.yaml -o b", "No such option"),
        ("convert a -o b --rate", "requires an argument"),
        ("convrt a", "expected a command"),
    ],
)
def test_a_misspelt_option_is_refused(line: str, error: str) -> None:
    # Which exception it is depends on the version of typer, which contains click or needs it.
    with pytest.raises(Exception, match=error):
        _parse(line.split())
