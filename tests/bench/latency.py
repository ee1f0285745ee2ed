"""Latency from the receive time of a packet to the sub-scan that it completes.

    python -m tests.bench.latency RECORDING --rig RIG --slices 10

Packets are pushed one by one, as from a driver on the vehicle, through the classes of a conversion:
`Ingest.columns`, `Batcher.push`, `DecodeWorker.decode`. Garbage collection is on. CPU time of the
thread is the cost of the work, whatever else runs on the machine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.decode_pool import DecodePool
from mlbatch.pipeline.job import Job
from mlbatch.types import PacketBatch
from mlbatch.units import NS_PER_US


class Driver:
    """The stages of a conversion, fed packet by packet."""

    def __init__(self, job: Job) -> None:
        self.run = Conversion(job)
        # Created when the first window closes, as in a conversion.
        self._pool: DecodePool | None = None

    def push(self, batch: PacketBatch) -> int:
        """Push a batch, decode the windows it completes; returns the number of scans."""
        batcher = self.run.batcher
        oldest = (batcher.oldest_ring_index(sensor.index) for sensor in self.run.sensors)
        self.run.session.keep_from(min((one for one in oldest if one is not None), default=None))
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


def measure(job: Job, warm: int, packets: int) -> tuple[I64Array, I64Array]:
    """Push packets one by one: CPU time of the thread, ns, and completed scans of each.

    The first `warm` packets are left out.
    """
    driver = Driver(job)
    times = []
    for number, batch in enumerate(one_by_one(driver.run.session.packets())):
        if number == warm + packets:
            break
        began_ns = time.thread_time_ns()
        scans = driver.push(batch)
        times.append((time.thread_time_ns() - began_ns, scans))
    cpu_ns, scans_of = np.array(times[warm:], np.int64).reshape(-1, 2).T
    return cpu_ns, scans_of


def main(arguments: list[str] | None = None) -> None:
    """Measure; print quantiles of packets that complete a scan, and of the others."""
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
    options = parser.parse_args(arguments)
    selection = SensorSelection(rig=options.rig)
    job = Job((options.recording,), selection, slices=options.slices)
    cpu_ns, scans = measure(job, options.warm, options.packets)
    print(f"{'CPU, us':10}{'packets':>8}{'p50':>10}{'p99':>8}{'max':>8}")
    for name, chosen in (("closing", cpu_ns[scans > 0]), ("others", cpu_ns[scans == 0])):
        quantiles = np.quantile(chosen / NS_PER_US, (0.5, 0.99, 1.0), method="inverted_cdf")
        print("{:10}{:8}{:10.1f}{:8.1f}{:8.1f}".format(name, len(chosen), *quantiles))


if __name__ == "__main__":
    main()
