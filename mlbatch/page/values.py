"""Values of a report by path; a report may come from another version, or be damaged."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float | bool | None"


@dataclass(frozen=True, slots=True)
class Values:
    """A JSON value, and what it contains; values of another type count as absent."""

    root: Json

    def at(self, *path: str) -> Values:
        """The value under keys."""
        found = self.root
        for key in path:
            found = found.get(key) if isinstance(found, dict) else None
        return Values(found)

    def text(self, *path: str) -> str:
        """A text or number as text; "" if absent."""
        found = self.at(*path).root
        if isinstance(found, (dict, list)) or found is None:
            return ""
        return str(found)

    def number(self, *path: str) -> float | None:
        """A finite number; None if absent."""
        found = self.at(*path).root
        if isinstance(found, bool) or not isinstance(found, (int, float)):
            return None
        try:
            value = float(found)
        except OverflowError:
            return None
        return value if math.isfinite(value) else None

    def count(self, *path: str) -> int:
        """A count; 0 if absent."""
        return max(0, round(self.number(*path) or 0))

    def items(self, *path: str) -> list[Values]:
        """The items of a list; none if absent."""
        found = self.at(*path).root
        return [Values(one) for one in found] if isinstance(found, list) else []

    def counts(self, *path: str) -> dict[str, int]:
        """Counts by reason."""
        found = self.at(*path)
        return {key: found.count(key) for key in found.names()}

    def names(self) -> Iterator[str]:
        """The keys of an object."""
        if isinstance(self.root, dict):
            yield from self.root
