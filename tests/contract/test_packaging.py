"""Content of an installation: pyproject.toml, and a wheel that is built here."""

from __future__ import annotations

import ast
import importlib
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import TypeAlias, cast

import pytest
import yaml

import mlbatch
from tests.contract.tree import PACKAGE, ROOT, modules

Table: TypeAlias = dict[str, "Table | list[str] | str"]
# Distributions whose module has another name.
MODULE_OF = {"pyyaml": "yaml"}
# Extras for work on the package.
DEVELOPMENT = frozenset({"dev", "dev-integrations", "docs"})
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


def _settings(*keys: str) -> Table:
    # tomllib came with 3.11; mypy brings tomli where it is missing.
    reader = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    table: Table = reader.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for key in keys:
        table = cast(Table, table[key])
    return table


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built by the project's own files from the files of the project."""
    folder = tmp_path_factory.mktemp("wheel")
    words = ["-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


@needs_compiler
def test_a_wheel_has_every_module_and_asset_and_the_library(built: Path) -> None:
    with zipfile.ZipFile(built) as archive:
        names = {name for name in archive.namelist() if name.startswith("mlbatch/")}
    suffixes = (".py", ".h", ".css", ".js", ".yaml", ".typed", ".html")
    files = {
        path for path in PACKAGE.rglob("*") if path.suffix in suffixes or path.name == "py.typed"
    }
    expected = {path.relative_to(ROOT).as_posix() for path in files}
    assert names == expected | {"mlbatch/native/_native.so"}


@needs_compiler
def test_a_wheel_is_for_every_python_of_its_platform(built: Path) -> None:
    assert re.fullmatch(r"[\w.]+-[\w.]+-py3-none-\w+\.whl", built.name)


def test_a_build_asks_for_a_compiler_only_where_none_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hook = runpy.run_path(str(ROOT / ".ci" / "build_library.py"))
    ask = hook["LibraryHook"].dependencies
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert ask(None) == ["ziglang>=0.13"]
    (tmp_path / "gcc").write_text("#!/bin/sh\n")
    (tmp_path / "gcc").chmod(0o755)
    assert ask(None) == []
    (tmp_path / "gcc").unlink()
    monkeypatch.setenv("CC", "zig cc")
    assert ask(None) == []


def test_the_lowest_versions_are_those_that_are_tested() -> None:
    extras = _settings("project", "optional-dependencies")
    lists = (_settings("project")["dependencies"], *extras.values())
    requirements = [text for one in lists for text in cast(list[str], one)]
    found = [re.match(r"([\w-]+)>=([\d.]+)", text) for text in requirements]
    bounds = {one[1]: one[2] for one in found if one is not None}
    lines = (ROOT / ".ci" / "lowest.txt").read_text(encoding="utf-8").splitlines()
    tested = dict(line.split("==") for line in lines if not line.startswith("#"))
    optional = cast(list[str], extras["las"])
    needed = [*cast(list[str], lists[0]), *optional, "dpkt"]
    names = [re.split(r"[^\w-]", text, maxsplit=1)[0] for text in needed]
    assert tested == {name: bounds[name] for name in names}


def test_the_package_needs_exactly_what_it_imports() -> None:
    needed = _modules_of(cast(list[str], _settings("project")["dependencies"]))
    extras = _settings("project", "optional-dependencies")
    lists = [cast(list[str], names) for extra, names in extras.items() if extra not in DEVELOPMENT]
    optional = {name for one in lists for name in _modules_of(one)}
    found = {_top(node) for module in modules() for node in ast.walk(module.tree)} - {""}
    # Only the type checker imports it, which brings it.
    foreign = found - set(sys.stdlib_module_names) - {"mlbatch", "typing_extensions"}
    assert needed <= foreign <= needed | optional


def _modules_of(requirements: list[str]) -> set[str]:
    names = {re.split(r"[^A-Za-z0-9_-]", text, maxsplit=1)[0].lower() for text in requirements}
    return {MODULE_OF.get(name, name) for name in names}


def _top(node: ast.AST) -> str:
    if isinstance(node, ast.Import):
        return node.names[0].name.partition(".")[0]
    if isinstance(node, ast.ImportFrom):
        return (node.module or "").partition(".")[0]
    if isinstance(node, ast.Call) and ast.unparse(node.func) == "importlib.import_module":
        name = node.args[0]
        # Without types of its own; a name that is not a constant is a plug-in.
        return str(name.value).partition(".")[0] if isinstance(name, ast.Constant) else ""
    return ""


def test_metadata_names_no_person_and_no_address() -> None:
    project = _settings("project")
    assert str(project["authors"]) == "[{'name': 'The mlbatch authors'}]"
    assert "urls" not in project
    assert f"Programming Language :: Python :: {sys.version_info[0]}" in project["classifiers"]


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == mlbatch.__version__
    paper = citation["preferred-citation"]
    names = ", ".join(author["family-names"] for author in paper["authors"])
    batching = " ".join((ROOT / "docs" / "batching.md").read_text(encoding="utf-8").split())
    assert f'{names} ({paper["year"]}), "{paper["title"]}"' in batching
    assert "doi" not in paper


def test_nothing_installs_the_package_of_others() -> None:
    """On PyPI `mlbatch` is another package; requirements and hints name the distribution."""
    assert _settings("project")["name"] == "mlbatch-lidar"
    foreign = re.compile(
        r"pip install [\"']?mlbatch(?![-\w])|\bmlbatch\[\w|dependencies = .*\"mlbatch[^-]"
    )
    folders = [ROOT / name for name in ("docs", "examples", "mlbatch", ".ci")]
    paths = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    paths += [
        ROOT / name for name in ("README.md", "CONTRIBUTING.md", "Makefile", "pyproject.toml")
    ]
    for path in paths:
        if path.suffix in (".py", ".md", ".toml", ".txt", ""):
            text = path.read_text(encoding="utf-8")
            assert not foreign.findall(text), path


def test_every_extra_is_in_the_readme() -> None:
    """With the command that installs it from a clone."""
    extras = set(_settings("project", "optional-dependencies")) - DEVELOPMENT
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "pip install '.[las]'" in readme
    assert extras <= set(re.findall(r"`(\w+)`", readme.partition("## Use")[0]))
