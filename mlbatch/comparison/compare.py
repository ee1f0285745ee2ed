"""`mlbatch compare`: sets of joined sweeps against windows, from the same columns.

Only timestamps and rotor positions are read, and for a page the points of some instants. Columns
are as in batching, from the window before its start (eq. 1) to the end, for all join policies.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from mlbatch.batching.batcher import SLACK_NS
from mlbatch.batching.sweeps import (
    DEFAULT_TIMEOUT_NS,
    DEFAULT_TOLERANCE_NS,
    CollectedSweeps,
    JoinPolicy,
    NearestSweeps,
    NewestSweeps,
    Sweep,
    SweepCutter,
    SweepSet,
    publication_order,
    sweeps_of,
)
from mlbatch.discovery.types import Note
from mlbatch.errors import RecordingError
from mlbatch.page.policies import HEAD, Distribution, PolicyFigures
from mlbatch.pipeline import run_report
from mlbatch.pipeline.conversion import Conversion, Progress, sweep_cutter
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.sensor import Sensor
from mlbatch.types import Window
from mlbatch.units import NS_PER_MS, NS_PER_S, rate_text

if TYPE_CHECKING:
    from mlbatch.comparison.instant import InstantFinder
    from mlbatch.page.instant import SharedInstant

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


SCHEMA = "mlbatch.compare/2"
WINDOWS = "windows (mlbatch)"
Value: TypeAlias = str | int | float | Sequence["Value"] | Mapping[str, "Value"] | None


class SensorSweeps(NamedTuple):
    """The whole revolutions of a sensor; revolution_ms: median length, None without a whole one."""

    name: str
    model: str
    revolutions: int
    revolution_ms: float | None


@dataclass(frozen=True, slots=True)
class Settings:
    """Parameters of the join policies."""

    # Approximate time: largest difference between the begins of sweeps.
    tolerance_ns: int = DEFAULT_TOLERANCE_NS
    # Timeout collate: longest time that a set is open.
    timeout_ns: int = DEFAULT_TIMEOUT_NS


@dataclass(frozen=True, slots=True)
class Comparison:
    """Sets of all join policies on one recording, and, last, the windows."""

    rate_hz: str
    period_ms: float
    tolerance_ms: float
    timeout_ms: float
    compared_s: float
    sensors: tuple[SensorSweeps, ...]
    reports: tuple[PolicyFigures, ...]
    notes: tuple[Note, ...] = ()
    instant: SharedInstant | None = field(default=None, compare=False, repr=False)

    def rows(self) -> list[list[str]]:
        """The table, head first."""
        return [list(HEAD), *(report.row() for report in self.reports)]

    def title(self) -> str:
        """One line on what was compared."""
        sensors = ", ".join(
            f"{one.name} ({one.revolutions} sweeps"
            + (")" if one.revolution_ms is None else f" of {one.revolution_ms:.1f} ms)")
            for one in self.sensors
        )
        return f"{self.compared_s:.1f} s of {sensors}; windows at {self.rate_hz} Hz; times in ms"

    def figures(self) -> list[PolicyFigures]:
        """Figures of each policy, for pages and plots; starts after the first set of all."""
        begin_s = min((float(one.start_s.min()) for one in self.reports if one.sets), default=0.0)
        return [replace(one, start_s=one.start_s - begin_s) for one in self.reports]

    def as_json(self) -> dict[str, Value]:
        """The JSON document."""
        keys = ("rate_hz", "period_ms", "tolerance_ms", "timeout_ms", "compared_s")
        return {
            "schema": SCHEMA,
            **{key: getattr(self, key) for key in keys},
            "sensors": [sensor._asdict() for sensor in self.sensors],
            "policies": [report.as_json() for report in self.reports],
        }


class Joiner:
    """Cuts windows into sweeps, joins them by each policy, and measures the sets."""

    def __init__(
        self,
        cutters: Sequence[SweepCutter],
        policies: Sequence[JoinPolicy],
        period_ns: int,
        finder: InstantFinder | None = None,
    ) -> None:
        """finder: takes the sets and windows, too."""
        self._finder = finder
        self._cutters = list(cutters)
        self._policies = [
            (policy, SetStatistics(policy.name, len(cutters), period_ns)) for policy in policies
        ]
        # Columns of all whole sweeps.
        self._columns = 0
        # Lengths of the whole sweeps of each sensor.
        self.lengths_ns = [array("q") for _ in cutters]

    def add(self, window: Window) -> None:
        """Add the columns of the next window."""
        ended = []
        for index, cutter in enumerate(self._cutters):
            own = window.columns.sensor == index
            ended += cutter.push(window.columns.stamp_ns[own], window.columns.encoder[own])
        for sweep in publication_order(ended):
            self._columns += sweep.columns
            self.lengths_ns[sweep.sensor].append(sweep.ready_ns - sweep.first_ns)
            for number, (policy, statistics) in enumerate(self._policies):
                for joined in policy.publish(sweep):
                    statistics.add(joined, policy.ready_ns)
                    if self._finder is not None:
                        self._finder.add_set(number, joined)
        if self._finder is not None:
            self._finder.add(window)

    def reports(self) -> list[PolicyFigures]:
        """Figures of each policy."""
        return [
            statistics.report(self._columns, policy.waiting)
            for policy, statistics in self._policies
        ]


def compare(
    job: Job,
    settings: Settings | None = None,
    progress: Progress | None = None,
    *,
    finds_instant: bool = False,
) -> Comparison:
    """Join the sweeps of a recording by each policy, and batch the same columns by windows.

    progress: as of a conversion; its scans are windows; finds_instant: for the clouds of a page.
    """
    settings = settings or Settings()
    # Times need no extrinsics. Partial windows are read: sweeps may begin or end in them.
    selection = replace(job.selection, identity_extrinsics=True)
    run = Conversion(replace(job, selection=selection, keep_partial=True))
    count = len(run.sensors)
    if count < 2:
        raise RecordingError(
            f"{job.recordings[0]}: compare: expected two or more lidars, found "
            f"{run.sensors[0].name} only; give all recordings of the session"
        )
    period_ns = int(NS_PER_S / run.grid.rate)
    policies = (
        NewestSweeps(count),
        NearestSweeps(count, settings.tolerance_ns),
        CollectedSweeps(count, settings.timeout_ns),
    )
    finder = None
    if finds_instant:
        # Not loaded for figures alone.
        from mlbatch.comparison.instant import InstantFinder

        names = [*(policy.name for policy in policies), WINDOWS]
        finder = InstantFinder(names, run.sensors, period_ns, run.plain_scan)
        run.users.append(finder.oldest_ring_index)
    cutters = [sweep_cutter(sensor) for sensor in run.sensors]
    joiner = Joiner(cutters, policies, period_ns, finder)
    windows = SetStatistics(WINDOWS, count, period_ns)
    columns, length_ns = _run(run, joiner, windows, progress)
    if finder is not None:
        finder.finish()
    return Comparison(
        rate_hz=rate_text(run.grid.rate),
        period_ms=float(NS_PER_S / run.grid.rate / NS_PER_MS),
        tolerance_ms=settings.tolerance_ns / NS_PER_MS,
        timeout_ms=settings.timeout_ns / NS_PER_MS,
        compared_s=length_ns / NS_PER_S,
        sensors=tuple(map(_sensor_sweeps, run.sensors, joiner.lengths_ns)),
        reports=(*joiner.reports(), windows.report(columns)),
        notes=tuple(run.notes),
        instant=None if finder is None else finder.found(),
    )


def _run(
    run: Conversion, joiner: Joiner, statistics: SetStatistics, progress: Progress | None
) -> tuple[int, int]:
    """Read all windows; returns the number of columns due in them, and their length in ns."""
    columns = 0
    first_ns: int | None = None
    end_ns = 0
    previous: Window | None = None
    count = 0

    def show(done_bytes: int, size_bytes: int, _: int) -> None:
        if progress is not None:
            progress(done_bytes, size_bytes, count)

    for window in run.windows(show):
        count += 1
        joiner.add(window)
        first_ns = window.start_ns if first_ns is None else first_ns
        end_ns = window.end_ns
        if previous is not None:
            ready_ns = previous.end_ns + SLACK_NS
            statistics.add(sweeps_of(previous.columns, len(run.sensors), previous.end_ns), ready_ns)
            columns += len(previous.columns)
        # Like `convert`: the head and the window of the last timestamp are not counted.
        previous = window if window.index >= 0 else None
    run.session.refuse_absent()
    if not columns or first_ns is None:
        raise RecordingError(run_report.why_no_scan(run))
    late = sum(dropped.get("late", 0) for dropped in run.batcher.dropped)
    return columns + late, end_ns - first_ns


def _sensor_sweeps(sensor: Sensor, lengths_ns: array[int]) -> SensorSweeps:
    median_ms = Distribution.of(np.array(lengths_ns, np.int64) / NS_PER_MS).p50
    return SensorSweeps(sensor.name, sensor.lidar.model, len(lengths_ns), median_ms)
