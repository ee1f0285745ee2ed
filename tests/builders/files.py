"""The files of an output as a writer sees them, for tests of writers alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass(slots=True)
class Noted:
    """A `FileSet`; due: by the index of a window; crcs: of files, by their place."""

    due: Callable[[int], bool] = lambda index: True
    crcs: dict[tuple[int, int, int | None], dict[str, int]] = field(default_factory=dict)
    is_continued: bool = False

    def is_due(self, index: int, slice_: int = 0, sensor: int | None = None) -> bool:
        """Whether a file is to be made."""
        return self.due(index)

    def made(
        self, crcs: Mapping[str, int], index: int, slice_: int = 0, sensor: int | None = None
    ) -> None:
        """Keep what is whole."""
        self.crcs[index, slice_, sensor] = dict(crcs)
