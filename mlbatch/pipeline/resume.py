"""Resuming an interrupted conversion, so that its output equals that of an uninterrupted one.

Batching depends on nothing but packets and is cheap. A resumed run reads and batches everything
again, but skips what is slow: decoding and writing scans that the `.partial` already contains. The
counters of their points come from the state file; all else is computed again.

The state file `<OUTPUT>.partial.state` has one JSON object a line and only grows. The first line
identifies the job; each later one adds the scans that are safe since the line before. A line is
appended after the operating system has the data that it describes; a line cut off by a kill, and
those after it, are ignored. Data reach the disk later: after a restart of the machine only lines
before one with `synced` count.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import os
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

import mlbatch
from mlbatch.errors import ClockJump, ExportError, UsageError
from mlbatch.pipeline.conversion import Conversion
from mlbatch.pipeline.job import Job
from mlbatch.writers import (
    ScanWriter,
    WriterOptions,
    discard,
    discard_old,
    export_errors,
    partial_path,
)

# A kill costs no more than the work since the last line of the state file.
INTERVAL_S = 0.5
SCHEMA = "mlbatch.state/1"
_BOOT = Path("/proc/sys/kernel/random/boot_id")
# Fields of a job that are not part of its identity: digests of files and sensors replace them, or
# the output does not depend on them.
_NOT_IDENTITY = frozenset(
    {"recordings", "selection", "segment", "extras", "fault_begin_ns", "jobs", "engine"}
)
_DIGITS = 12

# Counts of the points of a scan, one list a sensor; see `ledger.POINT_COUNTERS`.
Row: TypeAlias = list[list[int]]
Line: TypeAlias = dict[str, object]


# -- an earlier run ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EarlierRun:
    """Remains of an earlier run to the same output."""

    state: State | None  # None if there is nothing to resume
    is_complete: bool  # the output exists, without a `.partial`
    was_published: bool  # it is complete, and the run was killed before it removed its state file


def find(target: Path) -> EarlierRun:
    """Find what is left of an earlier run to `target`; ExportError while another run writes it."""
    state = read_state(state_path(target))
    has_partial = partial_path(target).exists()
    is_complete = target.exists() and not has_partial
    can_resume = state is not None and bool(state.rows) and has_partial
    return EarlierRun(state if can_resume else None, is_complete, is_complete and state is not None)


def forget(target: Path) -> None:
    """Remove the state of an earlier run, and what it would have removed last."""
    state_path(target).unlink(missing_ok=True)
    discard_old(target)


def abandon(target: Path) -> None:
    """Remove all that an interrupted run left."""
    forget(target)
    discard(target)


def find_jump(job: Job) -> ClockJump | None:
    """First clock step in the session of a job, None without; nothing is decoded."""
    run = Conversion(job)
    try:
        for _ in run.windows():
            pass
    except ClockJump as jump:
        return jump
    return None


# -- the run ----------------------------------------------------------------------------------


class ResumeLog:
    """Progress of one output, in memory and in its state file.

    recorded: scans in the state file.
    """

    def __init__(
        self, target: Path, job: Job, name: str, options: WriterOptions, state: State | None
    ) -> None:
        """name: of the format; state: of the run to resume, None: start over."""
        self._target = target
        self._identity = job_identity(job, name, options)
        self._segment = str(job.segment)
        if state is not None and state.segment != self._segment:
            # The end of the segment was not known then: its last scans may be other ones now.
            state = None
        self._state = state
        self._file: StateFile | None = None
        self._waiting: deque[Row] = deque()
        self._given = 0
        self.recorded = self.done
        self._due_s = 0.0

    @property
    def done(self) -> int:
        """Scans that the `.partial` already contains."""
        return 0 if self._state is None else len(self._state.rows)

    @property
    def kept_bytes(self) -> int | None:
        """Bytes of the output's file to keep; None: nothing to resume."""
        return None if self._state is None else self._state.kept_bytes

    def join(self, run: Conversion) -> None:
        """Pass the finished scans to a run; UsageError if it is another job."""
        self._identity |= input_identity(run)
        if self._state is None:
            return
        changed = difference(self._state.identity, self._identity)
        if changed:
            raise UsageError(
                f"{partial_path(self._target)}: expected the job of the interrupted run, found "
                f"{changed}; give the same, or leave out --resume to start over"
            )
        run.earlier = iter(self._state.rows)

    def begin(self) -> None:
        """Open the state file, before the output: from now on no other run writes it."""
        is_new = self._state is None
        state = self._state or State(self._identity, self._segment)
        self._file = StateFile(state_path(self._target), state, is_new=is_new)
        self._due_s = time.monotonic() + INTERVAL_S

    def note(self, outcomes: Row, writer: ScanWriter) -> None:
        """Note a scan that was written or skipped; call in the order of the scans."""
        self._given += 1
        if self._given <= self.done:
            return
        self._waiting.append(outcomes)
        if time.monotonic() >= self._due_s:
            self._record(writer)
            self._due_s = time.monotonic() + INTERVAL_S

    def _record(self, writer: ScanWriter) -> None:
        checkpoint = writer.checkpoint()
        # With several jobs later scans may be safe, which were not noted yet.
        scans = min(checkpoint.scans, self._given)
        fresh = scans - self.recorded
        if fresh > 0 and self._file is not None:
            self._file.add([self._waiting.popleft() for _ in range(fresh)], checkpoint.kept_bytes)
            self.recorded = scans

    def complete(self) -> None:
        """Raise UsageError if the `.partial` contains more scans than the recording gives."""
        if self._given < self.done:
            raise UsageError(
                f"{partial_path(self._target)}: expected the {self.done} scans of the interrupted "
                f"run again, found {self._given}; leave out --resume to start over"
            )

    def sync(self) -> None:
        """Force what is done to the disk; call when the run ends early."""
        if self._file is None:
            return
        if partial_path(self._target).exists():
            self._file.sync()
        else:
            # The output could not be opened.
            self._file.remove()

    def discard(self) -> None:
        """Remove the output and its state; call when the run ends without a scan."""
        if self._file is not None:
            self._file.remove()
            self._file = None
            discard(self._target)

    def remove(self) -> None:
        """Remove the state file; call when the output has its final name."""
        if self._file is not None:
            self._file.remove()
            self._file = None


# -- the state file ---------------------------------------------------------------------------


@dataclass(slots=True)
class State:
    """Content of a state file."""

    identity: dict[str, str]  # of job and inputs: see `job_identity` and `input_identity`
    segment: str  # of the session, as text
    rows: list[Row] = field(default_factory=list)  # one for each safe scan
    kept_bytes: int = 0  # of the output's file, with these scans
    length: int = 0  # bytes of the valid lines


def state_path(target: Path) -> Path:
    """Path of the state file of an output under construction."""
    partial = partial_path(target)
    return partial.with_name(f"{partial.name}.state")


def read_state(path: Path) -> State | None:
    """State that a killed run left, None if there is none; ExportError while the run lives."""
    try:
        with path.open("r+b") as file:
            _lock(file, path)
            return _parse(file)
    except FileNotFoundError:
        return None
    except OSError as err:
        raise ExportError(
            f"{path}: expected a readable state file, found {err.strerror!r}; leave out --resume "
            "to start over"
        ) from err


class StateFile:
    """The state file of a run; locked while it is open, so that no other run uses it."""

    def __init__(self, path: Path, state: State, *, is_new: bool) -> None:
        self._path = path
        with export_errors(path):
            # Truncated only after it is locked.
            self._file = io.FileIO(path, "a" if is_new else "r+")
            _lock(self._file, path)
            self._file.truncate(state.length)
            self._file.seek(state.length)
        boot: Line = {"boot": _boot()}
        if is_new:
            boot |= {"schema": SCHEMA, "part": state.segment, "identity": state.identity}
        self._append(boot)

    def add(self, rows: list[Row], kept_bytes: int) -> None:
        """Add scans that are safe within the first `kept_bytes` of the output's file."""
        self._append({"kept_bytes": kept_bytes, "scans": rows})

    def sync(self) -> None:
        """Force the output and the state to the disk, as far as possible."""
        with contextlib.suppress(OSError, ExportError):
            os.sync()
            self._append({"synced": True})
        self._file.close()

    def remove(self) -> None:
        """Remove the file: the output is complete."""
        with export_errors(self._path):
            self._path.unlink(missing_ok=True)
        self._file.close()

    def _append(self, line: Line) -> None:
        left = memoryview(json.dumps(line, separators=(",", ":")).encode() + b"\n")
        with export_errors(self._path):
            while left:
                left = left[self._file.write(left) :]


def _lock(file: io.FileIO | io.BufferedRandom, path: Path) -> None:
    """Keep other runs away; the system releases the lock of a killed one."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as err:
        target = path.name.removesuffix(".partial.state")
        raise ExportError(
            f"{path.with_name(target)}: expected no other run that writes it, found one; wait for "
            "its end or choose another output"
        ) from err
    except OSError:
        # Some network file systems have no locks.
        return


def _parse(file: io.BufferedRandom) -> State | None:
    """The lines that count."""
    state: State | None = None
    rows: list[Row] = []
    count = 0
    kept_bytes = 0
    now = _boot()
    boot = ""
    for line, end in _lines(file):
        boot = str(line.get("boot", boot))
        if state is None:
            state = _head(line)
            if state is None:
                return None
        elif "scans" in line:
            added = _rows(line["scans"])
            size = line.get("kept_bytes")
            if added is None or not isinstance(size, int) or size < kept_bytes:
                break
            rows += added
            kept_bytes = size
        if boot == now or "synced" in line:
            count = len(rows)
            state.kept_bytes = kept_bytes
            state.length = end
    if state is not None:
        state.rows = rows[:count]
    return state


def _lines(file: io.BufferedRandom) -> Iterator[tuple[Line, int]]:
    """Whole lines, each with the bytes up to its end."""
    end = 0
    for text in file:
        end += len(text)
        try:
            line = json.loads(text)
        except ValueError:
            return
        if not text.endswith(b"\n") or not isinstance(line, dict):
            return
        yield line, end


def _head(line: Line) -> State | None:
    identity = line.get("identity")
    if line.get("schema") != SCHEMA or not isinstance(identity, Mapping):
        return None
    texts = {str(name): str(value) for name, value in identity.items()}
    return State(texts, str(line.get("part")))


def _rows(found: object) -> list[Row] | None:
    """Rows of counts, None if the value of a line is something else."""
    if not isinstance(found, list):
        return None
    for row in found:
        if not isinstance(row, list) or not all(isinstance(counts, list) for counts in row):
            return None
        if not all(isinstance(n, int) and n >= 0 for counts in row for n in counts):
            return None
    return found


def _boot() -> str:
    """Identifier that changes with every start of the machine; "" where there is none."""
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return ""


# -- the identity of a job --------------------------------------------------------------------


def job_identity(job: Job, name: str, options: WriterOptions) -> dict[str, str]:
    """Options of a job by name, as texts; name: of the format."""
    found = {"mlbatch": mlbatch.__version__, "numpy": np.__version__, "format": name}
    found["point layout"] = options.point_layout
    found["compression"] = options.compression
    for key, value in _options(job):
        found[key.replace("_", " ")] = _text(value)
    return found


def input_identity(run: Conversion) -> dict[str, str]:
    """Sizes and times of the recordings, digests of calibrations and poses."""
    found = {}
    for number, path in enumerate(run.job.recordings):
        found[f"recording {number + 1}"] = f"{path.name} ({_size_and_time(path)})"
    for sensor in run.sensors:
        lidar = sensor.lidar
        calibration = (lidar.model, lidar.mode, lidar.beams, lidar.firing_ns, lidar.channel)
        found[f"calibration of {sensor.name}"] = _digest(calibration)
        pose = (sensor.body_from_sensor, sensor.clock.offset_ns)
        found[f"pose of {sensor.name}"] = _digest(pose)
    found["rig"] = _digest(run.session.setup.rig)
    found["sensors"] = ", ".join(sensor.name for sensor in run.sensors)
    return found


def difference(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """First difference between two identities, as text; "" if they are equal."""
    for key in (*old, *new):
        before = old.get(key, "none")
        now = new.get(key, "none")
        if before != now:
            return f"{key} {now or 'not given'!r} instead of {before or 'not given'!r}"
    return ""


def _options(job: Job) -> Iterator[tuple[str, object]]:
    for holder in (job, job.selection):
        for one in fields(holder):
            if one.name not in _NOT_IDENTITY:
                yield one.name, getattr(holder, one.name)


def _text(value: object) -> str:
    """A value as a user would write it, the same in every process."""
    if value is None or value == () or value == {}:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={_text(value[key])}" for key in sorted(value))
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return str(value)


def _size_and_time(path: Path) -> str:
    """Size and last modification of a recording, or of all files of its folder."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    stats = [file.stat() for file in files]
    size = sum(one.st_size for one in stats)
    return f"{size} bytes, changed at {max((one.st_mtime_ns for one in stats), default=0)} ns"


def _digest(value: object) -> str:
    import hashlib

    digest = hashlib.sha256()
    for piece in _pieces(value):
        digest.update(piece)
    return digest.hexdigest()[:_DIGITS]


def _pieces(value: object) -> Iterator[bytes]:
    """A value as bytes that are the same in every process."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        for one in fields(value):
            yield one.name.encode()
            yield from _pieces(getattr(value, one.name))
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield str(key).encode()
            yield from _pieces(value[key])
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _pieces(item)
    else:
        yield f"{value!r};".encode()
