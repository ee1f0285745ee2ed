"""Transcripts of the command line: what is typed, what that prints, and how it exits.

A block begins with `# NAME`. Its lines `$ COMMAND` are typed one after another in one folder; below
each stand what it prints, {*} for any text, and `exit CODE` unless that is 0. Commands other than
`mlbatch` are those of a shell, as is one that its output is piped into. Text before the first block
is a comment.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tests.builders.sessions import REPOSITORY, Shell

FOLDER = REPOSITORY / "tests" / "cli" / "cases"
# Exit codes of commands that may leave an output: complete, beyond limits.
LEAVES_OUTPUT = (0, 3)


@dataclass(slots=True)
class Step:
    """A command, the lines that it prints (to stdout, then to stderr), and its exit code."""

    words: str
    lines: list[str] = field(default_factory=list)
    code: int = 0

    def check(self, shell: Shell, folder: Path) -> None:
        """Run it in a folder; a command that fails leaves no file under a final name."""
        if not self.words.startswith("mlbatch "):
            done = subprocess.run(["sh", "-c", self.words], capture_output=True, text=True)
            self._compare(done.stdout + done.stderr, done.returncode)
            return
        before = _files(folder, self.code)
        words, _, filtered_by = self.words.removeprefix("mlbatch ").partition(" | ")
        outcome = shell(words)
        printed = outcome.out
        if filtered_by:
            done = subprocess.run(
                ["sh", "-c", filtered_by], input=printed, capture_output=True, text=True
            )
            printed = done.stdout
        self._compare(printed + outcome.err, outcome.code)
        if outcome.code not in LEAVES_OUTPUT:
            assert _files(folder, self.code) == before

    def _compare(self, printed: str, code: int) -> None:
        found = [line for line in printed.splitlines() if line]
        if self.code and not any("warning" in line for line in self.lines):
            # Before an error that a case is about.
            found = [line for line in found if not line.startswith("mlbatch: warning: ")]
        pattern = "\n".join(".*".join(map(re.escape, one.split("{*}"))) for one in self.lines)
        text = "\n".join(found)
        assert re.fullmatch(pattern, text), f"{self.words}\n{text}\nexit {code}"
        assert code == self.code, f"{self.words}\n{text}"


@dataclass(frozen=True, slots=True)
class Transcript:
    """Commands, typed one after another."""

    steps: tuple[Step, ...]

    @property
    def code(self) -> int:
        """Exit code of the last one."""
        return self.steps[-1].code

    def check(self, shell: Shell, folder: Path) -> None:
        """Type all of them in a folder."""
        for step in self.steps:
            step.check(shell, folder)

    def check_with(self, inputs: Path, shell: Shell, folder: Path) -> None:
        """Type all of them in a folder with links to inputs."""
        for path in inputs.iterdir():
            (folder / path.name).symlink_to(path)
        self.check(shell, folder)


def transcripts(name: str, **variables: str) -> Mapping[str, Transcript]:
    """Return the transcripts of a file by name; variables: texts for `$NAME` in commands."""
    found: dict[str, list[Step]] = {}
    steps: list[Step] | None = None
    for line in (FOLDER / f"{name}.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("# "):
            assert line[2:] not in found, f"two blocks {line}"
            steps = found.setdefault(line[2:], [])
        elif steps is not None and line.startswith("$ "):
            words = line[2:]
            for variable, text in variables.items():
                words = words.replace(f"${variable}", text)
            steps.append(Step(words))
        elif steps and (code := re.fullmatch(r"exit (\d+)", line)):
            steps[-1].code = int(code[1])
        elif steps and line:
            steps[-1].lines.append(line)
    return {name: Transcript(tuple(steps)) for name, steps in found.items()}


def _files(folder: Path, code: int) -> list[Path]:
    """All files under a final name; with wrong usage (2) there are no others, either."""
    return sorted(path for path in folder.rglob("*") if code == 2 or ".partial" not in str(path))
