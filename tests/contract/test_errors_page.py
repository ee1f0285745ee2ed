"""Messages of docs/reference/errors.md are those of the package."""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest

from tests.contract.tree import ROOT, modules

PAGE = (ROOT / "docs" / "reference" / "errors.md").read_text(encoding="utf-8")
MESSAGES = re.findall(r"^> `(.+)`$", PAGE, re.MULTILINE)


@cache
def _texts() -> set[str]:
    """All texts of the package; a value in one is {}."""
    found = set()
    for module in modules():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.JoinedStr):
                parts = [
                    one.value if isinstance(one, ast.Constant) else "{}" for one in node.values
                ]
                found.add("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
    return found


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_of_the_page_is_one_of_the_package(message: str) -> None:
    # Several options may share a text.
    shared = re.sub(r"^--[\w-]+", "{}", message)
    assert any(message in text or shared in text for text in _texts())


def test_every_error_has_its_message_and_remedy() -> None:
    sections = re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]
    assert len(sections) == len(MESSAGES) == len(set(MESSAGES)) >= 15
    for section in sections:
        assert "**What to do:**" in section, section.splitlines()[0]
