"""Content of an installation, from pyproject.toml, without a build."""

from __future__ import annotations

import ast
import fnmatch
import importlib
import re
import sys
from pathlib import Path
from typing import TypeAlias, cast

import yaml

import mlbatch
from tests.contract.tree import PACKAGE, ROOT, modules

Table: TypeAlias = dict[str, "Table | list[str] | str"]
# Distributions whose module has another name.
MODULE_OF = {"pyyaml": "yaml"}


def _settings(*keys: str) -> Table:
    # tomllib came with 3.11; mypy brings tomli where it is missing.
    reader = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    table: Table = reader.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for key in keys:
        table = cast(Table, table[key])
    return table


def test_the_types_travel_with_the_package() -> None:
    data = _settings("tool", "setuptools", "package-data")
    assert "py.typed" in data["mlbatch"]
    assert (PACKAGE / "py.typed").is_file()


def test_every_asset_travels_with_the_package() -> None:
    data = _settings("tool", "setuptools", "package-data")["mlbatch"]
    assets = [path for suffix in ("css", "js") for path in PACKAGE.rglob(f"*.{suffix}")]
    assert assets
    assert {path.relative_to(PACKAGE).as_posix() for path in assets} <= set(data)


def test_every_package_is_found() -> None:
    include = cast(list[str], _settings("tool", "setuptools", "packages", "find")["include"])
    packages = {"mlbatch", *(f"mlbatch.{path.parent.name}" for path in PACKAGE.glob("*/*.py"))}
    for package in packages:
        assert any(fnmatch.fnmatch(package, pattern) for pattern in include), package
    assert not any(fnmatch.fnmatch("tests", pattern) for pattern in include)


def test_the_command_is_what_it_says() -> None:
    assert _settings("project", "scripts")["mlbatch"] == "mlbatch.cli:main"
    assert _settings("tool", "setuptools", "dynamic")["version"] == {"attr": "mlbatch.__version__"}
    assert re.fullmatch(r"\d+\.\d+\.\d+", mlbatch.__version__)


def test_the_lowest_versions_are_those_that_are_tested() -> None:
    extras = _settings("project", "optional-dependencies")
    lists = (_settings("project")["dependencies"], *extras.values())
    requirements = [text for one in lists for text in cast(list[str], one)]
    found = [re.match(r"([\w-]+)>=([\d.]+)", text) for text in requirements]
    bounds = {one[1]: one[2] for one in found if one is not None}
    lines = (ROOT / ".ci" / "lowest.txt").read_text(encoding="utf-8").splitlines()
    tested = dict(line.split("==") for line in lines if not line.startswith("#"))
    optional = [*cast(list[str], extras["fast"]), *cast(list[str], extras["las"])]
    needed = [*cast(list[str], lists[0]), *optional, "dpkt"]
    names = [re.split(r"[^\w-]", text, maxsplit=1)[0] for text in needed]
    assert tested == {name: bounds[name] for name in names}


def test_the_package_needs_exactly_what_it_imports() -> None:
    needed = _modules_of(cast(list[str], _settings("project")["dependencies"]))
    extras = _settings("project", "optional-dependencies")
    lists = [cast(list[str], names) for extra, names in extras.items() if extra != "dev"]
    optional = {name for one in lists for name in _modules_of(one)}
    # The programs of peers run in an interpreter of their own, with what the peer brings.
    own = [module for module in modules() if module.name != "bench.programs"]
    found = {_top(node) for module in own for node in ast.walk(module.tree)} - {""}
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


def test_licence_and_readme_are_there() -> None:
    assert "MIT License" in Path(ROOT / "LICENSE").read_text(encoding="utf-8")
    assert _settings("project")["license"] == {"file": "LICENSE"}
    assert (ROOT / str(_settings("project")["readme"])).is_file()


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


def test_the_changelog_has_this_version() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## {mlbatch.__version__}\n" in changes
    assert "## Unreleased\n" in changes


def test_the_engine_is_built_from_all_its_sources() -> None:
    """A missing one would fail quietly, since the extension is optional."""
    (extension,) = cast(list[dict[str, list[str]]], _settings("tool", "setuptools")["ext-modules"])
    native = PACKAGE / "native"
    names = [path.relative_to(PACKAGE.parent).as_posix() for path in sorted(native.glob("*.c"))]
    assert extension["sources"] == names
    assert extension["depends"] == ["mlbatch/native/native.h"]


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
    extras = set(_settings("project", "optional-dependencies")) - {"dev", "docs", "compiler"}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "pip install '.[las]'" in readme
    assert extras <= set(re.findall(r"`(\w+)`", readme.partition("## Use")[0]))
