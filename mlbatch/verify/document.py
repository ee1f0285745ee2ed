"""A JSON document whose values are asked for by path; what is not there is blamed once."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias, cast

from mlbatch.verify.verdict import Judge, VerifyError

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float | bool | None"


@dataclass(slots=True)
class Document:
    """A report; `check`: what is blamed where a value is missing or of another kind."""

    judge: Judge
    where: str
    root: Json
    check: str = "ledger"
    _blamed: set[str] = field(default_factory=set)

    @classmethod
    def parsed(cls, judge: Judge, path: Path, text: str, where: str = "") -> Document:
        """A document from its text; where: in the file at `path`, if that holds more."""
        try:
            return cls(judge, where or path.name, cast(Json, json.loads(text)))
        except (ValueError, RecursionError) as err:
            raise VerifyError(
                f"{path}: wanted a report in JSON, got {err}; restore it, or convert again"
            ) from err

    def at(self, *path: str | int) -> Json:
        """The value at a path; None if there is none."""
        value = self.root
        for step in path:
            if isinstance(value, dict) and isinstance(step, str):
                value = value.get(step)
            elif isinstance(value, list) and isinstance(step, int) and step < len(value):
                value = value[step]
            else:
                return None
        return value

    def name(self, *path: str | int) -> str:
        """A place as a person finds it."""
        return f"{self.where} {'.'.join(map(str, path))}"

    def number(self, *path: str | int) -> int | None:
        """A whole number of 0 or more."""
        value = self.at(*path)
        if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
            return value
        self._refuse("a whole number of 0 or more", value, path)
        return None

    def text(self, *path: str | int) -> str | None:
        """A text."""
        value = self.at(*path)
        if isinstance(value, str):
            return value
        self._refuse("a text", value, path)
        return None

    def counts(self, *path: str | int) -> dict[str, int]:
        """Numbers by their reason."""
        value = self.at(*path)
        if not isinstance(value, dict):
            self._refuse("counts by reason", value, path)
            return {}
        found = {reason: self.number(*path, reason) for reason in value}
        return {reason: count for reason, count in found.items() if count is not None}

    def length(self, *path: str | int) -> int:
        """Entries of a list."""
        value = self.at(*path)
        if isinstance(value, list):
            return len(value)
        self._refuse("a list", value, path)
        return 0

    def _refuse(self, wanted: str, value: Json, path: tuple[str | int, ...]) -> None:
        name = self.name(*path)
        if name not in self._blamed:
            self._blamed.add(name)
            self.judge.blame(self.check, name, wanted, "nothing" if value is None else value)
