"""Fill of a scan: columns present / columns expected, by sensor; times without a column.

Expected is what a sensor sends in a window without loss: its rate times the length of the window,
less what it does not measure because its rotor passes a dark sector (an azimuth window that the
sensor is set to). A dark sector that the mode does not name is learned: sectors of a revolution in
which the sensor never had a column so far. See docs/batching.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, I64Array, median
from mlbatch.lidar.geometry import SECTORS, rotor_ticks, sectors
from mlbatch.types import WindowColumns, WindowFigures
from mlbatch.units import NS_PER_S

# Of fewer expected columns one more or less, by jitter, would be a large share.
LEAST_EXPECTED = 2
UNKNOWN = math.nan
_TICKS = 2.0**32
# Relative error of an expectation: rotor positions are rounded.
_ROUNDING = 1e-4


class Pace(NamedTuple):
    """Columns that a sensor sends.

    columns_per_s: while it measures, 0: unknown; lit_share: share of a revolution in which it
    measures, None: to be learned; positions: rotor positions of a revolution, None: columns have
    rotor words.
    """

    columns_per_s: float
    lit_share: float | None
    positions: int | None


UNKNOWN_PACE = Pace(0.0, None, None)


class FillMeter:
    """Fill of windows, which come in the order of time: dark sectors are learned from earlier ones.

    The result does not depend on how packets are grouped.
    """

    def __init__(self, paces: Sequence[Pace]) -> None:
        self._sensors = [_Expectation(pace) for pace in paces]

    def measure(self, length_ns: int, figures: WindowFigures, columns: WindowColumns) -> F32Array:
        """Fill (s,) of a window of this length, from its columns; NaN: unknown."""
        fills = []
        for number, (one, own_figures) in enumerate(zip(self._sensors, figures, strict=True)):
            count = own_figures.columns
            if one.learns and count:
                rows = np.flatnonzero(columns.sensor == number)
                one.learn(columns.stamp_ns[rows], columns.encoder[rows])
            fills.append(_fill(count, one.columns(length_ns)))
        return np.array(fills, np.float32)


def _fill(count: int, expected: float) -> float:
    """The fill; expected: NaN if the rate of the sensor is unknown."""
    if math.isnan(expected):
        # The rate is unknown, but there should be columns.
        return UNKNOWN if count else 0.0
    whole = math.floor(expected * (1 + _ROUNDING))
    return UNKNOWN if whole < LEAST_EXPECTED else min(1.0, count / whole)


@dataclass(slots=True)
class _Expectation:
    """Columns expected of one sensor, as far as known."""

    pace: Pace
    # (SECTORS,) bool: in which the sensor had a column.
    _seen: BoolArray = field(default_factory=lambda: np.zeros(SECTORS, np.bool_))
    _lit_share: float = 0.0
    _revolution_ns: float = 0.0
    # False once all is known: at once, or after a revolution, except with dark sectors.
    learns: bool = field(init=False)
    # `columns` by length of the window. Bounds are rounded, so there are at most two lengths.
    _columns: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find out whether there is something to learn."""
        if self.pace.lit_share is not None:
            self._lit_share = self.pace.lit_share
        self.learns = self.pace.columns_per_s > 0 and self._lit_share < 1.0

    def learn(self, stamp_ns: I64Array, encoder: I64Array) -> None:
        """Update dark sectors and the speed of the rotor by columns (n,) of a window."""
        positions = self.pace.positions
        self._seen[np.clip(sectors(encoder, positions), 0, SECTORS - 1)] = True
        if self.pace.lit_share is None:
            self._lit_share = int(np.count_nonzero(self._seen)) / SECTORS
            self.learns = self._lit_share < 1.0
        self._columns.clear()
        ticks = rotor_ticks(encoder) if positions is None else encoder
        turned = np.diff(ticks) / (_TICKS if positions is None else positions)
        turned -= np.rint(turned)
        passed_ns = np.diff(stamp_ns)
        moving = passed_ns > 0
        if moving.any():
            speed = abs(median(turned[moving] / passed_ns[moving]))
            self._revolution_ns = 1 / speed if speed else 0.0

    def columns(self, length_ns: int) -> float:
        """Columns that any window of this length has at least, without loss; NaN: unknown."""
        expected = self._columns.get(length_ns)
        if expected is None:
            expected = self._columns[length_ns] = self._computed(length_ns)
        return expected

    def _computed(self, length_ns: int) -> float:
        if not self.pace.columns_per_s:
            return UNKNOWN
        columns = self.pace.columns_per_s * length_ns / NS_PER_S
        share = self._lit_share
        # Nothing is known of a sensor without a column so far, but that it should send.
        if share >= 1.0 or not self._seen.any():
            return columns
        if not self._revolution_ns:
            return UNKNOWN
        whole, part = divmod(length_ns / self._revolution_ns, 1.0)
        # The worst place of the window: its part of a revolution contains all of the dark sectors.
        lit = whole * share + max(0.0, part - (1.0 - share))
        return columns * lit / (whole + part)


class EdgeGaps:
    """The last column of each sensor, from window to window.

    The gap of a window counts from the last column before the window, however long ago, and to the
    end of the window at most: what follows is not known when the window is published, and must not
    depend on when it is. A gap over several windows so grows from one to the next.
    """

    def __init__(self, sensors: int) -> None:
        self._last_ns: list[int | None] = [None] * sensors

    def measure(self, start_ns: int, end_ns: int, figures: WindowFigures) -> tuple[int, ...]:
        """Widest gap at either bound of a window, ns, by sensor; windows in order of time.

        Without an earlier column a gap counts from the start.
        """
        gaps_ns = []
        for number, last_ns in enumerate(self._last_ns):
            before_ns = start_ns if last_ns is None else last_ns
            own = figures[number]
            if own.columns:
                self._last_ns[number] = own.last_ns
                gaps_ns.append(max(own.first_ns - before_ns, end_ns - own.last_ns))
            else:
                gaps_ns.append(end_ns - before_ns)
        return tuple(gaps_ns)
