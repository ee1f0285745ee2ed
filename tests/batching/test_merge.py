"""Columns of all sensors in one order, and their figures: by sorting, and by hand."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.batching.merge import ColumnMerge
from mlbatch.lidar.geometry import SECTORS
from mlbatch.types import NO_COLUMNS, ColumnFigures, WindowColumns

POSITIONS = (1024, None, 512)
BASE_NS = 1_700_000_000_000_000_000


def _random(seed: int, count: int, most: int) -> WindowColumns:
    """Rotor positions at random, with rotor words of any speed and table."""
    rng = np.random.default_rng(seed)
    sensor = rng.integers(0, len(POSITIONS), count)
    stamp_ns = BASE_NS + np.sort(rng.integers(0, 100_000_000, count))
    position = rng.integers(0, 7) + np.arange(count) // rng.integers(1, 9) % most
    word = rng.integers(-(1 << 63), (1 << 63) - 1, count)
    encoder: I64Array = np.where(sensor == 1, word, position)
    return WindowColumns(stamp_ns, sensor, np.arange(count), encoder)


def _counted(columns: WindowColumns, number: int) -> ColumnFigures:
    """Figures of a sensor by their definitions, column by column."""
    positions = POSITIONS[number]
    rows = [at for at in range(len(columns)) if columns.sensor[at] == number]
    if not rows:
        return NO_COLUMNS
    passes = [0] * SECTORS
    before = None
    for at in rows:
        word = int(columns.encoder[at])
        ticks, turn = (word % 2**32, 2**32) if positions is None else (word, positions)
        sector = min(ticks * SECTORS // turn, SECTORS - 1)
        passes[sector] += sector != before
        before = sector
    stamps = [int(columns.stamp_ns[at]) for at in rows]
    gap_ns = max((b - a for a, b in pairwise(stamps)), default=0)
    once, again = (sum(one > most for one in passes) / SECTORS for most in (0, 1))
    return ColumnFigures(len(rows), gap_ns, once, again, stamps[0], stamps[-1])


@pytest.mark.parametrize("most", [500, 2000])
@pytest.mark.parametrize("count", [0, 1, 2, 17, 3000])
@pytest.mark.parametrize("seed", range(3))
def test_figures_are_those_of_their_definitions(seed: int, count: int, most: int) -> None:
    """most: positions beyond the revolution of a sensor are in its last sector."""
    columns = _random(seed, count, most)
    ends = sorted({count // 5, count // 3, count} - {0})
    found = ColumnMerge(POSITIONS).figures(columns, ends)
    for window, begin, end in zip(found, [0, *ends], ends, strict=False):
        part = columns.take(slice(begin, end))
        assert list(window) == [_counted(part, number) for number in range(len(POSITIONS))]
