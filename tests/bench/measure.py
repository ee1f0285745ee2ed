"""One measured process, and cases of them measured in turn and compared pair by pair.

CPU is user plus system time of the process and its threads, and memory its largest resident set,
both of `wait4`. Linux counts a parent's pages at the fork into the peak of its child, so nothing
here imports numpy.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
KIB_PER_MB: Final = 1e6 / 1024


class BenchError(Exception):
    """A command that failed, told in one line."""


@dataclass(frozen=True, slots=True)
class Found:
    """What a run counted: its points and the (channel, return) slots they came from."""

    slots: int
    points: int
    written_bytes: int = 0
    scans: int = 0


@dataclass(frozen=True, slots=True)
class Usage:
    """What one process used."""

    cpu_s: float
    wall_s: float
    rss_mb: float
    stdout: str


@dataclass(slots=True)
class Case:
    """A command and its measurements: CPU and wall time in s, peak memory in MB (1e6 bytes)."""

    name: str
    measure: Callable[[], tuple[Usage, Found]]
    cpu_s: list[float] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    rss_mb: list[float] = field(default_factory=list)
    found: Found = Found(0, 0)

    def run(self) -> None:
        """Measure once more."""
        usage, found = self.measure()
        self.cpu_s.append(usage.cpu_s)
        self.wall_s.append(usage.wall_s)
        self.rss_mb.append(usage.rss_mb)
        if self.found not in (Found(0, 0), found):
            raise BenchError(f"{self.name}: two runs differ: {self.found} and {found}")
        self.found = found


@dataclass(frozen=True, slots=True)
class Spread:
    """Smallest, middle and largest of some values."""

    least: float
    median: float
    most: float

    def __str__(self) -> str:
        return f"{self.least:8.3f} {self.median:8.3f} {self.most:8.3f}"


def spread(values: list[float]) -> Spread:
    """Spread of at least one value."""
    return Spread(min(values), statistics.median(values), max(values))


def ratios(ours: list[float], theirs: list[float]) -> list[float]:
    """Ratios pair by pair."""
    return [a / b for a, b in zip(ours, theirs, strict=True)]


def measure(command: list[str]) -> Usage:
    """Run a command to its end; raises BenchError with its last line of stderr if it fails."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=out, stderr=err, env=environment, cwd=ROOT)
        _, status, used = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        err.seek(0)
        if process.returncode:
            last = (err.read().strip().splitlines() or ["no message"])[-1]
            raise BenchError(
                f"{' '.join(command)}: wanted exit 0, got {process.returncode}: {last}"
            )
        cpu_s = used.ru_utime + used.ru_stime
        return Usage(cpu_s, wall_s, used.ru_maxrss / KIB_PER_MB, out.read())


def repeat(cases: list[Case], times: int) -> None:
    """Run all cases in turn, `times` over."""
    for _ in range(times):
        for case in cases:
            case.run()


def show(cases: list[Case]) -> None:
    """Print a row for each case."""
    print(
        f"{'case':20}{'n':>3} {'CPU min':>8} {'median':>8} {'max':>8} s {'wall':>8} s"
        f" {'peak':>7} MB {'slots':>12} {'points':>12} {'ns/slot':>8}"
    )
    for case in cases:
        cpu = spread(case.cpu_s)
        slots = case.found.slots
        print(
            f"{case.name:20}{len(case.cpu_s):3} {cpu} s {statistics.median(case.wall_s):8.3f} s"
            f" {max(case.rss_mb):7.1f} MB {slots:12} {case.found.points:12}"
            f" {cpu.median * 1e9 / max(1, slots):8.3f}"
        )


def plain(case: Case) -> dict[str, object]:
    """The measurements of a case, for JSON."""
    return {
        "name": case.name,
        "cpu_s": case.cpu_s,
        "wall_s": case.wall_s,
        "rss_mb": case.rss_mb,
        "found": asdict(case.found),
    }
