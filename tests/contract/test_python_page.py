"""The blocks of docs/python.md run, one after another, as someone would type them."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import re
from pathlib import Path

import pytest

import mlbatch
from mlbatch import api
from tests.contract.tree import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
PLUGINS = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
# A second word is the package that a block needs.
BLOCK = re.compile(r"^```python ?(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BLOCKS = [(match[1], match[2]) for match in BLOCK.finditer(PAGE)]


def test_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fixtures").symlink_to(ROOT / "fixtures")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    assert len(BLOCKS) >= 7
    for package, text in BLOCKS:
        code = compile(text, "docs/python.md", "exec")
        if package and importlib.util.find_spec(package) is None:
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        assert printed.getvalue()


@pytest.mark.parametrize("name", sorted(set(mlbatch.__all__) - {"MlbatchError", "Run", "Scan"}))
def test_every_name_is_described(name: str) -> None:
    assert re.search(rf"`(mlbatch\.)?{name}\b", PAGE), name


def test_the_example_of_a_package_is_that_of_the_page() -> None:
    (block,) = re.findall(r"^```toml\n(.*?)^```$", PLUGINS, re.MULTILINE | re.DOTALL)
    project = ROOT / "examples" / "mlbatch-example" / "pyproject.toml"
    assert block in project.read_text(encoding="utf-8")


def test_options_have_the_names_of_the_command() -> None:
    """Those of Python that are none of the command: what the command has as arguments."""
    import inspect

    from tests.contract.test_help import OPTIONS

    known = {option.removeprefix("--").replace("-", "_") for option in OPTIONS["convert"]}
    known |= {"recording", "recordings", "output", "exclude_boxes", "copy_topics", "fsync"}
    for function in (api.open, api.scans, api.convert):
        assert set(inspect.signature(function).parameters) <= known, function.__name__
