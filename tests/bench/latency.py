"""Latency from the receive time of a packet to the sub-scan that it completes.

    python -m tests.bench.latency RECORDING --rig RIG --slices 10 --engine numba

Packets are pushed one by one, as from a driver on the vehicle, through the classes of a conversion:
`Feeder.feed`, `Batcher.push`, `Decoder.scan`. Garbage collection is on. CPU time of the thread is
the cost of the work; wall time includes other load of the machine.
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
from mlbatch.decode.decoder import Decoder, Due, Label
from mlbatch.decode.kernels import ENGINES
from mlbatch.discovery.discover import Wishes
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.session import boxes_of, run_info, source_of
from mlbatch.readers import merge
from mlbatch.types import PacketBatch
from mlbatch.units import NS_PER_US

QUANTILES: Final = (0.5, 0.99, 1.0)


@dataclass(slots=True)
class PushTimes:
    """CPU time of the thread and wall time of each push, ns; scans: number of scans it gave."""

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
        self._decoder: Decoder | None = None

    def push(self, batch: PacketBatch) -> int:
        """Push a batch, decode the windows it completes; returns the number of scans."""
        batcher = self.run.batcher
        places = [batcher.oldest_place(number) for number in range(len(self.run.feeds))]
        fed = self.run.feeder.feed(batch, places)
        scans = 0
        for window in batcher.push(fed.arrivals, batch.host_ns):
            label = Label(
                window.index,
                window.slice,
                window.start_ns,
                window.end_ns,
                window.complete,
                window.ready_host_ns,
            )
            due = Due(window.stamp_ns, window.sensor, window.place, window.encoder)
            self.decoder.scan(due, label)
            scans += 1
        return scans

    @property
    def decoder(self) -> Decoder:
        """Created when the first window closes, as in a conversion."""
        if self._decoder is None:
            run, job = self.run, self.run.job
            info = run_info(run.setup, job, run.grid, "utc")
            members = zip(run.setup.sensors, run.feeds, info.sensors, strict=True)
            sources = [source_of(one, feed, sensor.ring_base, job) for one, feed, sensor in members]
            boxes_m = boxes_of(run.setup, job)
            self._decoder = Decoder(info, sources, boxes_m, job.extras, engine=run.engine)
        return self._decoder


def one_by_one(batches: Iterator[PacketBatch]) -> Iterator[PacketBatch]:
    """The same packets, each in a batch of its own."""
    for batch in batches:
        for row in range(len(batch)):
            yield batch.take(slice(row, row + 1))


def measure(job: Job, warm: int, packets: int) -> PushTimes:
    """Push packets one by one; time `packets` of them, after the first `warm`."""
    driver = Driver(job)
    times = PushTimes()
    for number, batch in enumerate(one_by_one(merge(driver.run.recordings))):
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
    """Of pushes that give a scan, of the others, and of all."""
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
    parser.add_argument("--engine", choices=ENGINES, default="numpy")
    parser.add_argument("--warm", type=int, default=2000, help="packets before the first measured")
    parser.add_argument("--packets", type=int, default=20_000, help="packets that are measured")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    wishes = Wishes(rig=options.rig)
    job = Job((options.recording,), wishes, slices=options.slices, engine=options.engine)
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
