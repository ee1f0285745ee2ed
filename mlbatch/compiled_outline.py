"""Outlines of scans by a compiled loop: what `outline.py` tells, in one pass."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch._compiled_tables import Tables
from mlbatch.buffers import Due
from mlbatch.geometry import SECTORS
from mlbatch.kernels import frame as at
from mlbatch.kernels.native import load
from mlbatch.outline import Outline, Outliner

_SOURCE = "mlbatch.kernels._outline_source"


class CompiledOutliner(Outliner):
    """The same; numpy tells where a position lies beyond the turn."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        super().__init__(positions)
        self._kernel = load(_SOURCE, SECTORS)
        self._figures = np.zeros((len(positions), at.OUTLINE_FIGURES), np.int64)
        self._tables = tables = Tables(at.OUTLINE_SIZE)
        tables.set_numbers({at.OUTLINE_SENSORS: len(positions)})
        for place, values in (
            (at.OUTLINE_POSITIONS, np.array([one or 0 for one in positions], np.int64)),
            (at.OUTLINE_PASSES, np.zeros((len(positions), SECTORS), np.int64)),
            (at.OUTLINE_FOUND, self._figures),
        ):
            tables.set(place, values)

    def outlines(self, due: Due) -> list[Outline]:
        """Of each sensor."""
        self._tables.set_numbers({at.OUTLINED: len(due)})
        for place, values in (
            (at.OUTLINE_STAMP_NS, due.stamp_ns),
            (at.OUTLINE_SENSOR, due.sensor),
            (at.OUTLINE_ENCODER, due.encoder),
        ):
            self._tables.set(place, np.asarray(values, np.int64))
        if self._kernel(self._tables.frame):
            return super().outlines(due)
        return [
            Outline(columns, gap_ns, once / SECTORS, again / SECTORS)
            for columns, gap_ns, once, again, *_ in self._figures.tolist()
        ]
