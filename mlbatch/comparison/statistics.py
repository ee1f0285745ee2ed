"""Statistics of sets of sweeps: time spans, and how often columns are used."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from mlbatch.batching.sweeps import Sweep, SweepSet
from mlbatch.page.policies import PolicyFigures
from mlbatch.units import NS_PER_MS, NS_PER_S

# A sweep is stale in a set whose newest column is more than this many periods newer than its own.
STALE_PERIODS = 2
HEAD = (
    "joined by",
    "sets",
    "without a sensor",
    "stale",
    "span min",
    "span p50",
    "span p99",
    "span max",
    "apart p50",
    "apart max",
    "columns",
    "used twice",
    "never used",
)


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of a time over sets, ms; None without values."""

    min: float | None = None
    p50: float | None = None
    p99: float | None = None
    max: float | None = None

    @classmethod
    def of(cls, values_ns: array[int]) -> Distribution:
        """Quantiles by nearest rank, without interpolation."""
        if not values_ns:
            return cls()
        values_ms = np.frombuffer(values_ns, np.int64) / NS_PER_MS
        p50, p99 = np.quantile(values_ms, [0.5, 0.99], method="inverted_cdf").tolist()
        return cls(float(values_ms.min()), p50, p99, float(values_ms.max()))


@dataclass(frozen=True, slots=True, eq=False)
class SetReport(PolicyFigures):
    """Figures of the sets of one join policy, or of windows; starts in s of the common clock.

    span: from the first column of a set to its last; apart: between the midpoints of the sensors'
    sweeps in a set, of sets with several; latency: from the first column of a set until the set is
    complete.
    """

    span: Distribution = Distribution()
    apart: Distribution = Distribution()
    latency: Distribution = Distribution()

    def row(self) -> list[str]:
        """Cells of the table, as HEAD."""
        span, apart = self.span, self.apart
        return [
            self.name,
            str(self.sets),
            str(self.without_a_sensor),
            str(self.stale),
            *map(_ms_text, (span.min, span.p50, span.p99, span.max, apart.p50, apart.max)),
            str(self.columns),
            _percentage(self.used_twice, self.columns),
            _percentage(self.never_used, self.columns),
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


class SetStatistics:
    """Measures the sets of one policy, which are added in order, as are the sweeps of a sensor."""

    def __init__(self, policy: str, sensors: int, period_ns: int) -> None:
        self._policy = policy
        self._stale_ns = STALE_PERIODS * period_ns
        # Last sweep of each sensor, and whether more than one set uses it.
        self._last: list[Sweep | None] = [None] * sensors
        self._is_reused = [False] * sensors
        self._spans_ns = array("q")
        self._aparts_ns = array("q")
        # Of every set, including sets with one sensor.
        self._firsts_ns = array("q")
        self._all_aparts_ns = array("q")
        self._latencies_ns = array("q")
        self._sets = 0
        self._without = 0
        self._stale = 0
        # Columns used at least once, and more than once.
        self._used = 0
        self._used_twice = 0

    def add(self, joined: SweepSet, ready_ns: int | None = None) -> None:
        """Measure a set of at least one sweep; ready_ns: when it is complete.

        None: with the last of its sweeps.
        """
        present = [sweep for sweep in joined if sweep is not None]
        newest_ns = max(sweep.last_ns for sweep in present)
        middles_ns = [sweep.middle_ns for sweep in present]
        self._sets += 1
        self._without += len(present) < len(joined)
        self._stale += any(sweep.last_ns < newest_ns - self._stale_ns for sweep in present)
        first_ns = min(sweep.first_ns for sweep in present)
        if ready_ns is None:
            ready_ns = max(sweep.ready_ns for sweep in present)
        self._firsts_ns.append(first_ns)
        self._spans_ns.append(newest_ns - first_ns)
        self._latencies_ns.append(ready_ns - first_ns)
        self._all_aparts_ns.append(max(middles_ns) - min(middles_ns))
        if len(present) > 1:
            self._aparts_ns.append(max(middles_ns) - min(middles_ns))
        for sweep in present:
            self._use(sweep)

    def report(self, columns: int, waiting: Sequence[Sweep] = ()) -> SetReport:
        """The figures; columns: of all sweeps; waiting: sweeps that later sets might use."""
        undecided = sum(sweep.columns for sweep in waiting if sweep is not self._last[sweep.sensor])
        return SetReport(
            name=self._policy,
            sets=self._sets,
            without_a_sensor=self._without,
            stale=self._stale,
            columns=columns - undecided,
            used_twice=self._used_twice,
            never_used=columns - undecided - self._used,
            start_s=np.array(self._firsts_ns, np.int64) / NS_PER_S,
            span_ms=np.array(self._spans_ns, np.int64) / NS_PER_MS,
            apart_ms=np.array(self._all_aparts_ns, np.int64) / NS_PER_MS,
            latency_ms=np.array(self._latencies_ns, np.int64) / NS_PER_MS,
            span=Distribution.of(self._spans_ns),
            apart=Distribution.of(self._aparts_ns),
            latency=Distribution.of(self._latencies_ns),
        )

    def _use(self, sweep: Sweep) -> None:
        sensor = sweep.sensor
        if self._last[sensor] is not sweep:
            self._last[sensor] = sweep
            self._is_reused[sensor] = False
            self._used += sweep.columns
        elif not self._is_reused[sensor]:
            self._is_reused[sensor] = True
            self._used_twice += sweep.columns


def _ms_text(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _percentage(count: int, whole: int) -> str:
    return f"{100 * count / whole:.1f} %" if whole else "-"
