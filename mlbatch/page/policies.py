"""Figures of a fusion policy, or of windows, for tables, pages and plots."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array

# Speeds that offsets of objects are shown for, km/h.
SPEEDS_KMH = (10, 30, 50, 100)
KMH_PER_MPS = 3.6
# Of an object, if no other speed is asked for.
DEFAULT_MPS = 10.0
_MS_PER_S = 1000
HEAD = (
    *("joined by", "sets", "without a sensor", "stale", "span min", "span p50", "span p99"),
    *("span max", "apart p50", "apart max", "columns", "used twice", "never used"),
)


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of a time over sets, ms; None without values."""

    min: float | None = None
    p50: float | None = None
    p99: float | None = None
    max: float | None = None

    @classmethod
    def of(cls, values_ms: F64Array) -> Distribution:
        """Quantiles by nearest rank, without interpolation."""
        if not len(values_ms):
            return cls()
        p50, p99 = np.quantile(values_ms, [0.5, 0.99], method="inverted_cdf").tolist()
        return cls(float(values_ms.min()), p50, p99, float(values_ms.max()))


@dataclass(frozen=True, slots=True, eq=False)
class PolicyFigures:
    """Sets of one policy, (n,) each, float64 of times.

    start_s: of a set, from the first of all policies; span_ms: from its first to its last column;
    apart_ms: between the mean times of its sensors, 0 of a single one; latency_ms: from its first
    column until it is complete; lidars: of each set; columns: number that could be used.
    """

    name: str
    without_a_sensor: int
    stale: int
    columns: int
    used_twice: int
    never_used: int
    start_s: F64Array
    span_ms: F64Array
    apart_ms: F64Array
    latency_ms: F64Array
    lidars: I64Array

    @property
    def sets(self) -> int:
        """Number of sets."""
        return len(self.start_s)

    @property
    def span(self) -> Distribution:
        """Distribution of the spans."""
        return Distribution.of(self.span_ms)

    @property
    def apart(self) -> Distribution:
        """Distribution of times between sensors, of sets with several."""
        return Distribution.of(self.apart_ms[self.lidars > 1])

    @property
    def latency(self) -> Distribution:
        """Distribution of the latencies."""
        return Distribution.of(self.latency_ms)

    @property
    def worst_ms(self) -> float:
        """Largest span; 0 without a set."""
        return float(self.span_ms.max(initial=0.0))

    @staticmethod
    def median(values: F64Array) -> float:
        """Median by nearest rank; 0 without values."""
        return Distribution.of(values).p50 or 0.0

    def shares(self) -> tuple[float, float, float]:
        """Shares of columns used once, more than once, and never."""
        whole = max(1, self.columns)
        twice = self.used_twice / whole
        never = self.never_used / whole
        return max(0.0, 1 - twice - never), twice, never

    def row(self) -> list[str]:
        """Cells of the table, as HEAD."""
        span, apart = self.span, self.apart
        times_ms = (span.min, span.p50, span.p99, span.max, apart.p50, apart.max)
        _, *shares = self.shares()
        return [
            *(self.name, str(self.sets), str(self.without_a_sensor), str(self.stale)),
            *("-" if one is None else f"{one:.1f}" for one in times_ms),
            str(self.columns),
            *(f"{100 * share:.1f} %" if self.columns else "-" for share in shares),
        ]

    def as_json(self) -> dict[str, str | int | dict[str, float | None]]:
        """The policy in the JSON document."""
        return {
            "policy": self.name,
            "sets": self.sets,
            "without_a_sensor": self.without_a_sensor,
            "stale": self.stale,
            "span_ms": asdict(self.span),
            "apart_ms": asdict(self.apart),
            "columns": self.columns,
            "used_twice": self.used_twice,
            "never_used": self.never_used,
            "latency_ms": asdict(self.latency),
        }


def offset_m(speed_mps: float, time_ms: float) -> float:
    """Way of an object in a time: how far apart two lidars show it."""
    return speed_mps * time_ms / _MS_PER_S
