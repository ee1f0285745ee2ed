"""Statistics of sets of sweeps: time spans, and how often columns are used."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np

from mlbatch.batching.sweeps import Sweep, SweepSet
from mlbatch.page.policies import PolicyFigures
from mlbatch.units import NS_PER_MS, NS_PER_S

# A sweep is stale in a set whose newest column is more than this many periods newer than its own.
STALE_PERIODS = 2


class SetStatistics:
    """Measures the sets of one policy, which are added in order, as are the sweeps of a sensor."""

    def __init__(self, policy: str, sensors: int, period_ns: int) -> None:
        self._policy = policy
        self._stale_ns = STALE_PERIODS * period_ns
        # Last sweep of each sensor, and whether more than one set uses it.
        self._last: list[Sweep | None] = [None] * sensors
        self._is_reused = [False] * sensors
        # Of every set: first column, span, time between sensors, latency, ns, and sensors.
        self._sets = array("q")
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
        self._without += len(present) < len(joined)
        self._stale += any(sweep.last_ns < newest_ns - self._stale_ns for sweep in present)
        first_ns = min(sweep.first_ns for sweep in present)
        if ready_ns is None:
            ready_ns = max(sweep.ready_ns for sweep in present)
        apart_ns = max(middles_ns) - min(middles_ns)
        times_ns = (first_ns, newest_ns - first_ns, apart_ns, ready_ns - first_ns)
        self._sets.extend((*times_ns, len(present)))
        for sweep in present:
            self._use(sweep)

    def report(self, columns: int, waiting: Sequence[Sweep] = ()) -> PolicyFigures:
        """The figures; columns: of all sweeps; waiting: sweeps that later sets might use.

        Starts are in s of the common clock.
        """
        undecided = sum(sweep.columns for sweep in waiting if sweep is not self._last[sweep.sensor])
        first_ns, *times_ns, lidars = np.array(self._sets, np.int64).reshape(-1, 5).T
        span_ms, apart_ms, latency_ms = (one / NS_PER_MS for one in times_ns)
        return PolicyFigures(
            name=self._policy,
            without_a_sensor=self._without,
            stale=self._stale,
            columns=columns - undecided,
            used_twice=self._used_twice,
            never_used=columns - undecided - self._used,
            start_s=first_ns / NS_PER_S,
            span_ms=span_ms,
            apart_ms=apart_ms,
            latency_ms=latency_ms,
            lidars=lidars,
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
