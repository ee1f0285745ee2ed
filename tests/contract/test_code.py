"""Rules of the repository that ruff (pyproject.toml) does not check."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import LONG, LOWEST, POSES, SECONDS
from tests.contract.tree import PACKAGE, ROOT, Module, modules, plugins

MODULES = modules()
# What a plug-in's docstring names: a specification, a manual, or the page of facts.
SOURCE = re.compile(r"docs/sources/\w+\.md|RFC \d+|draft-[\w-]+|APPNOTE|Source: ")
DOTTED = re.compile(r"`([A-Z]\w+)\.([a-z]\w*)")

Function = ast.FunctionDef | ast.AsyncFunctionDef


def _by_name(module: Module) -> str:
    return module.name or "mlbatch"


def test_comments_name_attributes_that_are_there() -> None:
    """`Class.attribute` of the package in comments, docstrings and pages."""
    known: dict[str, set[str]] = {}
    for module in MODULES:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                known.setdefault(node.name, set()).update(_attributes(node))
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    for path in [*(module.path for module in MODULES), *pages]:
        for name, attribute in DOTTED.findall(path.read_text(encoding="utf-8")):
            assert attribute in known.get(name, {attribute}), f"{path}: {name}.{attribute}"


def _attributes(node: ast.ClassDef) -> Iterator[str]:
    """Methods, fields and what methods set."""
    for inner in ast.walk(node):
        if isinstance(inner, Function):
            yield inner.name
        elif isinstance(inner, ast.AnnAssign | ast.Assign):
            targets = [inner.target] if isinstance(inner, ast.AnnAssign) else inner.targets
            yield from (ast.unparse(target).removeprefix("self.") for target in targets)


@pytest.mark.parametrize("plugin", plugins(), ids=_by_name)
def test_a_plugin_names_its_source(plugin: Module) -> None:
    docstring = ast.get_docstring(plugin.tree) or ""
    assert SOURCE.search(docstring), f"{plugin.path}: name the specification that it follows"


@pytest.mark.parametrize("plugin", plugins(), ids=_by_name)
def test_a_plugin_has_tests_and_something_to_test_with(plugin: Module) -> None:
    tests = _tests_of(plugin)
    assert tests, f"{plugin.path}: expected tests of it, found none"
    assert _material(plugin), f"{plugin.path}: expected an encoder or a builder, found none"


def _tests_of(plugin: Module) -> list[Path]:
    """Test files of a vendor, or those with a row of a format."""
    package, *_, name = plugin.name.split(".")
    if package == "sensors":
        return sorted((ROOT / "tests" / Path(*plugin.name.split(".")[:2])).glob("test_*.py"))
    # A row of a table, or one of several values; a key of an array, ["xyz"], is neither.
    words = (
        rf"test_{name}",
        rf"write_{name}\b",
        rf"\.formats\.{name}\b",
        rf'"{name}"(?=: [_{{]|,)',
    )
    row = re.compile("|".join(words))
    files = sorted((ROOT / "tests" / package).rglob("test_*.py"))
    return [path for path in files if row.search(path.name) or row.search(_text(path))]


def _material(plugin: Module) -> bool:
    """True if an encoder or a builder makes inputs for the tests of a plug-in."""
    package, *_, name = plugin.name.split(".")
    builders = ROOT / "tests" / "builders"
    if package == "writers":  # Their input is a Scan, made by one builder for all.
        return (builders / "scans.py").is_file()
    if package == "sensors":
        name = plugin.name.split(".")[1]
        # Clouds are messages, not packets.
        name = "points" if name == "pointcloud" else name
        if (PACKAGE / "simulate" / name / "encode.py").is_file():
            return True
    if any(f"def write_{name}(" in _text(path) for path in builders.glob("*.py")):
        return True
    return (builders / f"{name}.py").is_file()


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def test_every_fixture_names_its_source() -> None:
    listed = _text(ROOT / "fixtures" / "README.md")
    for folder in (ROOT / "fixtures").iterdir():
        if folder.is_dir():
            source = _text(folder / "SOURCE.md")
            assert {"Origin", "Licence"} <= set(re.findall(r"\w+", source)), folder
            assert f"[{folder.name}]({folder.name}/SOURCE.md)" in listed


def test_every_folder_of_the_package_is_a_package() -> None:
    for path in PACKAGE.rglob("*.py"):
        assert (path.parent / "__init__.py").is_file(), path.parent


@pytest.mark.parametrize("entry", [*LONG, *LOWEST, *POSES, *SECONDS])
def test_long_suites_are_there(entry: str) -> None:
    """A folder or file that has moved would be back in `make test-quick`."""
    place, _, function = entry.partition("::")
    path = ROOT / "tests" / place
    assert path.exists()
    assert not function or f"def {function}" in path.read_text(encoding="utf-8")
