"""Batches that are killed at random and run again: are the outputs those of a run in one piece?

    python -m tests.batch_storm --sessions 40 --kills 20 --seed 1 [--mode threads|parts|dask]

Two sessions are no recordings, one crashes at every attempt, one is killed at its first. Drivers
get SIGKILL after random times; with `dask` workers do.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import random
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.batch.sessions import (
    Dataset,
    end,
    processes_of,
    run,
    scans,
    start,
    wait_for,
    write_dataset,
)

# Times to a kill, s.
_SHORTEST_S = 0.1
_LONGEST_S = 4.0
TWO = ("--workers", "2")


def names_of(count: int) -> list[str]:
    """Names of sessions; four of them fail or are killed."""
    return [*(f"s{i:03d}" for i in range(count - 4)), "crash", "hopeless1", "hopeless2", "killed"]


def expected(names: list[str]) -> dict[str, str]:
    """States of the first run."""
    return {name: "failed" if name.startswith(("crash", "hopeless")) else "done" for name in names}


@contextlib.contextmanager
def cluster_of(data: Dataset) -> Iterator[Any]:
    """Two Dask workers of one thread."""
    distributed = importlib.import_module("distributed")
    env = {name: data.env[name] for name in ("PYTHONPATH", "SABOTEUR_MARKS")}
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1", env=env
    ) as found:
        yield found


def storm(data: Dataset, out: Path, kills: int, words: tuple[str, ...]) -> None:
    """Kill drivers at random moments."""
    done = 0
    while done < kills:
        driver = start(data, out, *words)
        time.sleep(random.uniform(_SHORTEST_S, _LONGEST_S))
        done += driver.poll() is None
        driver.kill()
        driver.communicate()
        wait_for(lambda: not list(processes_of(str(out))))


def storm_of_workers(data: Dataset, out: Path, kills: int, cluster: Any) -> None:
    """Kill Dask workers at random moments of one batch; nannies start others."""
    driver = start(data, out, "--scheduler", cluster.scheduler_address)
    done = 0
    while driver.poll() is None and done < kills:
        time.sleep(random.uniform(_SHORTEST_S, _LONGEST_S))
        worker = random.choice(list(cluster.workers.values()))
        if worker.process is not None and worker.process.pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.process.pid, signal.SIGKILL)
                done += 1
    ended = end(driver)
    print(f"{done} workers killed: {ended.last}")


def main() -> None:
    """Run a storm and print figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=40)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mode", choices=("threads", "parts", "dask"), default="threads")
    given = parser.parse_args()
    random.seed(given.seed)
    names = names_of(given.sessions)
    with tempfile.TemporaryDirectory() as place:
        data = write_dataset(Path(place) / "data", names)
        whole = Path(place) / "whole"
        began_s = time.monotonic()
        first = run(data, whole, *TWO)
        print(f"first run: exit {first.code}, {time.monotonic() - began_s:.1f} s, {first.last}")
        assert first.table == expected(names), first.out
        began_s = time.monotonic()
        second = run(data, whole, *TWO)
        print(f"second run: exit {second.code}, {time.monotonic() - began_s:.2f} s, {second.last}")
        data.forget_kills()
        out = Path(place) / "out"
        if given.mode == "threads":
            storm(data, out, given.kills, TWO)
            last = [run(data, out, *TWO)]
        elif given.mode == "parts":
            for part in ("1/2", "2/2"):
                storm(data, out, given.kills // 2, ("--part", part))
            last = [run(data, out, "--part", part) for part in ("1/2", "2/2")]
        else:
            with cluster_of(data) as cluster:
                storm_of_workers(data, out, given.kills, cluster)
                last = [run(data, out, "--scheduler", cluster.scheduler_address, "--retry-failed")]
        for ended in last:
            print(f"after {given.kills} kills: exit {ended.code}, {ended.last}")
        table = {name: word for ended in last for name, word in ended.table.items()}
        left = {name: word.replace("skipped", "done") for name, word in table.items()}
        assert left == expected(names), table
        assert scans(out) == scans(whole)
        print(f"{len(scans(out))} files of scans are equal")


if __name__ == "__main__":
    main()
