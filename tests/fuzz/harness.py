"""A campaign: seeded inputs to one target, within 5 s, 500 MB and errors of one clear line each.

Seconds are those of the processor, and memory is what is allocated beyond what was in use: how
busy the machine is, and what ran before, are no fault of an input. An input follows from the
target's name, a seed and its number alone, so that a failure can be had again without those before
it.
"""

from __future__ import annotations

import contextlib
import gc
import random
import re
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import FrameType

from mlbatch.errors import MlbatchError
from tests.fuzz.mutation import Seeds, mutated

# Of the processor, under coverage, on a slow machine; what is quadratic takes far longer.
LONGEST_S = 60.0
# Who waits for what never comes uses no processor: so long by the clock on the wall.
WAITING_S = 300.0
MOST_BYTES = 500_000_000
_LINE_CHARACTERS = 2000
_SHOWN_BYTES = 400
_PEAK = re.compile(r"VmHWM:\s+(\d+) kB")


class TooLate(BaseException):
    """An input took too long; not an `Exception`, so that nothing in between can swallow it."""


class BrokenLaw(AssertionError):
    """What was read is not what any input may give."""


@dataclass(frozen=True, slots=True)
class Target:
    """What is fuzzed: seeds makes them; run takes an input and a folder for files.

    share: of all inputs, by weight; first: changes for inputs; mlbatch may raise its own errors.
    """

    name: str
    seeds: Callable[[], Seeds]
    run: Callable[[bytes, Path], None]
    mutate: Callable[[random.Random, Seeds], bytes] = mutated
    share: int = 10


@dataclass(frozen=True, slots=True)
class Failure:
    """An input that must not do what it did; place: where it was raised, to distinguish causes."""

    target: str
    seed: int
    number: int
    what: str
    place: str
    data: bytes

    def __str__(self) -> str:
        shown = self.data[:_SHOWN_BYTES].hex() + ("..." if len(self.data) > _SHOWN_BYTES else "")
        return (
            f"{self.target} --seed {self.seed} --number {self.number} ({len(self.data)} bytes)\n"
            f"{self.what.rstrip()}\n{shown}"
        )


@dataclass(slots=True)
class Tally:
    """What a campaign came to; refused: inputs that gave an error of mlbatch.

    peak_bytes: most memory beyond what was in use before.
    """

    inputs: int = 0
    refused: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    slowest: int = 0
    peak_bytes: int = 0
    failures: list[Failure] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Take in what another part of the campaign came to."""
        self.inputs += other.inputs
        self.refused += other.refused
        self.seconds += other.seconds
        if other.slowest_s > self.slowest_s:
            self.slowest_s, self.slowest = other.slowest_s, other.slowest
        self.peak_bytes = max(self.peak_bytes, other.peak_bytes)
        known = {failure.place for failure in self.failures}
        self.failures += [one for one in other.failures if one.place not in known]


@lru_cache(maxsize=64)
def _seeds(target: Target) -> Seeds:
    return tuple(target.seeds())


def make_input(target: Target, seed: int, number: int) -> bytes:
    """The input of a number; the first ones are the seeds as they are."""
    seeds = _seeds(target)
    if seed == 0 and number < len(seeds):
        return seeds[number]
    return target.mutate(random.Random(f"{target.name} {seed} {number}"), seeds)


def campaign(
    target: Target, numbers: Iterable[int], seed: int = 0, most_failures: int = 10
) -> Tally:
    """Run the inputs of these numbers; one failure is kept of each place in the code."""
    tally = Tally()
    _seeds(target)
    before_bytes = _memory_bytes()[1]
    with tempfile.TemporaryDirectory(dir=_quick_folder()) as name, guarded():
        folder = Path(name)
        for number in numbers:
            data = make_input(target, seed, number)
            _forget_peak()
            began_s = time.process_time()
            with _in_memory():
                what, place = examine(target, data, folder)
            took_s = time.process_time() - began_s
            if _peak_ever_bytes() > before_bytes + tally.peak_bytes:
                needed = _peak_bytes() - before_bytes
                tally.peak_bytes = max(tally.peak_bytes, needed)
                if needed > MOST_BYTES:
                    what, place = f"needed {needed >> 20} MB\n{what}", "memory"
            tally.inputs += 1
            tally.seconds += took_s
            if took_s > tally.slowest_s:
                tally.slowest_s, tally.slowest = took_s, number
            if place == "refused":
                tally.refused += 1
            elif what and place not in {failure.place for failure in tally.failures}:
                tally.failures.append(Failure(target.name, seed, number, what, place, data))
                if len(tally.failures) >= most_failures:
                    break
    return tally


def examine(target: Target, data: bytes, folder: Path) -> tuple[str, str]:
    """What is wrong with how an input is taken, and the place it came from; "" for nothing."""
    began_s = time.process_time()
    try:
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
        signal.setitimer(signal.ITIMER_REAL, WAITING_S)
        try:
            target.run(data, folder)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
    except MlbatchError as err:
        fault = fault_of_line(str(err))
        return (f"the error {fault}: {err!r}", f"line {fault}") if fault else ("", "refused")
    except (Exception, TooLate) as err:
        if isinstance(err, MemoryError):
            _lift_limit()
        frames = traceback.extract_tb(err.__traceback__)
        own = [frame for frame in frames if "/mlbatch/" in frame.filename] or frames
        place = f"{type(err).__name__} {own[-1].filename}:{own[-1].lineno}"
        return traceback.format_exc(limit=-12), place
    if time.process_time() - began_s > LONGEST_S:
        return f"took more than {LONGEST_S:g} s", "late"
    return "", ""


def fault_of_line(line: str) -> str:
    """What is wrong with the text of an error, or ""."""
    if not line.strip():
        return "says nothing"
    if len(line.splitlines()) > 1 or not re.sub(r"\s", "", line).isprintable():
        return "is not one printable line"
    if len(line) > _LINE_CHARACTERS:
        return f"has more than {_LINE_CHARACTERS} characters"
    return ""


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Inputs run against the clock, and arithmetic may not warn."""
    signals = (signal.SIGPROF, signal.SIGALRM)
    before = [signal.signal(one, _late) for one in signals]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            yield
    finally:
        for one, handler in zip(signals, before, strict=True):
            signal.signal(one, handler)


@contextlib.contextmanager
def _in_memory() -> Iterator[None]:
    """Let this process have no more address space on top than an input may need."""
    mapped, _ = _memory_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if mapped:
        ceiling = mapped + MOST_BYTES
        limit = ceiling if hard == resource.RLIM_INFINITY else min(ceiling, hard)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _lift_limit() -> None:
    """Give back memory, so that the result can be reported."""
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    gc.collect()


def _late(_signal: int, _frame: FrameType | None) -> None:
    raise TooLate(f"still running after {LONGEST_S:g} s of the processor, or {WAITING_S:g} s")


def _memory_bytes() -> tuple[int, int]:
    """Address space and resident memory of this process; 0 where unknown."""
    try:
        words = Path("/proc/self/statm").read_text(encoding="ascii").split()
    except OSError:
        return 0, 0
    return int(words[0]) * resource.getpagesize(), int(words[1]) * resource.getpagesize()


def _peak_ever_bytes() -> int:
    """Peak memory of this process; quicker than `_peak_bytes`."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _peak_bytes() -> int:
    """Most memory that this process used since `_forget_peak`; 0 where unknown."""
    try:
        found = _PEAK.search(
            Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        )
    except OSError:
        return 0
    return int(found[1]) * 1024 if found else 0


def _forget_peak() -> None:
    """Earlier use is of no interest (proc(5), clear_refs)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _quick_folder() -> str | None:
    """Where files are written that nobody keeps."""
    memory = Path("/dev/shm")
    return str(memory) if memory.is_dir() else None
