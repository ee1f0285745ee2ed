"""Figures of the sets that one way to join columns makes: how long they are, what they use."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.compare.sweeps import Turn, TurnSet
from mlbatch.units import NS_PER_MS

# A turn is stale in a set whose newest column is more than this many periods newer than its own.
STALE_PERIODS = 2
HEAD = (
    *("joined by", "sets", "without a sensor", "stale", "span min", "p50", "p99", "max"),
    *("apart p50", "max", "columns", "used twice", "never used"),
)


@dataclass(frozen=True, slots=True)
class Figures:
    """Distribution of a time over sets, ms; None where there was nothing to measure."""

    min: float | None = None
    p50: float | None = None
    p99: float | None = None
    max: float | None = None

    @classmethod
    def of(cls, values_ns: array[int]) -> Figures:
        """By nearest rank: values that occurred."""
        if not values_ns:
            return cls()
        values_ms = np.frombuffer(values_ns, np.int64) / NS_PER_MS
        p50, p99 = np.quantile(values_ms, [0.5, 0.99], method="inverted_cdf").tolist()
        return cls(float(values_ms.min()), p50, p99, float(values_ms.max()))


@dataclass(frozen=True, slots=True)
class WayReport:
    """What came of one way to make sets.

    span_ms: of all columns of a set; apart_ms: between the middles of its sensors' columns;
    columns: those that sets could be made of.
    """

    way: str
    sets: int
    without_a_sensor: int
    stale: int
    span_ms: Figures
    apart_ms: Figures
    columns: int
    used_twice: int
    never_used: int

    def row(self) -> list[str]:
        """Cells for people, as HEAD."""
        span, apart = self.span_ms, self.apart_ms
        return [
            *(self.way, str(self.sets), str(self.without_a_sensor), str(self.stale)),
            *map(_ms, (span.min, span.p50, span.p99, span.max, apart.p50, apart.max)),
            *(str(self.columns), _share(self.used_twice, self.columns)),
            _share(self.never_used, self.columns),
        ]


class Tally:
    """Counts the sets of one way; sets are added in order, and so are the turns of each sensor."""

    def __init__(self, way: str, sensors: int, period_ns: int) -> None:
        self._way = way
        self._stale_ns = STALE_PERIODS * period_ns
        self._last: list[Turn | None] = [None] * sensors
        self._repeated = [False] * sensors
        self._spans_ns, self._aparts_ns = array("q"), array("q")
        self._sets = self._without = self._stale = self._used = self._twice = 0

    def add(self, joined: TurnSet) -> None:
        """Count a set, which has at least one turn."""
        present = [turn for turn in joined if turn is not None]
        newest_ns = max(turn.last_ns for turn in present)
        middles = [turn.middle_ns for turn in present]
        self._sets += 1
        self._without += len(present) < len(joined)
        self._stale += any(turn.last_ns < newest_ns - self._stale_ns for turn in present)
        self._spans_ns.append(newest_ns - min(turn.first_ns for turn in present))
        if len(present) > 1:
            self._aparts_ns.append(max(middles) - min(middles))
        for turn in present:
            self._use(turn)

    def report(self, columns: int, waiting: Sequence[Turn] = ()) -> WayReport:
        """The figures; columns: of all turns; waiting: turns of which nothing is decided."""
        undecided = sum(turn.columns for turn in waiting if turn is not self._last[turn.sensor])
        return WayReport(
            self._way,
            self._sets,
            self._without,
            self._stale,
            Figures.of(self._spans_ns),
            Figures.of(self._aparts_ns),
            columns - undecided,
            self._twice,
            columns - undecided - self._used,
        )

    def _use(self, turn: Turn) -> None:
        sensor = turn.sensor
        if self._last[sensor] is not turn:
            self._last[sensor], self._repeated[sensor] = turn, False
            self._used += turn.columns
        elif not self._repeated[sensor]:
            self._repeated[sensor] = True
            self._twice += turn.columns


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _share(count: int, whole: int) -> str:
    return f"{100 * count / whole:.1f} %" if whole else "-"
