"""The pages as templates, with one frame and one set of parts; every value in them is escaped."""

from __future__ import annotations

import base64
import hashlib
import json
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


def page_json(value: object) -> str:
    """JSON that cannot end its script element."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


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
    found.filters["digest"] = _digest
    found.globals["asset"] = asset
    return found


def _digest(script: str) -> str:
    """SHA-256 of a script for the content security policy, base64."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
