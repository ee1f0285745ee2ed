"""The clocks of a run: what faults and maps do to stamps, and what watching them tells.

Stamps pass here once, between the heads of packets and the batching: clock faults are added, then
the maps of `--align-clocks`. What is batched is watched, so that the report can say how clocks ran.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mlbatch.arrays import I64Array
from mlbatch.batching.intake import NEVER, JumpGuard, extremes
from mlbatch.clocks.compare import Comparison, compare
from mlbatch.clocks.watch import ClockEstimate, ClockWatch
from mlbatch.discovery.discover import Note, Setup
from mlbatch.discovery.extrinsics import Mounted
from mlbatch.discovery.sampler import Found
from mlbatch.lidar.interface import Lidar
from mlbatch.pipeline.ingest import Feeder
from mlbatch.pipeline.session import feed_of
from mlbatch.types import PacketBatch

if TYPE_CHECKING:
    from mlbatch.clocks.align import ClockMap
    from mlbatch.faults.replay import FaultReplay

SYNCHRONISED = "synchronised"
# Codes of warnings by kind of jump.
_WARNINGS = {"host": "host_step"}


@dataclass(slots=True)
class Timekeeper:
    """What is known and done of the clocks of a session's sensors, by their numbers.

    host_clocks: sensors whose stamps are arrivals, which nothing here changes; replay: None without
    faults; untimed: numbers of streams as in StreamTable; maps: of `--align-clocks`, once they are
    measured.
    """

    sensors: Sequence[Mounted]
    host_clocks: Sequence[bool]
    replay: FaultReplay | None
    untimed: Collection[int]
    maps: tuple[ClockMap | None, ...] = ()
    guards: list[JumpGuard] = field(default_factory=list)
    _watches: list[ClockWatch] = field(default_factory=list)

    def __post_init__(self) -> None:
        for sensor, by_host in zip(self.sensors, self.host_clocks, strict=True):
            watch = watch_of(sensor.found.lidar)
            self._watches.append(watch)
            # Where packets share the log time of a message, their way cannot be told.
            watched = None if is_untimed(self.untimed, sensor.found) else watch
            self.guards.append(JumpGuard(sensor.name, watched, has_clock=not by_host))

    def retime(self, number: int, stamp_ns: I64Array, host_ns: I64Array) -> I64Array:
        """Stamps (P, C) of packets of a sensor as they are to be batched; host_ns: (P,)."""
        if self.replay is not None:
            stamp_ns = stamp_ns + self.replay.shift_ns(number, host_ns)[:, None]
        found = self.maps[number] if self.maps else None
        return stamp_ns if found is None else found.apply(stamp_ns, host_ns[:, None])

    def align(self, batches: Iterator[PacketBatch], setup: Setup, to: str) -> None:
        """Measure how the clocks run over a whole session, and map them from now on."""
        from mlbatch.clocks.align import fit

        watches = [watch_of(sensor.found.lidar) for sensor in self.sensors]
        feeds = [feed_of(sensor) for sensor in self.sensors]
        # Arrivals of sensors on the recorder's clock are needed as their own stamps, too.
        feeder = Feeder(setup, feeds, self.host_clocks, self.retime)
        if self.replay is not None:
            batches = self.replay.batches(batches, feeder.owners)
        for batch in batches:
            for arrival, watch in zip(
                feeder.feed(batch, [None] * len(feeds)).arrivals, watches, strict=True
            ):
                if arrival is not None:
                    _, newest_ns = extremes(arrival.heads)
                    measured = newest_ns > NEVER
                    watch.add(newest_ns[measured], arrival.host_ns[measured])
        self.maps = fit(watches, to)

    def findings(self) -> list[tuple[str, ClockEstimate]]:
        """What is known of the clock of each sensor that gave stamps of its own."""
        pairs = zip(self.sensors, self._watches, strict=True)
        found = ((sensor.name, watch.estimate()) for sensor, watch in pairs)
        return [(name, finding) for name, finding in found if finding is not None]

    def comparison(self) -> Comparison | None:
        """How the clocks agree; None where no sensor gave stamps of its own."""
        findings = self.findings()
        return compare(findings) if findings else None

    def notes(self) -> list[Note]:
        """Warnings: jumps of clocks, steps of the recorder's, clocks that do not run together."""
        comparison = self.comparison()
        if comparison is None:
            return []
        notes = []
        for name, finding in comparison.estimates:
            for jump in finding.jumps:
                text = f"{name}: {jump.describe()}"
                notes.append(Note(_WARNINGS.get(jump.kind, "clock_jump"), name, text))
        notes += [
            Note("clocks", "", pair.describe())
            for pair in comparison.pairs
            if pair.verdict != SYNCHRONISED
        ]
        return notes


def is_untimed(untimed: Collection[int], sensor: Found) -> bool:
    """Whether a sensor's packets have no arrival times of their own."""
    return any(stream in untimed for stream, _ in sensor.kinds)


def watch_of(lidar: Lidar) -> ClockWatch:
    """A watch for the clock of a sensor."""
    return ClockWatch(period_ns=lidar.clock_period_ns, mode=lidar.timestamp_mode)
