"""The state file of an output under construction, `<OUTPUT>.partial.state`.

It has one record a line and only grows. The first record identifies the job; each later one adds
the scans that are safe since the record before. A record is appended after the operating system has
the data that it describes. Data reach the disk later: after a restart of the machine only records
before one with `synced` count.

A line is a checksum, a space and a JSON object. The checksum is a digest of the object and of the
checksum of the record before, so that changed, missing, repeated and moved records are found. Only
the records before the first that does not match count.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

from mlbatch.errors import ExportError
from mlbatch.writers import export_errors, partial_path, sync_entries, sync_to_disk

SCHEMA = "mlbatch.state/3"
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_CHECKSUM_DIGITS = 16

Record: TypeAlias = dict[str, object]


class FinishedScan(NamedTuple):
    """A scan that the `.partial` contains.

    content: checksum of what was read for it and before it, see `ResumeLog.take`;
    outcomes: slots by outcome, one list a sensor; see `ledger.POINT_COUNTERS`; checksum: of the
    scan as written, see `ScanJob`.
    """

    content: int
    outcomes: list[list[int]]
    checksum: int | None


@dataclass(slots=True)
class State:
    """Content of a state file."""

    identity: dict[str, str]  # of job and inputs: see `job_identity` and `input_identity`
    segment: str  # of the session, as text
    scans: list[FinishedScan] = field(default_factory=list)
    kept_bytes: int = 0  # of the output's file, with these scans
    kept_crc: int = 0  # CRC-32 of these bytes
    length: int = 0  # bytes of the records that count
    checksum: str = ""  # of the last of them


class FoundState(NamedTuple):
    """Content of a state file; damage: one line on records that do not count, or ""."""

    state: State | None = None
    damage: str = ""


def state_path(target: Path) -> Path:
    """Path of the state file of an output under construction."""
    partial = partial_path(target)
    return partial.with_name(f"{partial.name}.state")


def read_state(path: Path) -> FoundState:
    """State that an ended run left, if any; ExportError while the run lives."""
    try:
        with path.open("r+b") as file:
            _lock(file, path)
            return _parse(file, path)
    except FileNotFoundError:
        return FoundState()
    except OSError as err:
        raise ExportError(
            f"{path}: expected a readable state file, found {err.strerror!r}; leave out --resume "
            "to start over"
        ) from err


class StateFile:
    """The state file of a run; locked while it is open, so that no other run uses it."""

    def __init__(self, path: Path, state: State, *, is_new: bool) -> None:
        self._path = path
        self._checksum = state.checksum
        with export_errors(path):
            # Truncated only after it is locked.
            self._file = io.FileIO(path, "a" if is_new else "r+")
            _lock(self._file, path)
            self._file.truncate(state.length)
            self._file.seek(state.length)
        boot: Record = {"boot": _boot()}
        if is_new:
            boot |= {"schema": SCHEMA, "part": state.segment, "identity": state.identity}
        self._append(boot)

    def add(self, scans: list[FinishedScan], kept_bytes: int, kept_crc: int) -> None:
        """Add scans that are safe within the first `kept_bytes` of the output's file."""
        self._append({"kept_bytes": kept_bytes, "kept_crc": kept_crc, "scans": scans})

    def sync(self, partial: Path) -> None:
        """Force the output under construction and the state to the disk, as far as possible."""
        with contextlib.suppress(OSError, ExportError):
            sync_to_disk(partial)
            self._append({"synced": True})
            sync_to_disk(self._path)
            sync_entries(self._path.parent)
        self._file.close()

    def remove(self) -> None:
        """Remove the file: the output is complete."""
        with export_errors(self._path):
            self._path.unlink(missing_ok=True)
        self._file.close()

    def _append(self, record: Record) -> None:
        text = json.dumps(record, separators=(",", ":")).encode()
        checksum = _checksum(self._checksum, text)
        left = memoryview(checksum.encode() + b" " + text + b"\n")
        with export_errors(self._path):
            while left:
                left = left[self._file.write(left) :]
        self._checksum = checksum


def _checksum(before: str, text: bytes) -> str:
    """Checksum of a record; before: that of the record before, "" for the first."""
    # OpenSSL takes a while to load; a dry run has no state file.
    import hashlib

    return hashlib.sha256(before.encode() + text).hexdigest()[:_CHECKSUM_DIGITS]


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


# -- reading ----------------------------------------------------------------------------------


class _Line(NamedTuple):
    record: Record
    checksum: str
    end: int  # bytes up to its end


class _Reading:
    """The records of a state file, added one by one; ValueError for impossible content."""

    def __init__(self) -> None:
        self.records = 0
        self._state: State | None = None
        self._scans: list[FinishedScan] = []
        self._kept_bytes = 0
        self._kept_crc = 0
        self._counting = 0  # scans that count
        self._now = _boot()
        self._boot = ""

    @property
    def state(self) -> State | None:
        """What the records say that count."""
        if self._state is not None:
            self._state.scans = self._scans[: self._counting]
        return self._state

    def add(self, line: _Line) -> None:
        """Add the next record."""
        record = line.record
        state = self._state or _head(record)
        if "scans" in record:
            self._kept_bytes = _size(record.get("kept_bytes"), self._kept_bytes)
            self._kept_crc = _size(record.get("kept_crc"), 0)
            self._scans += _scans(record["scans"])
        self._state = state
        self._boot = str(record.get("boot", self._boot))
        if self._boot == self._now or "synced" in record:
            self._counting = len(self._scans)
            state.kept_bytes = self._kept_bytes
            state.kept_crc = self._kept_crc
            state.length = line.end
            state.checksum = line.checksum
        self.records += 1


def _parse(file: io.BufferedRandom, path: Path) -> FoundState:
    """The records before the first that does not match its checksum."""
    reading = _Reading()
    try:
        for line in _lines(file):
            reading.add(line)
    except ValueError as err:
        damage = (
            f"{path}: expected records as they were written, found record {reading.records + 1} "
            f"with {err}; scans from there on are converted again"
        )
        return FoundState(reading.state, damage)
    return FoundState(reading.state)


def _lines(file: io.BufferedRandom) -> Iterator[_Line]:
    """Whole lines; ValueError for one that does not match its checksum."""
    end = 0
    checksum = ""
    for line in file:
        if not line.endswith(b"\n"):
            # Cut off by a kill.
            return
        end += len(line)
        found, _, text = line[:-1].partition(b" ")
        checksum = _checksum(checksum, text)
        if found != checksum.encode():
            raise ValueError("another checksum")
        record = json.loads(text)
        if not isinstance(record, dict):
            raise ValueError("no JSON object")
        yield _Line(record, checksum, end)


# Values with a valid checksum are those that some version of mlbatch wrote.


def _head(record: Record) -> State:
    identity = record.get("identity")
    if record.get("schema") != SCHEMA or not isinstance(identity, Mapping):
        raise ValueError(f"another schema than {SCHEMA}")
    texts = {str(name): str(value) for name, value in identity.items()}
    return State(texts, str(record.get("part")))


def _scans(found: object) -> list[FinishedScan]:
    if not isinstance(found, list):
        raise ValueError("no list of scans")
    return [FinishedScan(int(content), *rest) for content, *rest in found]


def _size(found: object, at_least: int) -> int:
    if not isinstance(found, int) or found < at_least:
        raise ValueError("no size of the output")
    return found


def _boot() -> str:
    """Identifier that changes with every start of the machine; "" where there is none."""
    try:
        return _BOOT.read_text().strip()
    except OSError:
        return ""
