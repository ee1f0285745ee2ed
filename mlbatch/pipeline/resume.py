"""Going on where an interrupted conversion stopped, so that its output does not show it.

Batching depends on nothing but packets and is cheap. So a resumed run reads and batches everything
again, and leaves out what is slow: decoding and writing scans that the `.partial` already holds.
What became of their points comes from the state file, all else is computed again.
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

# A kill costs no more than what was done since the last line of the state file.
INTERVAL_S = 0.5


@dataclass(frozen=True, slots=True)
class Found:
    """What an earlier run to the same output left.

    state: to go on from, None: nothing; is_complete: the output stands alone under its name;
    was_published: and the run that put it there was killed right after that.
    """

    state: State | None
    is_complete: bool
    was_published: bool


def find(target: Path) -> Found:
    """What is left of an earlier run to `target`; an error while another run writes it."""
    state = read_state(state_path(target))
    has_partial = partial_path(target).exists()
    is_complete = target.exists() and not has_partial
    can_go_on = state is not None and bool(state.rows) and has_partial
    return Found(state if can_go_on else None, is_complete, is_complete and state is not None)


def forget(target: Path) -> None:
    """Remove the state of an earlier run, and what it would have removed last."""
    state_path(target).unlink(missing_ok=True)
    discard_old(target)


def abandon(target: Path) -> None:
    """Remove all that an interrupted run left."""
    forget(target)
    discard(target)


def jump_in(job: Job) -> ClockJump | None:
    """Where the clock of a sensor jumps; nothing is decoded."""
    run = Conversion(job)
    try:
        for _ in run.windows():
            pass
    except ClockJump as jump:
        return jump
    return None


class ResumeLog:
    """How far the output of one run has come, in the run's memory and in its state file."""

    def __init__(
        self, target: Path, job: Job, name: str, options: WriterOptions, state: State | None
    ) -> None:
        """name: of the format; state: of the run to continue, None: begin anew."""
        self._target = target
        self._identity = of_job(job, name, options)
        self._part = str(job.part)
        if state is not None and state.part != self._part:
            # A part whose end was not known yet: not all of its scans are those of the shorter one.
            state = None
        self._state = state
        self._file: StateFile | None = None
        self._waiting: deque[Row] = deque()
        self._given = 0
        self.recorded = self.done
        self._due_s = 0.0

    @property
    def done(self) -> int:
        """Scans that the `.partial` already holds."""
        return 0 if self._state is None else len(self._state.rows)

    @property
    def kept_bytes(self) -> int | None:
        """What stays of the output's file; None: there is nothing to continue."""
        return None if self._state is None else self._state.kept_bytes

    def join(self, run: Conversion) -> None:
        """Refuse to continue what another job began, and tell the run which scans are done."""
        self._identity |= of_inputs(run)
        if self._state is None:
            return
        changed = difference(self._state.identity, self._identity)
        if changed:
            raise UsageError(
                f"{partial_path(self._target)}: wanted the job of the interrupted run to go on "
                f"with, got {changed}; give the same, or leave out --resume to begin anew"
            )
        run.earlier = iter(self._state.rows)

    def begin(self) -> None:
        """Open the state file, before the output: from now on no other run writes it."""
        is_new = self._state is None
        state = self._state or State(self._identity, self._part)
        self._file = StateFile(state_path(self._target), state, is_new=is_new)
        self._due_s = time.monotonic() + INTERVAL_S

    def note(self, fates: Row, writer: ScanWriter) -> None:
        """Take notice of a scan that was written or gone past, in the order of the scans.

        fates: of the slots of every sensor in it.
        """
        self._given += 1
        if self._given <= self.done:
            return
        self._waiting.append(fates)
        if time.monotonic() >= self._due_s:
            self._record(writer)
            self._due_s = time.monotonic() + INTERVAL_S

    def _record(self, writer: ScanWriter) -> None:
        safe = writer.checkpoint()
        # With several jobs later scans may be safe, of which nothing is known so far.
        scans = min(safe.scans, self._given)
        fresh = scans - self.recorded
        if fresh > 0 and self._file is not None:
            self._file.add([self._waiting.popleft() for _ in range(fresh)], safe.kept_bytes)
            self.recorded = scans

    def complete(self) -> None:
        """Refuse an output that holds more than the recording gives."""
        if self._given < self.done:
            raise UsageError(
                f"{partial_path(self._target)}: wanted {self.done} scans of the interrupted run "
                f"again, got {self._given}; leave out --resume to begin anew"
            )

    def sync(self) -> None:
        """The run ends early: force to the disk what it has done."""
        if self._file is None:
            return
        if partial_path(self._target).exists():
            self._file.sync()
        else:
            # The output could not be opened.
            self._file.remove()

    def discard(self) -> None:
        """The run ends without a scan: nothing of what it wrote stays."""
        if self._file is not None:
            self._file.remove()
            self._file = None
            discard(self._target)

    def remove(self) -> None:
        """The output has its final name."""
        if self._file is not None:
            self._file.remove()
            self._file = None


# The state file of an output under construction: from where a resumed run goes on.
#
# `<OUTPUT>.partial.state` has one JSON object a line and only grows. The first line says what is
# made of what; each later one, which scans are safe since the one before. A line is appended
# once the system has what it tells of; a line that a kill cut off counts for nothing, and those
# after it.
#
# What the system has reaches the disk later. So after a restart of the machine only those lines
# count that a clean end has forced to the disk (`synced`).

SCHEMA = "mlbatch.state/1"
_BOOT = Path("/proc/sys/kernel/random/boot_id")
# Fates of the slots of every sensor in a scan; see `ledger.POINT_FATES`.
Row: TypeAlias = list[list[int]]
Line: TypeAlias = dict[str, object]


@dataclass(slots=True)
class State:
    """What a state file tells.

    identity: what is made of what; part: of the session; rows: of the scans that are safe;
    kept_bytes: of the output's file that hold them; length: bytes of the lines that count.
    """

    identity: dict[str, str]
    part: str
    rows: list[Row] = field(default_factory=list)
    kept_bytes: int = 0
    length: int = 0


def state_path(target: Path) -> Path:
    """Where the state of an output under construction lies."""
    partial = partial_path(target)
    return partial.with_name(f"{partial.name}.state")


def read_state(path: Path) -> State | None:
    """What a killed run left, None where that is nothing; an error while the run lives."""
    try:
        with path.open("r+b") as file:
            _lock(file, path)
            return _parsed(file)
    except FileNotFoundError:
        return None
    except OSError as err:
        raise ExportError(
            f"{path}: wanted to read it, got {err.strerror!r}; leave out --resume to begin anew"
        ) from err


class StateFile:
    """The state file of a run that goes on; while it is open no other run may use it."""

    def __init__(self, path: Path, state: State, *, is_new: bool) -> None:
        self._path = path
        with export_errors(path):
            # Not emptied before it is ours.
            self._file = io.FileIO(path, "a" if is_new else "r+")
            _lock(self._file, path)
            self._file.truncate(state.length)
            self._file.seek(state.length)
        boot: Line = {"boot": _boot()}
        if is_new:
            boot |= {"schema": SCHEMA, "part": state.part, "identity": state.identity}
        self._append(boot)

    def add(self, rows: list[Row], kept_bytes: int) -> None:
        """Say that these scans are safe, too, within so many bytes of the output's file."""
        self._append({"kept_bytes": kept_bytes, "scans": rows})

    def sync(self) -> None:
        """Force to the disk what all lines tell of, as far as it will."""
        with contextlib.suppress(OSError, ExportError):
            os.sync()
            self._append({"synced": True})
        self._file.close()

    def remove(self) -> None:
        """The output is complete."""
        with export_errors(self._path):
            self._path.unlink(missing_ok=True)
        self._file.close()

    def _append(self, line: Line) -> None:
        left = memoryview(json.dumps(line, separators=(",", ":")).encode() + b"\n")
        with export_errors(self._path):
            while left:
                left = left[self._file.write(left) :]


def _lock(file: io.FileIO | io.BufferedRandom, path: Path) -> None:
    """Keep other runs away; the system frees the lock of a killed one."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as err:
        target = path.name.removesuffix(".partial.state")
        raise ExportError(
            f"{path.with_name(target)}: wanted to write it alone, got another run that does; wait "
            "for its end or choose another output"
        ) from err
    except OSError:
        # Some network file systems know no locks.
        return


def _parsed(file: io.BufferedRandom) -> State | None:
    """The lines that count."""
    state: State | None = None
    rows: list[Row] = []
    count, kept_bytes, now, boot = 0, 0, _boot(), ""
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
            count, state.kept_bytes, state.length = len(rows), kept_bytes, end
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
    """Rows of numbers, or None if that is not what a line holds."""
    if not isinstance(found, list):
        return None
    for row in found:
        if not isinstance(row, list) or not all(isinstance(fates, list) for fates in row):
            return None
        if not all(isinstance(n, int) and n >= 0 for fates in row for n in fates):
            return None
    return found


def _boot() -> str:
    """What changes with every start of the machine; "" where the system does not tell."""
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return ""


# What an output is made of and how: only the same job may continue it.

# Said by the files themselves, by the sensors, or not by options; or outputs do not depend on it.
_ELSEWHERE = frozenset(
    {"recordings", "selection", "part", "extras", "fault_begin_ns", "jobs", "engine"}
)
_DIGITS = 12


def of_job(job: Job, name: str, options: WriterOptions) -> dict[str, str]:
    """Label and text of what a job says; name: of the format."""
    found = {"mlbatch": mlbatch.__version__, "numpy": np.__version__, "format": name}
    found["point layout"] = options.point_layout
    found["compression"] = options.compression
    for key, value in _options(job):
        found[key.replace("_", " ")] = _text(value)
    return found


def of_inputs(run: Conversion) -> dict[str, str]:
    """What the recordings are, and digests of what points are made with."""
    found = {}
    for number, path in enumerate(run.job.recordings):
        found[f"recording {number + 1}"] = f"{path.name} ({_size_and_time(path)})"
    for sensor in run.sensors:
        lidar = sensor.lidar
        what = (lidar.model, lidar.mode, lidar.beams, lidar.firing_ns, lidar.channel)
        found[f"calibration of {sensor.name}"] = _digest(what)
        found[f"pose of {sensor.name}"] = _digest((sensor.body_from_sensor, sensor.clock.offset_ns))
    found["rig"] = _digest(run.session.setup.rig)
    found["sensors"] = ", ".join(sensor.name for sensor in run.sensors)
    return found


def difference(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    """What differs, in words; "" if nothing does."""
    for key in (*old, *new):
        before, now = old.get(key, "none"), new.get(key, "none")
        if before != now:
            return f"{key} {now or 'not given'!r} instead of {before or 'not given'!r}"
    return ""


def _options(job: Job) -> Iterator[tuple[str, object]]:
    for holder in (job, job.selection):
        for one in fields(holder):
            if one.name not in _ELSEWHERE:
                yield one.name, getattr(holder, one.name)


def _text(value: object) -> str:
    """A value as a user would know it again, the same in every process."""
    if value is None or value == () or value == {}:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{key}={_text(value[key])}" for key in sorted(value))
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return str(value)


def _size_and_time(path: Path) -> str:
    """Bytes and time of the last change of a recording, or of all files of its folder."""
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
    """All of a value as bytes that do not depend on the process."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield field.name.encode()
            yield from _pieces(getattr(value, field.name))
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield str(key).encode()
            yield from _pieces(value[key])
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _pieces(item)
    else:
        yield f"{value!r};".encode()
