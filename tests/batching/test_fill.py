"""Fill of windows and gaps across their bounds; numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.fill import EdgeGaps, FillMeter, Pace
from mlbatch.types import NO_COLUMNS, ColumnFigures, WindowColumns

# 1000 columns a revolution of 0.1 s.
COLUMN_NS = 100_000
PER_S = 10_000.0
PER_TURN = 1000
WINDOW_NS = 100_000_000


def _columns(first: int, count: int, lit: tuple[int, int] = (0, PER_TURN)) -> I64Array:
    """Numbers of the columns of a rotor that measures at positions [from, to)."""
    number = np.arange(first, first + count)
    inside: BoolArray = (number % PER_TURN >= lit[0]) & (number % PER_TURN < lit[1])
    return number[inside]


def _fill(meter: FillMeter, number: I64Array, length_ns: int = WINDOW_NS, word: int = 0) -> float:
    """Fill of a window with these columns of the only sensor; word: rotor words, else positions."""
    position = number % PER_TURN
    encoder = position * (2**32 // PER_TURN) if word else position
    columns = WindowColumns(number * COLUMN_NS, np.zeros(len(number), np.int64), number, encoder)
    figures = [NO_COLUMNS._replace(columns=len(number))]
    return float(meter.measure(length_ns, figures, columns)[0])


def _meter(lit_share: float | None, positions: int | None = PER_TURN) -> FillMeter:
    return FillMeter([Pace(PER_S, lit_share, positions)])


def test_columns_by_those_expected() -> None:
    meter = _meter(1.0)
    assert _fill(meter, _columns(0, 1000)) == 1.0
    assert _fill(meter, _columns(1000, 250)) == 0.25
    # A rotor slightly faster than nominal.
    assert _fill(meter, _columns(2000, 1001)) == 1.0
    assert _fill(meter, _columns(3000, 0)) == 0.0


def test_a_dark_sector_of_the_mode_is_not_expected() -> None:
    meter = _meter(0.25)
    lit = (300, 550)
    assert _fill(meter, _columns(0, 1000, lit)) == 1.0
    assert _fill(meter, _columns(1000, 425, lit)) == 0.5
    assert _fill(meter, _columns(2000, 0)) == 0.0


@pytest.mark.parametrize("word", [0, 1])
def test_a_dark_sector_is_learned(word: int) -> None:
    """120 sectors: positions 0 to 499 are in the first 60 of them."""
    meter = _meter(None, None if word else PER_TURN)
    lit = (0, 500)
    assert _fill(meter, _columns(0, 1000, lit), word=word) == 1.0
    assert _fill(meter, _columns(1000, 250, lit), word=word) == 0.5
    assert _fill(meter, _columns(2000, 0), word=word) == 0.0
    # A full revolution shows that nothing is dark.
    assert _fill(meter, _columns(3000, 1000), word=word) == 1.0
    assert _fill(meter, _columns(4000, 500), word=word) == 0.5


def test_windows_within_the_dark_sector_have_no_expectation() -> None:
    """Slices of a quarter of a revolution, of a sensor that measures half of it."""
    meter = _meter(0.5)
    lit = (0, 500)
    quarter = [_columns(first, 250, lit) for first in range(0, 3000, 250)]
    fills = [_fill(meter, number, WINDOW_NS // 4) for number in quarter]
    assert not [fill for fill in fills if fill < 1]
    # Three quarters of a revolution contain at least a quarter that is lit: 250 columns.
    assert _fill(meter, _columns(3500, 750, lit), 3 * WINDOW_NS // 4) == 1.0
    assert _fill(meter, _columns(4500, 600, lit), 3 * WINDOW_NS // 4) == pytest.approx(100 / 250)


def test_a_sensor_of_unknown_rate_has_columns_or_none() -> None:
    meter = FillMeter([Pace(0.0, None, None)])
    assert np.isnan(_fill(meter, _columns(0, 7)))
    assert _fill(meter, _columns(0, 0)) == 0.0


def test_less_than_two_columns_are_no_expectation() -> None:
    meter = _meter(1.0)
    assert np.isnan(_fill(meter, _columns(0, 0), 19 * COLUMN_NS // 10))
    assert _fill(meter, _columns(0, 1), 2 * COLUMN_NS) == 0.5


def test_a_sensor_never_seen_is_expected() -> None:
    assert _fill(_meter(None), _columns(0, 0)) == 0.0
    # But not in windows that are too short for any other sensor.
    assert np.isnan(_fill(_meter(0.25), _columns(0, 0), 19 * COLUMN_NS // 10))


def test_gaps_count_from_the_last_column_to_the_end_of_the_window() -> None:
    gaps = EdgeGaps(2)
    # Of each sensor: from the start to the first column, from the last one to the end.
    assert gaps.measure(100, 200, [_from_to(110, 195), _from_to(130, 130)]) == (10, 70)
    # Sensor 1 is silent: from 130 to the end.
    assert gaps.measure(200, 300, [_from_to(205, 205), NO_COLUMNS]) == (95, 170)
    # A window without any column is not given; 130 to 450, 205 to 401.
    assert gaps.measure(400, 500, [_from_to(401, 499), _from_to(450, 450)]) == (196, 320)


def _from_to(first_ns: int, last_ns: int) -> ColumnFigures:
    return NO_COLUMNS._replace(columns=2, first_ns=first_ns, last_ns=last_ns)
