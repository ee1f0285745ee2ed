"""Column statistics by the compiled loops equal those by numpy, for any columns."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.decode.coverage import ColumnStatistics, ColumnStats
from mlbatch.decode.native_engine import NativeColumnStatistics
from mlbatch.decode.scan_buffer import WindowColumns
from tests.builders.engines import needs_native

pytestmark = needs_native

POSITIONS = (1024, None, 512)


def columns(seed: int, count: int, most: int) -> WindowColumns:
    """Rotor positions at random, with rotor words of any speed and table."""
    rng = np.random.default_rng(seed)
    sensor = rng.integers(0, len(POSITIONS), count)
    stamp_ns = 1_700_000_000_000_000_000 + np.sort(rng.integers(0, 100_000_000, count))
    position = rng.integers(0, 7) + np.arange(count) // rng.integers(1, 9) % most
    word = rng.integers(-(1 << 63), (1 << 63) - 1, count)
    encoder = np.where(sensor == 1, word, position)
    return WindowColumns(stamp_ns, sensor, np.arange(count), encoder)


@pytest.mark.parametrize("count", [0, 1, 2, 17, 5000])
@pytest.mark.parametrize("seed", range(4))
def test_column_statistics_equal_those_of_numpy(seed: int, count: int) -> None:
    compiled = NativeColumnStatistics(POSITIONS)
    plain = ColumnStatistics(POSITIONS)
    for again in range(3):
        due = columns(seed * 10 + again, count, 500)
        assert compiled.measure(due) == plain.measure(due)


def test_numpy_measures_positions_beyond_the_revolution() -> None:
    compiled = NativeColumnStatistics(POSITIONS)
    plain = ColumnStatistics(POSITIONS)
    due = columns(1, 5000, 2000)
    assert (due.encoder[due.sensor == 2] >= 512).any()
    assert compiled.measure(due) == plain.measure(due)
    fine = columns(1, 5000, 500)
    assert compiled.measure(fine) == plain.measure(fine)


@pytest.mark.parametrize("statistics", [ColumnStatistics, NativeColumnStatistics])
def test_column_statistics_by_hand(statistics: type[ColumnStatistics]) -> None:
    # 120 sectors of 3 positions each: 0, 0, 1, 0, 119; the second sensor has one column.
    stamp_ns = np.array([0, 10, 40, 45, 50, 51])
    encoder = np.array([0, 2, 3, 1, 1 << 31, 359])
    sensor = np.array([0, 0, 0, 0, 1, 0])
    found = statistics((360, None, 8)).measure(WindowColumns(stamp_ns, sensor, stamp_ns, encoder))
    assert found == [
        ColumnStats(5, 30, 3 / 120, 1 / 120),
        ColumnStats(1, 0, 1 / 120, 0.0),
        ColumnStats(0, 0, 0.0, 0.0),
    ]
