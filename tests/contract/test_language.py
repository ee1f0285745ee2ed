"""Words of the code and the pages: plain technical English, references that exist."""

from __future__ import annotations

import re
from pathlib import Path

from tests.contract.tree import PACKAGE, ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
SOURCES = sorted([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.[ch]")])
TESTS = sorted((ROOT / "tests").rglob("*.py"))
# A private idiom that was removed, with what to write instead.
IDIOM = {
    r"told|tells?": "report, contain, describe",
    r"beside": "next to, in the directory of",
    r"befalls?": "affect",
    r"whose word": "source",
    r"what (?:becomes|became|comes) of": "name the result",
    r"at hand": "available",
    r"ways? on": "remedy",
    r"go(?:es)? on|went on|going on": "continue",
    r"takes or leaves": "accepts or rejects",
    r"pass(?:es|ing)? by": "forward",
    r"stays open": "not checkable",
    r"makers?": "vendor",
    r"recorders?": "capture host",
    r"echo(?:es)?": "return",
    r"wanted|wants": "expected",
}
WORDS = re.compile("|".join(rf"\b(?:{pattern})\b" for pattern in IDIOM), re.IGNORECASE)
# Fixed names: functions of typer and of files, fields of JSON documents and of a vendor's format.
FOREIGN = re.compile(
    r"typer\.echo|\btell\(|`tell`|[`\"](?:maker|wanted)[`\"]"
    r"|[`\"'](?:[\w.]*_)?echo(?:es)?[\w.]*[`\"']"
)
# Pages that the repository does not have, and the old place of the sources.
OUTSIDE = re.compile(
    r"\b(?:STYLE|CONTRACT|ARCHITECTURE|REDESIGN)\.md|\bfacts/\w+\.md|\.\./shared/\w+\.md"
)
CITED = re.compile(r"(?<![\w/])docs/((?:sources/)?[\w-]+)\.md(?:,? sections? (\d+))?")


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_private_idiom_is_gone() -> None:
    """But for pages that quote the manuals of vendors."""
    found = [
        f"{_name(path)}:{number}: {words[0]!r} in: {line.strip()}"
        for path in [*SOURCES, *PAGES]
        if not path.is_relative_to(ROOT / "docs" / "sources")
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if (words := WORDS.search(FOREIGN.sub("", line)))
    ]
    assert found == []


def test_references_have_a_target() -> None:
    for path in [*SOURCES, *TESTS, *PAGES]:
        text = path.read_text(encoding="utf-8")
        outside = None if path == Path(__file__) else OUTSIDE.search(text)
        assert outside is None, f"{_name(path)}: {outside and outside[0]}"
        for page, section in CITED.findall(text):
            target = ROOT / "docs" / f"{page}.md"
            assert target.is_file(), f"{_name(path)}: docs/{page}.md"
            heading = re.compile(rf"^#+ (?:Section )?{section}\b", re.MULTILINE)
            assert not section or heading.search(target.read_text(encoding="utf-8")), (
                f"{_name(path)}: docs/{page}.md, section {section}"
            )
