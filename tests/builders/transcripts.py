"""Transcripts of the command line: a name, a command, the line that it says, its exit code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.builders.sessions import REPOSITORY, Shell

FOLDER = REPOSITORY / "tests" / "cli" / "mistakes"
_CASE = re.compile(r"^# (.+)\n\$ mlbatch (.+)\n(.+)\nexit (\d+)$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Transcript:
    """A command, the line that it says on stderr ({*}: any words), and its exit code."""

    words: str
    line: str
    code: int

    def check(self, shell: Shell, folder: Path) -> None:
        """Run it in a folder; nothing but the line may result."""
        before = _files(folder)
        outcome = shell(self.words)
        assert outcome.out == ""
        (line,) = [line for line in outcome.err.splitlines() if "warning" not in line]
        pattern = ".*".join(map(re.escape, self.line.split("{*}")))
        assert re.fullmatch(pattern, line), line
        assert outcome.code == self.code
        assert _files(folder) == before


def transcripts(name: str) -> Mapping[str, Transcript]:
    """Those of a file, by their names."""
    text = (FOLDER / f"{name}.txt").read_text(encoding="utf-8")
    found = {
        name: Transcript(words, line, int(code)) for name, words, line, code in _CASE.findall(text)
    }
    assert len(found) == text.count("\n$ ")
    return found


def _files(folder: Path) -> list[Path]:
    """All files under a final name."""
    return sorted(path for path in folder.rglob("*") if ".partial" not in str(path))
