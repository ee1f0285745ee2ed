"""Measures the cases: the programs of a case alternate, every other round in reverse order."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from tests.bench.cases import RECORDINGS, RIG, Case, Conversion, disk_bytes, is_current
from tests.bench.measure import BYTES_PER_MB, BenchError, machine, measure
from tests.bench.peers import PEERS, Peer, installed, run_peer
from tests.bench.results import (
    COPY,
    FLOOR,
    LIBRARY,
    OURS,
    PEER,
    STAGES,
    START,
    WRITE,
    Result,
    Row,
    Run,
    Workload,
    changes,
    ratios,
    read_document,
)

# A point of a scan in memory: x, y, z, intensity and labels.
_POINT_BYTES: Final = 24
_OUTPUT_OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "": ("--dry-run",),
    "mcap": ("-o", "out.mcap"),
    "npz": ("-o", "out", "--format", "npz"),
    "ply": ("-o", "out", "--format", "ply"),
}
# Names of floors in programs.py.
_FLOORS: Final[Mapping[str, str]] = {
    START: "start",
    COPY: "copy",
    WRITE: "write",
    LIBRARY: "mcap",
}


def no_progress(text: str) -> None:
    """Show nothing."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What to measure."""

    cases: tuple[Case, ...]
    seconds: float
    repeat: int
    # Interpreters of environments with peers.
    peer_pythons: tuple[str, ...] = ()
    # Folder of recordings to keep; None: a temporary one.
    keep: Path | None = None
    # Earlier document to compare with.
    against: Path | None = None
    progress: Callable[[str], None] = no_progress


@dataclass(frozen=True, slots=True)
class Program:
    """A program of a case; run: measures it once."""

    name: str
    role: str
    run: Callable[[], Run]
    base: str = ""


def bench(settings: Settings) -> Result:
    """Make the recordings, measure all cases, compare; raises BenchError."""
    before = {} if settings.against is None else read_document(settings.against)
    # Read first: the load of other processes, not of the benchmark.
    measured_on = machine()
    with _folders(settings) as (folder, scratch):
        session = BenchSession(settings, folder, scratch)
        rows = [row for case in settings.cases for row in session.measure(case)]
        return Result(
            date=datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
            machine=measured_on,
            seconds=settings.seconds,
            repeat=settings.repeat,
            rows=tuple(rows),
            ratios=tuple(ratios(rows)),
            notes=tuple(session.notes),
            failed=tuple(session.failed),
            changes=tuple(changes(rows, before)),
        )


@contextlib.contextmanager
def _folders(settings: Settings) -> Iterator[tuple[Path, Path]]:
    """The folder of the recordings, with enough free disk, and a temporary folder in it."""
    with contextlib.ExitStack() as stack:
        folder = settings.keep
        try:
            if folder is None:
                folder = Path(stack.enter_context(TemporaryDirectory(prefix="mlbatch-bench-")))
            folder.mkdir(parents=True, exist_ok=True)
            scratch = stack.enter_context(TemporaryDirectory(dir=folder, prefix="run-"))
            free_bytes = shutil.disk_usage(folder).free
        except OSError as err:
            raise BenchError(
                f"{folder or 'temporary folder'}: expected a folder to write to, found "
                f"{err.strerror}; choose another with --keep"
            ) from err
        needed_bytes = disk_bytes(settings.cases, settings.seconds)
        if free_bytes < needed_bytes:
            raise BenchError(
                f"{folder}: expected about {needed_bytes // BYTES_PER_MB} MB of free disk, found "
                f"{free_bytes // BYTES_PER_MB} MB; choose another with --keep, "
                "fewer --seconds or --case"
            )
        yield folder.resolve(), Path(scratch).resolve()


class BenchSession:
    """A running benchmark: its folders, notes, and the workload of the last conversion."""

    def __init__(self, settings: Settings, folder: Path, scratch: Path) -> None:
        self.settings = settings
        self.folder = folder
        self.scratch = scratch
        self.notes: list[str] = []
        self.failed: list[str] = []
        # Workload that the floors of the case repeat.
        self._converted = Workload()
        self._peers = self._find_peers()

    def measure(self, case: Case) -> Iterator[Row]:
        """Measure all programs of a case, alternately."""
        for name in case.recordings:
            self._recording(name)
        self._converted = Workload()
        programs = self._programs(case)
        runs: dict[str, list[Run]] = {program.name: [] for program in programs}
        for number in range(self.settings.repeat):
            for program in programs if number % 2 == 0 else reversed(programs):
                if program.name in runs:
                    self.settings.progress(f"{case.name}: {program.name}, run {number + 1}")
                    self._run(case, program, runs)
        for program in programs:
            if done := tuple(runs.get(program.name, ())):
                workload = done[-1].workload
                yield Row(case.name, program.name, program.role, program.base, workload, done)

    def _run(self, case: Case, program: Program, runs: dict[str, list[Run]]) -> None:
        """Run a program once; one that fails is noted and removed from `runs`."""
        try:
            run = program.run()
        except BenchError as err:
            self.notes.append(f"{case.name}: {err}")
            if program.role == OURS:
                self.failed.append(f"{case.name}: {program.name}")
            del runs[program.name]
            _delete_outputs(self.scratch)
            return
        earlier = runs[program.name]
        if earlier and earlier[-1].workload != run.workload:
            raise BenchError(
                f"{case.name}, {program.name}: expected the same counts in every run, found "
                f"{earlier[-1].workload} and {run.workload}"
            )
        earlier.append(run)

    def _programs(self, case: Case) -> list[Program]:
        """Conversions first: floors copy and write as many bytes as they did."""
        conversions = case.conversions()
        for conversion in conversions:
            # Not measured: the first run compiles modules. An error occurs again.
            with contextlib.suppress(BenchError):
                self._convert(conversion)
        programs = [Program(c.name, OURS, partial(self._convert, c), c.base) for c in conversions]
        programs += [Program(name, FLOOR, partial(self._floor, name)) for name in case.floors]
        programs += [
            Program(f"{peer.name} {version}", PEER, partial(self._peer, peer, case))
            for peer, (_, version) in self._peers.items()
            if peer.fits(case.first, case.output) and not case.variants
        ]
        return programs

    def _recording(self, name: str) -> Path:
        """Folder of a recording, which is made unless a current one exists."""
        folder = self.folder / f"{name}-{self.settings.seconds:g}s"
        if not is_current(folder, RECORDINGS[name]):
            folder.mkdir(exist_ok=True)
            self.settings.progress(f"making {name}")
            module = [sys.executable, "-m", "tests.bench.recordings"]
            seconds = str(self.settings.seconds)
            measure(f"recording {name}", [*module, name, seconds, str(folder)], self.scratch)
        return folder

    def _convert(self, conversion: Conversion) -> Run:
        folder = self._recording(conversion.recording)
        recording = folder / RECORDINGS[conversion.recording].file
        report_path = self.scratch / "report.json"
        command = [sys.executable, "-m", "mlbatch", "convert", str(recording), "--quiet"]
        command += ["--rig", str(folder / RIG), "--report", str(report_path), *conversion.options]
        command += _OUTPUT_OPTIONS[conversion.output]
        usage = measure(conversion.name, command, self.scratch)
        report = json.loads(report_path.read_text(encoding="utf-8"))
        report_path.unlink()
        timing = report["timing"]
        workload = Workload(
            slots=sum(sensor["points"]["slots"] for sensor in report["sensors"]),
            points=report["scans"]["points"],
            scans=report["scans"]["written"],
            recorded_s=self.settings.seconds,
            read_bytes=recording.stat().st_size,
            written_bytes=_delete_outputs(self.scratch),
        )
        # Floors repeat the output, else the first recording.
        if conversion.output or self._converted == Workload():
            self._converted = workload
        return Run(
            cpu_s=usage.cpu_s,
            wall_s=usage.wall_s,
            rss_mb=usage.rss_mb,
            own_cpu_s=float(timing["cpu_s"]),
            workload=workload,
            stages_s={name: timing[f"{name}_s"] for name in STAGES},
        )

    def _floor(self, name: str) -> Run:
        """Copy, or write, as many bytes as the last conversion."""
        done = self._converted
        size = done.written_bytes
        if name == COPY:
            size = done.read_bytes + (size or done.points * _POINT_BYTES)
        result = self.scratch / "floor.json"
        command = [sys.executable, "-m", "tests.bench.programs", _FLOORS[name], str(result)]
        usage = measure(name, [*command, str(size), str(done.scans)], self.scratch)
        _delete_outputs(self.scratch)
        found = json.loads(result.read_text(encoding="utf-8"))
        workload = Workload(done.slots, done.points, done.scans, done.recorded_s, 0, size)
        return Run(usage.cpu_s, found["wall_s"], usage.rss_mb, found["own_cpu_s"], workload)

    def _peer(self, peer: Peer, case: Case) -> Run:
        python, _ = self._peers[peer]
        folder = self._recording(case.first.name)
        return run_peer(peer, python, case.first, folder, self.settings.seconds, self.scratch)

    def _find_peers(self) -> dict[Peer, tuple[str, str]]:
        """Interpreter and version of each installed peer; the others are noted."""
        found: dict[Peer, tuple[str, str]] = {}
        for python in self.settings.peer_pythons:
            versions = installed(python, self.scratch)
            for peer in PEERS:
                if peer.distribution in versions:
                    found.setdefault(peer, (python, versions[peer.distribution]))
        missing = sorted({peer.distribution for peer in PEERS if peer not in found})
        self.notes += [f"{name} was not measured: no --peer-python has it" for name in missing]
        return found


def _delete_outputs(scratch: Path) -> int:
    """Delete all but JSON files; returns the number of bytes deleted."""
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
