"""Latency from the receive time of a packet to the sub-scan that it completes.

    python -m tests.bench.latency RECORDING --rig RIG --slices 10

Packets are pushed one by one, as from a driver on the vehicle, through the classes of a conversion:
`Ingest.columns`, `Batcher.push`, `DecodeWorker.decode`. Garbage collection is on. CPU time of the
thread is the cost of the work; wall time includes other load of the machine.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.decode_pool import DecodePool
from mlbatch.pipeline.job import Job
from mlbatch.types import PacketBatch
from mlbatch.units import NS_PER_US

QUANTILES: Final = (0.5, 0.99, 1.0)


@dataclass(slots=True)
class PushTimes:
    """CPU time of the thread and wall time of each push, ns; scans: completed scans."""

    cpu_ns: list[int] = field(default_factory=list)
    wall_ns: list[int] = field(default_factory=list)
    scans: list[int] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Figures:
    """Quantiles (QUANTILES) of some pushes, microseconds."""

    pushes: int
    cpu_us: tuple[float, ...]
    wall_us: tuple[float, ...]


class Driver:
    """The stages of a conversion, fed packet by packet."""

    def __init__(self, job: Job) -> None:
        self.run = Conversion(job)
        # Created when the first window closes, as in a conversion.
        self._pool: DecodePool | None = None

    def push(self, batch: PacketBatch) -> int:
        """Push a batch, decode the windows it completes; returns the number of scans."""
        batcher = self.run.batcher
        oldest = [batcher.oldest_ring_index(sensor.index) for sensor in self.run.sensors]
        self.run.session.keep_from(oldest)
        ingested = self.run.session.ingest.columns(batch)
        scans = 0
        for window in batcher.push(ingested.accepted, batch.host_ns):
            self._pool = self._pool or self.run.pool
            for task in self._pool.tasks(window):
                self._pool.workers[0].decode(task)
                scans += 1
        return scans


def one_by_one(batches: Iterator[PacketBatch]) -> Iterator[PacketBatch]:
    """The same packets, each in a batch of its own."""
    for batch in batches:
        for row in range(len(batch)):
            yield batch.take(slice(row, row + 1))


def measure(job: Job, warm: int, packets: int) -> PushTimes:
    """Push packets one by one; time `packets` of them, after the first `warm`."""
    driver = Driver(job)
    times = PushTimes()
    for number, batch in enumerate(one_by_one(driver.run.session.packets())):
        if number == warm + packets:
            break
        wall_ns = time.perf_counter_ns()
        cpu_ns = time.thread_time_ns()
        scans = driver.push(batch)
        if number >= warm:
            times.cpu_ns.append(time.thread_time_ns() - cpu_ns)
            times.wall_ns.append(time.perf_counter_ns() - wall_ns)
            times.scans.append(scans)
    return times


def figures(times: PushTimes) -> dict[str, Figures]:
    """Figures of pushes that complete a scan, of the others, and of all."""
    closing = np.array(times.scans) > 0
    chosen = {"closing": closing, "others": ~closing, "all": np.ones(len(closing), np.bool_)}
    return {
        name: Figures(
            int(np.count_nonzero(rows)), _us(times.cpu_ns, rows), _us(times.wall_ns, rows)
        )
        for name, rows in chosen.items()
        if rows.any()
    }


def _us(values_ns: Sequence[int], rows: BoolArray) -> tuple[float, ...]:
    chosen = np.array(values_ns)[rows] / NS_PER_US
    return tuple(np.quantile(chosen, QUANTILES, method="inverted_cdf").tolist())


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.latency",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path)
    parser.add_argument("--slices", type=int, default=10)
    parser.add_argument("--warm", type=int, default=2000, help="packets before the first measured")
    parser.add_argument("--packets", type=int, default=20_000, help="packets that are measured")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    selection = SensorSelection(rig=options.rig)
    job = Job((options.recording,), selection, slices=options.slices)
    found = figures(measure(job, options.warm, options.packets))
    if options.json:
        print(json.dumps({name: asdict(one) for name, one in found.items()}))
        return 0
    print(f"{'us':10}{'pushes':>8}{'CPU p50':>10}{'p99':>8}{'max':>8}{'wall p50':>10}{'p99':>8}")
    for name, one in found.items():
        cpu = "{:10.1f}{:8.1f}{:8.1f}".format(*one.cpu_us)
        wall = "{:10.1f}{:8.1f}".format(*one.wall_us[:2])
        print(f"{name:10}{one.pushes:8}{cpu}{wall}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
