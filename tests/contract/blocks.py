"""Fenced blocks of the pages: where they are, whether they run, and what a console block types.

A block runs unless the line before it is `<!-- not run: REASON -->`. `<!-- needs MODULE -->` runs
it where the module is installed. All blocks of a page share one folder and one Python namespace.
"""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.contract.tree import ROOT

# sources/ quotes tables of manuals.
PAGES = (
    *sorted(ROOT.glob("*.md")),
    *sorted(path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "sources"),
    ROOT / "fixtures" / "README.md",
    ROOT / "examples" / "mlbatch-example" / "README.md",
)
# What is typed: console; scripts of a cluster, which never run here: bash; `text`: anything else.
LANGUAGES = ("console", "bash", "python", "yaml", "toml", "json", "text")
_FENCE = re.compile(r"^( *)```(.*)$")
_INFO = re.compile(r'^(\w*)(?: title="([\w./-]+)")?$')
_MARK = re.compile(r"^ *<!-- (not run|needs):? (.+) -->$")
_PUNCTUATION = "();<>|&"


@dataclass(frozen=True, slots=True)
class Command:
    """A line typed at a prompt; printed: what the page shows after it, "" if nothing."""

    line: str
    printed: str


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block; reason: why it does not run, or ""; needs: a module, or ""."""

    page: Path
    number: int
    language: str
    title: str
    text: str
    reason: str
    needs: str

    @property
    def place(self) -> str:
        """Page and line, for messages."""
        return f"{self.page.relative_to(ROOT).as_posix()}:{self.number}"

    def commands(self) -> list[Command]:
        """Lines after `$ ` of a console block, with what is printed below each; of a script all."""
        if self.language == "bash":
            return [Command(line, "") for line in self.text.splitlines()]
        found = []
        for part in re.split(r"^\$ ", self.text, flags=re.MULTILINE)[1:]:
            line, _, printed = re.sub(r" *\\\n *", " ", part).partition("\n")
            found.append(Command(line, printed))
        return found


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page, in order."""
    lines = page.read_text(encoding="utf-8").splitlines()
    number = 0
    while number < len(lines):
        fence = _FENCE.match(lines[number])
        if fence:
            end = next(i for i in range(number + 1, len(lines)) if lines[i].strip() == "```")
            yield _block(page, lines, number, end, fence[2])
            number = end
        number += 1


def _block(page: Path, lines: list[str], begin: int, end: int, info: str) -> Block:
    found = _INFO.match(info)
    assert found, f"{page.name}:{begin + 1}: expected ```LANGUAGE or with title=, found ```{info}"
    mark = _MARK.match(lines[begin - 1]) if begin else None
    words = (mark[1], mark[2]) if mark else ("", "")
    text = textwrap.dedent("\n".join(lines[begin + 1 : end])) + "\n"
    reason = words[1] if words[0] == "not run" else ""
    needs = words[1] if words[0] == "needs" else ""
    return Block(page, begin + 1, found[1], found[2] or "", text, reason, needs)


def calls(line: str, program: str) -> list[list[str]]:
    """Arguments of each call of a program in a line of a shell; a variable counts as 1."""
    lexer = shlex.shlex(
        re.sub(r"\$\{?\w+\}?", "1", line), posix=True, punctuation_chars=_PUNCTUATION
    )
    lexer.whitespace_split = True
    found: list[list[str]] = []
    inside = False
    starts = True
    for word in lexer:
        operator = set(word) <= set(_PUNCTUATION)
        if starts and word == program:
            found.append([])
        elif inside and not operator:
            found[-1].append(word)
        inside = not operator and bool(found) and (inside or (starts and word == program))
        starts = operator and word not in (">", ">>", "<")
    return found
