"""docs/python.md and docs/plugins.md name what the interface has (test_blocks.py runs them)."""

from __future__ import annotations

import re

import pytest

import mlbatch
from mlbatch import api
from tests.contract.tree import ROOT

PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
PLUGINS = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")


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
