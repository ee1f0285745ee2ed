"""The state file of an output under construction: from where a resumed run goes on.

`<OUTPUT>.partial.state` has one JSON object a line and only grows. The first line says what is made
of what; each later one, which scans are safe since the one before. A line is appended once the
system has what it tells of; a line that a kill cut off counts for nothing, and those after it.

What the system has reaches the disk later. So after a restart of the machine only those lines count
that a clean end has forced to the disk (`synced`).
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from mlbatch.errors import ExportError
from mlbatch.writers import export_errors, partial_path

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

    def settle(self) -> None:
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
