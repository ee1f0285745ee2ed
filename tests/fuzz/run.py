"""A long campaign, in parallel: `python -m tests.fuzz.run --inputs 1000000`.

Every failing input is shown, and saved with the words that make it again; the exit code is then 1.
"""

from __future__ import annotations

import argparse
import faulthandler
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz import compiled, messages, outputs, packets, readers, sessions, texts
from tests.fuzz.harness import LONGEST_S, Failure, Tally, Target, campaign

# In the order in which they run.
TARGETS: Sequence[Target] = (
    *readers.TARGETS,
    *messages.TARGETS,
    *packets.TARGETS,
    *texts.TARGETS,
    *outputs.TARGETS,
    *sessions.TARGETS,
    *compiled.TARGETS,
)
FOLDER = Path("build") / "fuzz"
_PART = 2000
_REPORT_EVERY = 50_000
# What Python cannot interrupt (a search in C) ends the process with the place where it hung.
_HANG_S = 300


@dataclass(frozen=True, slots=True)
class Task:
    """A part of a campaign: numbers from `first` on of one target."""

    target: int
    seed: int
    first: int
    count: int


def main(words: Sequence[str] | None = None) -> int:
    """Run, show a table of the targets and what failed."""
    options = _options(words)
    chosen = [at for at, one in enumerate(TARGETS) if options.target in one.name]
    if options.number is not None:
        tasks = [Task(at, options.seed, options.number, 1) for at in chosen]
    else:
        tasks = list(_tasks(chosen, options.seed, options.inputs))
    began_s = time.monotonic()
    tallies, done = {at: Tally() for at in chosen}, 0
    with multiprocessing.get_context("spawn").Pool(options.processes, maxtasksperchild=40) as pool:
        for at, tally in pool.imap_unordered(_run, tasks):
            tallies[at].add(tally)
            done += tally.inputs
            if done // _REPORT_EVERY > (done - tally.inputs) // _REPORT_EVERY:
                print(f"{done:,} inputs, {time.monotonic() - began_s:.0f} s", flush=True)
            for failure in tally.failures:
                _save(failure)
                print(failure, flush=True)
            if options.minutes and time.monotonic() - began_s > options.minutes * 60:
                break
    _show(tallies, time.monotonic() - began_s)
    return int(any(tally.failures for tally in tallies.values()))


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Mutated inputs for everything that is read.")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="in total")
    parser.add_argument("--minutes", type=float, default=0.0, help="stop after, 0: never")
    parser.add_argument("--seed", type=int, default=1, help="of all inputs")
    parser.add_argument("--target", default="", help="only those with this in their name")
    parser.add_argument("--number", type=int, help="only this input, to see a failure again")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="in parallel")
    return parser.parse_args(words)


def _tasks(chosen: Sequence[int], seed: int, inputs: int) -> Iterator[Task]:
    """All parts, every target by its share, alternating, so that a time limit is fair."""
    shares = sum(TARGETS[at].share for at in chosen)
    left = {at: (0, -(-inputs * TARGETS[at].share // shares)) for at in chosen}
    while left:
        for at, (done, count) in list(left.items()):
            part = min(_PART, count - done)
            yield Task(at, seed, done, part)
            left[at] = done + part, count
            if done + part == count:
                del left[at]


def _run(task: Task) -> tuple[int, Tally]:
    faulthandler.dump_traceback_later(_HANG_S + task.count * LONGEST_S, exit=True)
    numbers = range(task.first, task.first + task.count)
    tally = campaign(TARGETS[task.target], numbers, task.seed)
    faulthandler.cancel_dump_traceback_later()
    return task.target, tally


def _save(failure: Failure) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    name = f"{failure.target.replace(' ', '_')}-{failure.seed}-{failure.number}"
    (FOLDER / name).write_bytes(failure.data)
    (FOLDER / f"{name}.txt").write_text(f"{failure}\n", encoding="utf-8", errors="replace")


def _show(tallies: dict[int, Tally], seconds: float) -> None:
    print(f"{'target':22} {'inputs':>9} {'refused':>9} {'ms each':>8} {'slowest ms':>10} {'MB':>5}")
    whole = Tally()
    for at, tally in tallies.items():
        whole.add(tally)
        _row(TARGETS[at].name, tally)
    _row("all", whole)
    print(f"{seconds:.0f} s, {len(whole.failures)} places failed")


def _row(name: str, tally: Tally) -> None:
    each_ms = 1e3 * tally.seconds / max(tally.inputs, 1)
    print(
        f"{name:22} {tally.inputs:9,} {tally.refused:9,} {each_ms:8.2f} "
        f"{tally.slowest_s * 1e3:10.0f} {tally.peak_bytes >> 20:5}"
    )


if __name__ == "__main__":
    raise SystemExit(main())
