"""Measures the cases: all programs of a case in turn, every other round in reverse."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from mlbatch.bench import peers
from mlbatch.bench.cases import CAPTURE, RIG, Case, Conversion, disk_bytes, is_made
from mlbatch.bench.measure import BenchError, machine, measure
from mlbatch.bench.results import (
    COPY,
    FLOOR,
    LIBRARY,
    OURS,
    PEER,
    START,
    WRITE,
    Counted,
    Result,
    Row,
    Run,
    changes,
    ratios,
    read_document,
)

# A scan takes this much of a point in memory: x, y, z, intensity and label.
_POINT_BYTES: Final = 24
_BYTES_PER_MB: Final = 1_000_000
_SUFFIXES: Final[Mapping[str, tuple[str, ...]]] = {
    "mcap": ("-o", "out.mcap"),
    "npz": ("-o", "out", "--format", "npz"),
    "ply": ("-o", "out", "--format", "ply"),
}
_FLOORS: Final[Mapping[str, str]] = {
    START: "start",
    COPY: "copy",
    WRITE: "write",
    LIBRARY: "mcap",
}
_STAGES: Final = ("read", "decode", "merge", "write")


@dataclass(frozen=True, slots=True)
class Settings:
    """What to measure; keep: a folder for the recordings, else they go; tell: shows progress."""

    cases: tuple[Case, ...]
    engines: tuple[str, ...]
    seconds: float
    repeat: int
    peer_pythons: tuple[str, ...] = ()
    keep: Path | None = None
    against: Path | None = None
    notes: tuple[str, ...] = ()
    tell: Callable[[str], None] = field(default=lambda text: None)


@dataclass(frozen=True, slots=True)
class Program:
    """Something that can be measured again and again."""

    name: str
    role: str
    run: Callable[[], Run]
    base: str = ""


def bench(settings: Settings) -> Result:
    """Make the recordings, measure all cases, compare; raises BenchError where it cannot."""
    before = {} if settings.against is None else read_document(settings.against)
    # First, since the load is to be that of others.
    told = machine()
    with _place(settings) as (folder, scratch):
        session = Session(settings, folder, scratch)
        rows = [row for case in settings.cases for row in session.measure(case)]
        return Result(
            datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
            told,
            settings.seconds,
            settings.repeat,
            tuple(rows),
            tuple(ratios(rows)),
            (*settings.notes, *session.notes),
            tuple(session.failed),
            tuple(changes(rows, before)),
        )


@contextlib.contextmanager
def _place(settings: Settings) -> Iterator[tuple[Path, Path]]:
    """Where recordings lie, with enough room, and a folder in it for outputs."""
    with contextlib.ExitStack() as stack:
        folder = settings.keep
        try:
            if folder is None:
                folder = Path(stack.enter_context(TemporaryDirectory(prefix="mlbatch-bench-")))
            folder.mkdir(parents=True, exist_ok=True)
            scratch = stack.enter_context(TemporaryDirectory(dir=folder, prefix="run-"))
            free = shutil.disk_usage(folder).free
        except OSError as err:
            raise BenchError(
                f"{folder or 'temporary folder'}: wanted a folder to write to, got "
                f"{err.strerror}; choose another with --keep"
            ) from err
        wanted = disk_bytes(settings.cases, settings.seconds)
        if free < wanted:
            raise BenchError(
                f"{folder}: wanted about {wanted // _BYTES_PER_MB} MB of free disk, got "
                f"{free // _BYTES_PER_MB} MB; choose another with --keep, fewer --seconds or --case"
            )
        yield folder.resolve(), Path(scratch).resolve()


class Session:
    """The state of a benchmark: where things lie, and what the case at hand wrote."""

    def __init__(self, settings: Settings, folder: Path, scratch: Path) -> None:
        self.settings = settings
        self.folder = folder
        self.scratch = scratch
        self.notes: list[str] = []
        self.failed: list[str] = []
        self._converted = Counted()
        self._peers = self._find_peers()

    def measure(self, case: Case) -> Iterator[Row]:
        """All programs of a case, in turn."""
        for name in case.recordings:
            self._recording(name)
        self._converted = Counted()
        programs = self._programs(case)
        runs: dict[str, list[Run]] = {program.name: [] for program in programs}
        for number in range(self.settings.repeat):
            for program in programs if number % 2 == 0 else reversed(programs):
                if program.name in runs:
                    self.settings.tell(f"{case.name}: {program.name}, run {number + 1}")
                    self._run(case, program, runs)
        for program in programs:
            if found := tuple(runs.get(program.name, ())):
                counted = found[-1].counted
                yield Row(case.name, program.name, program.role, program.base, counted, found)

    def _run(self, case: Case, program: Program, runs: dict[str, list[Run]]) -> None:
        try:
            run = program.run()
        except BenchError as err:
            self.notes.append(f"{case.name}: {err}")
            if program.role == OURS:
                self.failed.append(f"{case.name}: {program.name}")
            del runs[program.name]
            _taken_away(self.scratch)
            return
        earlier = runs[program.name]
        if earlier and earlier[-1].counted != run.counted:
            raise BenchError(
                f"{case.name}, {program.name}: wanted the same counts in every run, got "
                f"{earlier[-1].counted} and {run.counted}"
            )
        earlier.append(run)

    def _programs(self, case: Case) -> list[Program]:
        """Conversions first: floors copy and write as much as they did."""
        conversions = case.conversions(self.settings.engines)
        for conversion in conversions:
            # Modules and kernels are compiled when they are first needed; errors come again.
            with contextlib.suppress(BenchError):
                self._convert(conversion)
        found = [Program(c.name, OURS, partial(self._convert, c), c.base) for c in conversions]
        found += [Program(name, FLOOR, partial(self._floor, name)) for name in case.floors]
        found += [
            Program(f"{peer.name} {version}", PEER, partial(self._peer, peer, case))
            for peer, (_, version) in self._peers.items()
            if peer.fits(case.first, case.output) and not case.variants
        ]
        return found

    def _recording(self, name: str) -> Path:
        """The folder of a recording, made if it is not there, or was made otherwise."""
        folder = self.folder / f"{name}-{self.settings.seconds:g}s"
        if not is_made(folder):
            folder.mkdir(exist_ok=True)
            self.settings.tell(f"making {name}")
            module = [sys.executable, "-m", "mlbatch.bench.recordings"]
            seconds = str(self.settings.seconds)
            measure(f"recording {name}", [*module, name, seconds, str(folder)], self.scratch)
        return folder

    def _convert(self, conversion: Conversion) -> Run:
        folder = self._recording(conversion.recording)
        report = self.scratch / "report.json"
        command = [sys.executable, "-m", "mlbatch", "convert", str(folder / CAPTURE), "--quiet"]
        command += ["--rig", str(folder / RIG), "--report", str(report), *conversion.options]
        command += ["--engine", conversion.engine]
        command += _SUFFIXES[conversion.output] if conversion.output else ["--dry-run"]
        usage = measure(conversion.name, command, self.scratch)
        told = json.loads(report.read_text(encoding="utf-8"))
        report.unlink()
        timing = told["timing"]
        counted = Counted(
            sum(sensor["points"]["slots"] for sensor in told["sensors"]),
            *(told["scans"]["points"], told["scans"]["written"], self.settings.seconds),
            *((folder / CAPTURE).stat().st_size, _taken_away(self.scratch)),
        )
        stages_s = {name: timing[f"{name}_s"] for name in _STAGES}
        # Floors follow the output, else the first recording.
        if conversion.output or self._converted == Counted():
            self._converted = counted
        return Run(
            usage.cpu_s, usage.wall_s, usage.rss_mb, float(timing["cpu_s"]), counted, stages_s
        )

    def _floor(self, name: str) -> Run:
        """Copy, or write, as much as the conversion before it."""
        done = self._converted
        size = done.written_bytes
        if name == COPY:
            size = done.read_bytes + (size or done.points * _POINT_BYTES)
        result = self.scratch / "floor.json"
        command = [sys.executable, "-m", "mlbatch.bench.floors", _FLOORS[name], str(size)]
        usage = measure(name, [*command, str(done.scans), str(result)], self.scratch)
        _taken_away(self.scratch)
        told = json.loads(result.read_text(encoding="utf-8"))
        counted = Counted(done.slots, done.points, done.scans, done.recorded_s, 0, size)
        return Run(usage.cpu_s, told["wall_s"], usage.rss_mb, told["cpu_s"], counted)

    def _peer(self, peer: peers.Peer, case: Case) -> Run:
        python, _ = self._peers[peer]
        folder, seconds = self._recording(case.first.name), self.settings.seconds
        return peers.run_peer(peer, python, case.first, folder, seconds, self.scratch)

    def _find_peers(self) -> dict[peers.Peer, tuple[str, str]]:
        """Interpreter and version of each peer that is there."""
        found: dict[peers.Peer, tuple[str, str]] = {}
        for python in self.settings.peer_pythons:
            versions = peers.installed(python, self.scratch)
            for peer in peers.PEERS:
                if peer.distribution in versions:
                    found.setdefault(peer, (python, versions[peer.distribution]))
        missing = sorted({peer.distribution for peer in peers.PEERS if peer not in found})
        self.notes += [f"{name} was not measured: no --peer-python has it" for name in missing]
        return found


def _taken_away(scratch: Path) -> int:
    """Delete all but documents; returns the bytes of that."""
    size = 0
    for path in scratch.iterdir():
        if path.suffix == ".json":
            continue
        if path.is_dir():
            size += sum(inner.stat().st_size for inner in path.iterdir())
            shutil.rmtree(path)
        else:
            size += path.stat().st_size
            path.unlink()
    return size
