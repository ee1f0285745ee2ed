"""Clocks of a run: maps on timestamps, watches of what is batched, warnings.

Timestamps are mapped once, between the column headers and the batching: injected clock faults are
added, then the maps of `--align-clocks` applied. Batched timestamps are watched for the report.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from mlbatch.arrays import I64Array
from mlbatch.clocks.compare import SYNCHRONISED, Comparison, compare
from mlbatch.clocks.watch import ClockEstimate
from mlbatch.discovery.router import Router
from mlbatch.discovery.sampler import clock_watch
from mlbatch.discovery.types import Note
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.ingest import Ingest
from mlbatch.pipeline.sensor import Sensor
from mlbatch.types import PacketBatch

if TYPE_CHECKING:
    from mlbatch.faults import FaultReplay


class ClockMonitor:
    """Maps and watches the clocks of the sensors of a run."""

    def __init__(self, sensors: Sequence[Sensor], replay: FaultReplay | None) -> None:
        """replay: of injected faults, None without."""
        self._sensors = sensors
        self._replay = replay

    def map_stamps(self, sensor: Sensor, stamp_ns: I64Array, host_ns: I64Array) -> I64Array:
        """Timestamps (P, C) of packets received at (P,) as they are to be batched."""
        if self._replay is not None:
            stamp_ns = stamp_ns + self._replay.shift_ns(sensor.index, host_ns)[:, None]
        found = sensor.clock.map
        return stamp_ns if found is None else found.apply(stamp_ns, host_ns[:, None])

    def align(self, batches: Iterator[PacketBatch], router: Router, to: str) -> None:
        """Measure the clocks over a whole session, and set the map of each sensor.

        to: `host` or `first`, as in `--align-to`.
        """
        from mlbatch.clocks.align import fit

        # Rings and ledgers of their own: this pass reads everything once more.
        arena = PacketArena()
        sensors = [sensor.unread(arena) for sensor in self._sensors]
        watches = [clock_watch(sensor.lidar) for sensor in sensors]
        intakes = [
            sensor.clock_intake(watch) for sensor, watch in zip(sensors, watches, strict=True)
        ]
        ingest = Ingest(router, sensors, intakes, self.map_stamps)
        if self._replay is not None:
            batches = self._replay.batches(batches, router.owners)
        for batch in batches:
            arena.keep_from(None)
            ingest.columns(batch)
        for sensor, found in zip(self._sensors, fit(watches, to), strict=True):
            sensor.clock.map = found

    def findings(self) -> list[tuple[str, ClockEstimate]]:
        """Name and clock of each sensor that gave timestamps of its own."""
        found = ((sensor.name, sensor.clock.watch.estimate()) for sensor in self._sensors)
        return [(name, finding) for name, finding in found if finding is not None]

    def comparison(self) -> Comparison | None:
        """Agreement of the clocks; None if no sensor gave timestamps of its own."""
        findings = self.findings()
        return compare(findings) if findings else None

    def notes(self) -> list[Note]:
        """Warnings: steps of sensor clocks and of the capture host's, clocks that differ."""
        comparison = self.comparison()
        if comparison is None:
            return []
        notes = []
        for name, finding in comparison.estimates:
            for jump in finding.jumps:
                code = "host_step" if jump.kind == "host" else "clock_jump"
                notes.append(Note(code, name, f"{name}: {jump.describe()}"))
        notes += [
            Note("clocks", "", pair.describe())
            for pair in comparison.pairs
            if pair.verdict != SYNCHRONISED
        ]
        return notes
