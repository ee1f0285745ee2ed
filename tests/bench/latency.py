"""How long a packet takes from its arrival to the partial scan that it completes.

    python -m tests.bench.latency RECORDING --rig RIG --slices 10 --engine numba

Packets go one by one, as a driver on the vehicle would hand them over, through the classes that a
conversion uses: `Feeder.feed`, `Batcher.push`, `Decoder.scan`. Memory is collected as ever. CPU
time of the thread is what the work takes; wall time also holds what else the machine does.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.decode.decoder import Decoder, ScanHeader, WindowColumns
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
class Taken:
    """What each push took, ns: CPU of the thread and wall; scans: how many it gave."""

    cpu_ns: list[int]
    wall_ns: list[int]
    scans: list[int]


@dataclass(frozen=True, slots=True)
class Figures:
    """Median, 99th percentile and maximum of some pushes, microseconds."""

    pushes: int
    cpu_us: tuple[float, ...]
    wall_us: tuple[float, ...]


class Driver:
    """The stages of a conversion, fed packet by packet."""

    def __init__(self, job: Job) -> None:
        self.run = Conversion(job)
        self._decoder: Decoder | None = None

    def push(self, batch: PacketBatch) -> int:
        """Take in a batch, decode what it completes; gives the number of scans."""
        batcher = self.run.batcher
        places = [batcher.oldest_place(number) for number in range(len(self.run.feeds))]
        fed = self.run.feeder.feed(batch, places)
        scans = 0
        for window in batcher.push(fed.arrivals, batch.host_ns):
            label = ScanHeader(
                *(window.index, window.slice, window.start_ns, window.end_ns),
                *(window.complete, window.ready_host_ns),
            )
            due = WindowColumns(window.stamp_ns, window.sensor, window.place, window.encoder)
            self.decoder.scan(due, label)
            scans += 1
        return scans

    @property
    def decoder(self) -> Decoder:
        """Made when the first window closes, as in a conversion."""
        if self._decoder is None:
            run, job = self.run, self.run.job
            info = run_info(run.setup, job, run.grid, "utc")
            members = zip(run.setup.sensors, run.feeds, info.sensors, strict=True)
            sources = [source_of(one, feed, told.ring_base, job) for one, feed, told in members]
            boxes_m = boxes_of(run.setup, job)
            self._decoder = Decoder(info, sources, boxes_m, job.extras, engine=run.engine)
        return self._decoder


def one_by_one(batches: Iterator[PacketBatch]) -> Iterator[PacketBatch]:
    """The same packets, each in a batch of its own."""
    for batch in batches:
        for row in range(len(batch)):
            yield batch.take(slice(row, row + 1))


def measure(job: Job, warm: int, most: int) -> Taken:
    """Push packets after the first `warm`, at most so many, and time each."""
    driver, taken = Driver(job), Taken([], [], [])
    clock, cpu = time.perf_counter_ns, time.thread_time_ns
    for number, batch in enumerate(one_by_one(merge(driver.run.recordings))):
        if number == warm + most:
            break
        wall_ns, cpu_ns = clock(), cpu()
        scans = driver.push(batch)
        cpu_ns, wall_ns = cpu() - cpu_ns, clock() - wall_ns
        if number >= warm:
            taken.cpu_ns.append(cpu_ns)
            taken.wall_ns.append(wall_ns)
            taken.scans.append(scans)
    return taken


def figures(taken: Taken) -> dict[str, Figures]:
    """Of pushes that give a scan, of those that do not, and of all."""
    gives = np.array(taken.scans) > 0
    chosen = {"closing": gives, "others": ~gives, "all": np.ones(len(gives), np.bool_)}
    return {
        name: Figures(int(np.count_nonzero(rows)), *(_us(v, rows) for v in _times(taken)))
        for name, rows in chosen.items()
        if rows.any()
    }


def _times(taken: Taken) -> Sequence[Sequence[int]]:
    return taken.cpu_ns, taken.wall_ns


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
    parser.add_argument("--packets", type=int, default=20_000, help="how many are measured")
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
        cpu, wall = one.cpu_us, one.wall_us
        print(
            f"{name:10}{one.pushes:8}{cpu[0]:10.1f}{cpu[1]:8.1f}{cpu[2]:8.1f}"
            f"{wall[0]:10.1f}{wall[1]:8.1f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
