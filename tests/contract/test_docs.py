"""README and docs/ agree with the code: commands run, tables agree, all names are present."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from mlbatch import writers
from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.run import convert
from mlbatch.readers import readers
from mlbatch.report import ledger
from mlbatch.report.report import build_report
from mlbatch.rig.rig import read_rig
from mlbatch.sensors import models
from mlbatch.writers import format_names, formats
from mlbatch.writers.point_layouts import CLOUD_LAYOUTS, PLY_LAYOUT
from tests.consumers.environments import ENVIRONMENTS
from tests.contract.test_help import OPTIONS
from tests.contract.tree import PACKAGE, ROOT, run_mlbatch, run_python

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "fixtures" / "README.md")
README = (ROOT / "README.md").read_text(encoding="utf-8")
FIXTURE = "fixtures/two_lidars/two_lidars.pcap"
RIG = "fixtures/two_lidars/rig.yaml"
MAKE_TABLE = "runpy.run_path('docs/sensors_table.py', run_name='__main__')"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#:]+)\)")
# The only line of a run that differs from machine to machine.
TIMES = re.compile(r"recorded in .*")


@dataclass(frozen=True, slots=True)
class Command:
    """A line of a console block, and what it printed there."""

    words: tuple[str, ...]
    output: str


def _blocks(language: str) -> list[str]:
    return [text for found, text in BLOCK.findall(README) if found == language]


def _commands() -> Iterator[Command]:
    for block in _blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            line, _, output = part.partition("\n")
            yield Command(tuple(shlex.split(line, comments=True)), output)


def _page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def _rows(page: str) -> list[list[str]]:
    """Cells of all table rows, without marks of code."""
    lines = [line for line in page.splitlines() if line.startswith("|")]
    return [
        [cell.strip().replace("`", "") for cell in line.strip("|").split("|")] for line in lines
    ]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands of the README can be typed."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "fixtures").symlink_to(ROOT / "fixtures")
    return folder


def test_examples_print_what_the_readme_says(place: Path) -> None:
    shown = [command for command in _commands() if "convert" in command.words and command.output]
    assert len(shown) >= 2
    for command in shown:
        done = run_mlbatch(list(command.words[1:]), place)
        assert (done.returncode, done.stderr) == (0, "")
        assert TIMES.sub("", done.stdout) == TIMES.sub("", command.output)


def test_every_command_of_the_readme_exists() -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for command in _commands():
        program, *arguments = command.words
        if program == "make":
            assert set(arguments) <= targets
        elif program == "mlbatch":
            options = {word for word in arguments[1:] if word.startswith("-")}
            assert options <= {"-o", *OPTIONS[arguments[0]]}, command.words
        else:
            assert program in ("python3", ".venv/bin/pip"), command.words


def test_python_examples_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    blocks = _blocks("python")
    assert blocks
    for block in blocks:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(block, "README.md", "exec"), {})
        assert printed.getvalue()


def test_the_rig_of_the_readme_is_one(tmp_path: Path) -> None:
    (block,) = _blocks("yaml")
    for name in ("left.json", "right.json"):
        (tmp_path / name).symlink_to(ROOT / "fixtures" / "two_lidars" / name)
    (tmp_path / "rig.yaml").write_text(block, encoding="utf-8")
    shown = read_rig(tmp_path / "rig.yaml")
    real = read_rig(ROOT / RIG)
    for left, right in zip(shown.sensors, real.sensors, strict=True):
        assert (left.name, left.stream) == (right.name, right.stream)
        assert isinstance(left.extrinsics, np.ndarray)
        assert isinstance(right.extrinsics, np.ndarray)
        np.testing.assert_array_equal(left.extrinsics, right.extrinsics)


def test_the_table_of_sensors_is_up_to_date(tmp_path: Path) -> None:
    """It is made of the models, never written by hand."""
    copy = tmp_path / "README.md"
    copy.write_text(README, encoding="utf-8")
    run_python(f"import runpy, sys; sys.argv[1:] = [{str(copy)!r}]\n{MAKE_TABLE}")
    assert copy.read_text(encoding="utf-8") == README, "run python docs/sensors_table.py"


def test_the_table_of_sensors_names_every_model() -> None:
    table = README.partition("<!-- sensors:")[2].partition("<!-- end of sensors")[0]
    for model in models():
        row = next(row for row in _rows(table) if model.name in re.split(r", | \(", row[1]))
        assert (row[0], row[-1]) == (model.vendor, model.verified)
        assert f"| {model.verified} | " in README, "say what the word means"


@pytest.mark.parametrize("name", CLOUD_LAYOUTS)
def test_layouts_are_described(name: str) -> None:
    layout = CLOUD_LAYOUTS[name]
    short = next(row for row in _rows(README) if row[0] == name)
    assert re.sub(r" \([^)]*\)", "", short[1]) == ", ".join(f.name for f in layout.fields)
    assert short[2] == str(layout.step)
    fields = [f"{f.name} {np.dtype(f.dtype).name} {f.offset}" for f in layout.fields]
    assert [name, ", ".join(fields), str(layout.step)] in _rows(_page("formats.md"))


def test_formats_are_described() -> None:
    titles = re.findall(r"^## (\w+)", _page("formats.md"), re.MULTILINE)
    assert {title.lower() for title in titles} >= set(format_names())


def test_every_container_is_named() -> None:
    for reader in readers():
        assert reader.CONTAINER in README


def test_every_consumer_and_its_version_is_on_its_page() -> None:
    page = _page("consumers.md")
    for environment in ENVIRONMENTS.values():
        for package in environment.packages:
            name, _, version = package.replace("==", "@").rpartition("@")
            # What a program needs and none of its own is left out.
            if name and name not in ("@mcap/nodejs", "@foxglove/rosmsg"):
                assert version in page, package


def _first_cells(page: str) -> set[str]:
    return {name for row in _rows(page) for name in row[0].split(", ")}


def test_every_npz_key_and_ply_property_is_described(place: Path) -> None:
    known = _first_cells(_page("formats.md"))
    done = run_mlbatch(["convert", FIXTURE, "--rig", RIG, "-o", "n"], place)
    assert done.returncode == 0, done.stderr
    with np.load(place / "n" / "000000.npz") as scan:
        assert set(scan.files) <= known
    assert {field.name for field in PLY_LAYOUT.fields} <= known
    head = (place / "n" / "scans.csv").read_text(encoding="utf-8").splitlines()[0]
    for column in head.split(","):
        name = re.sub(r"_(left|right)$", "_<sensor>", column)
        assert f"`{name}`" in _page("formats.md")


@pytest.mark.parametrize("kind", ["CAPTURE", "PACKET", "COLUMN", "IMU"])
def test_every_reason_is_described(kind: str) -> None:
    reasons = getattr(ledger, f"{kind}_REASONS")
    assert set(reasons) <= _first_cells(_page("report.md"))


def test_every_key_of_the_report_is_described() -> None:
    selection = SensorSelection(rig=ROOT / RIG)
    _, inputs = convert(Job((ROOT / FIXTURE,), selection), None)
    page = _page("report.md")
    words = set(re.findall(r"\w+", " ".join(re.findall(r"`[^`]+`", page))))
    assert set(_keys(build_report(inputs))) <= words


def _keys(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield str(key)
            yield from _keys(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _keys(inner)


def test_every_warning_is_described() -> None:
    source = "".join(path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py"))
    codes = set(re.findall(r'\bNote\(\s*"(\w+)"', source))
    assert codes
    assert codes <= _first_cells(_page("report.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_module_is_on_the_map() -> None:
    page = _page("architecture.md")
    for path in PACKAGE.iterdir():
        if path.is_dir() and (path / "__init__.py").exists():
            assert f"`{path.name}/`" in page, path.name
        elif path.suffix == ".py" and not path.name.startswith("_"):
            assert f"`{path.name}`" in page, path.name


def test_the_example_of_a_writer_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Saved in a folder of formats, as the page says, it is found and writes every point."""
    (example,) = re.findall(r"^```python\n(.*?)^```$", _page("add-a-writer.md"), re.M | re.S)
    (tmp_path / "rawf32.py").write_text(example, encoding="utf-8")
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path)])
    writers.format_names.cache_clear()
    try:
        job = Job((ROOT / FIXTURE,), SensorSelection(rig=ROOT / RIG), extras=frozenset())
        options = writers.WriterOptions()
        target = tmp_path / "scans"
        _, report = convert(job, lambda info: writers.open_writer("rawf32", target, info, options))
    finally:
        writers.format_names.cache_clear()
    files = sorted(target.glob("*.rawf32"))
    assert len(files) == report.scans.written
    assert sum(path.stat().st_size for path in files) == 16 * report.scans.points > 0
