"""What `mlbatch compare` tells: sets of joined turns against windows, on the same columns.

Only stamps and rotor positions are read. The columns are those of the batching, from the window
before its start (eq. 1) to the end, so that all ways are given the same.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TypeAlias

from mlbatch.batching.windows import Window
from mlbatch.compare.statistics import HEAD, Figures, Tally, WayReport
from mlbatch.compare.sweeps import (
    Collected,
    Nearest,
    Newest,
    Turn,
    TurnCutter,
    TurnSet,
    Way,
    in_order,
)
from mlbatch.discovery.types import DetectedSensor, Note
from mlbatch.errors import RecordingError
from mlbatch.pipeline import accounts
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.units import NS_PER_MS, NS_PER_S, rate_text

SCHEMA = "mlbatch.compare/1"
WINDOWS = "windows (mlbatch)"
# Half a turn at the usual 10 Hz, and a whole one.
DEFAULT_TOLERANCE_NS = 50 * NS_PER_MS
DEFAULT_TIMEOUT_NS = 100 * NS_PER_MS
Value: TypeAlias = str | int | float | Sequence["Value"] | Mapping[str, "Value"] | None


@dataclass(frozen=True, slots=True)
class SensorTurns:
    """The whole turns of a sensor; turn_ms: their usual length, None where none was seen."""

    name: str
    model: str
    turns: int
    turn_ms: float | None


@dataclass(frozen=True, slots=True)
class Settings:
    """How far apart the nearest turns may begin, and how long turns are collected; ns."""

    tolerance_ns: int = DEFAULT_TOLERANCE_NS
    timeout_ns: int = DEFAULT_TIMEOUT_NS


@dataclass(frozen=True, slots=True)
class Comparison:
    """All ways on one recording; the last one is ours."""

    rate_hz: str
    period_ms: float
    tolerance_ms: float
    timeout_ms: float
    compared_s: float
    sensors: tuple[SensorTurns, ...]
    ways: tuple[WayReport, ...]
    notes: tuple[Note, ...] = ()

    def rows(self) -> list[list[str]]:
        """The table, head first."""
        return [list(HEAD), *(way.row() for way in self.ways)]

    def title(self) -> str:
        """What was compared, in a line."""
        sensors = ", ".join(
            f"{one.name} ({one.turns} turns"
            + (")" if one.turn_ms is None else f" of {one.turn_ms:.1f} ms)")
            for one in self.sensors
        )
        return f"{self.compared_s:.1f} s of {sensors}; windows at {self.rate_hz} Hz; times in ms"

    def as_json(self) -> dict[str, Value]:
        """For programs."""
        told: dict[str, Value] = asdict(replace(self, notes=()))
        del told["notes"]
        return {"schema": SCHEMA, **told}


class Joiner:
    """Gives the turns of all sensors to each of the ways, and counts what they make of them."""

    def __init__(self, cutters: Sequence[TurnCutter], ways: Sequence[Way], period_ns: int) -> None:
        self._cutters = list(cutters)
        self._ways = [(way, Tally(way.name, len(cutters), period_ns)) for way in ways]
        self._columns = 0
        self.lengths_ns = [array("q") for _ in cutters]

    def add(self, window: Window) -> None:
        """Take the columns of the next window."""
        ended = []
        for number, cutter in enumerate(self._cutters):
            own = window.sensor == number
            ended += cutter.take(window.stamp_ns[own], window.encoder[own])
        for turn in in_order(ended):
            self._columns += turn.columns
            self.lengths_ns[turn.sensor].append(turn.ready_ns - turn.first_ns)
            for way, tally in self._ways:
                for joined in way.publish(turn):
                    tally.add(joined)

    def reports(self) -> list[WayReport]:
        """The figures of all ways."""
        return [tally.report(self._columns, way.waiting) for way, tally in self._ways]


def compare(job: Job, settings: Settings | None = None) -> Comparison:
    """Join turns in several ways, and batch the same columns by windows."""
    settings = settings or Settings()
    # Where the sensors sit plays no part; whole turns may reach into the partial windows.
    selection = replace(job.selection, identity_extrinsics=True)
    run = Conversion(replace(job, selection=selection, keep_partial=True))
    sensors, period_ns = [sensor.detected for sensor in run.sensors], int(NS_PER_S / run.grid.rate)
    if len(sensors) < 2:
        raise RecordingError(
            f"{job.recordings[0]}: compare: wanted two or more lidars, whose turns can be joined, "
            f"got {sensors[0].name} alone; give all recordings of the session"
        )
    count = len(sensors)
    ways = (
        Newest(count),
        Nearest(count, settings.tolerance_ns),
        Collected(count, settings.timeout_ns),
    )
    joiner = Joiner([_cutter(number, one) for number, one in enumerate(sensors)], ways, period_ns)
    ours = Tally(WINDOWS, count, period_ns)
    columns, length_ns = _join(run, joiner, ours)
    return Comparison(
        rate_hz=rate_text(run.grid.rate),
        period_ms=float(NS_PER_S / run.grid.rate / NS_PER_MS),
        tolerance_ms=settings.tolerance_ns / NS_PER_MS,
        timeout_ms=settings.timeout_ns / NS_PER_MS,
        compared_s=length_ns / NS_PER_S,
        sensors=tuple(map(_sensor_turns, sensors, joiner.lengths_ns)),
        ways=(*joiner.reports(), ours.report(columns)),
        notes=tuple(run.notes),
    )


def _join(run: Conversion, joiner: Joiner, ours: Tally) -> tuple[int, int]:
    """Run through all windows; gives the columns that were due in ours, and the time of all."""
    columns, first_ns, end_ns = 0, None, 0
    held: Window | None = None
    for window in run.windows():
        joiner.add(window)
        first_ns = window.start_ns if first_ns is None else first_ns
        end_ns = window.end_ns
        if held is not None:
            ours.add(_parts(held, len(run.sensors)))
            columns += len(held.stamp_ns)
        # As in a conversion, the head and the window of the very last stamp do not count.
        held = window if window.index >= 0 else None
    run.session.refuse_absent()
    if not columns or first_ns is None:
        raise RecordingError(accounts.why_nothing(run))
    late = sum(dropped.get("late", 0) for dropped in run.batcher.dropped)
    return columns + late, end_ns - first_ns


def _parts(window: Window, sensors: int) -> TurnSet:
    """What a window holds of each sensor."""
    parts: list[Turn | None] = []
    for number in range(sensors):
        stamp_ns = window.stamp_ns[window.sensor == number]
        parts.append(
            Turn(number, int(stamp_ns[0]), int(stamp_ns[-1]), window.end_ns, len(stamp_ns))
            if len(stamp_ns)
            else None
        )
    return tuple(parts)


def _cutter(number: int, sensor: DetectedSensor) -> TurnCutter:
    angles = sensor.lidar.beams.angle_rad
    return TurnCutter(number, None if angles is None else len(angles))


def _sensor_turns(sensor: DetectedSensor, lengths_ns: array[int]) -> SensorTurns:
    usual = Figures.of(lengths_ns).p50
    return SensorTurns(sensor.name, sensor.lidar.model, len(lengths_ns), usual)
