"""Metadata of a scan in the comments of its file: PLY, PCD and LAS have the same lines."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F32Array
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.metadata import RunMetadata

# Numbers of up to 19 digits: Python refuses very long ones.
_INDEX = re.compile(r"(-?\d{1,19}) slice (\d{1,19}) of (\d{1,19})", re.ASCII)


@dataclass(frozen=True, slots=True)
class ScanComments:
    """Comments by their first word."""

    by_name: dict[str, str]

    @classmethod
    def of_lines(cls, lines: Iterable[str]) -> ScanComments:
        """Comments from lines: a name, a blank, a value."""
        parts = (line.partition(" ") for line in lines)
        return cls({name.rstrip(":"): value for name, _, value in parts if value})

    def number(self, name: str) -> int:
        """A comment that is a number."""
        try:
            return int(self.by_name[name])
        except (KeyError, ValueError):
            found = self.by_name.get(name, "none")
            raise DamageError(f"comment {name} with a number", found) from None

    def place(self) -> tuple[int, int, int]:
        """Index, slice and slices."""
        text = self.by_name.get("index", "none")
        found = _INDEX.fullmatch(text)
        if found is None:
            raise DamageError("comment index I slice J of N", text)
        index, part, slices = map(int, found.groups())
        return index, part, slices

    def is_complete(self) -> bool:
        """Whether every sensor covers the window."""
        text = self.by_name.get("complete")
        if text not in ("true", "false"):
            raise DamageError("comment complete true or false", str(text))
        return text == "true"

    def fill(self) -> F32Array:
        """Fill by sensor; `unknown` is NaN."""
        text = self.by_name.get("fill", "none")
        try:
            return np.array(
                [math.nan if word == "unknown" else float(word) for word in text.split(" ")],
                np.float32,
            )
        except ValueError:
            raise DamageError("comment fill with a number for each sensor", text) from None

    def metadata(self, log: CheckLog | None = None, where: str = "") -> RunMetadata:
        """Metadata of the run; log: for words that are unknown."""
        _, _, slices = self.place()
        _, _, names = self.by_name.get("lidar_id", "").partition("from 0: ")
        sensors = tuple(names.split(" ")) if names else None
        return RunMetadata.of(log or CheckLog(), where, self.by_name, sensors, slices=slices)
