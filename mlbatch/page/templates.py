"""The pages as templates, with one frame and one set of parts; every value in them is escaped."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

import mlbatch

if TYPE_CHECKING:
    from jinja2 import Environment


def render(name: str, **values: object) -> str:
    """The text of a page; values: for its template."""
    return _environment().get_template(name).render({"version": mlbatch.__version__} | values)


@dataclass(frozen=True, slots=True)
class Verdict:
    """The first words of a page; level: good, note, warning or problem."""

    level: str
    label: str
    heading: str
    others: str
    summary: str = ""


def asset(name: str) -> str:
    """Text of a file of this package."""
    return resources.files("mlbatch.page").joinpath(name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    # Imported on demand: most runs write no page.
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    found = Environment(
        loader=FunctionLoader(asset),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    found.filters["tenth"] = "{:.1f}".format
    found.globals["asset"] = asset
    return found
