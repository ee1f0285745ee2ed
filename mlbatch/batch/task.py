"""One session: lock, `mlbatch convert --resume` in a process of its own, retry, session.json.

The same function runs in a thread of the driver and in a Dask worker; all it needs is in the task.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

from mlbatch.batch.cache import Cache
from mlbatch.batch.identity import CONTENT, Key, content, is_same, session_key
from mlbatch.batch.record import (
    DONE,
    FAILED,
    SessionRecord,
    parse_record,
    read_record,
    read_started,
    write_record,
    write_started,
)
from mlbatch.batch.session import (
    LOG_TXT,
    OWN,
    PAGE_HTML,
    REPORT_JSON,
    SESSION_JSON,
    STARTED_JSON,
    Session,
    is_url,
    own_files,
)
from mlbatch.bounded import parse_json, read_text
from mlbatch.errors import DiskFullError, ExportError, Interrupted, MlbatchError, one_line

# Exit codes of `convert` that another attempt would not change, and that of a limit.
_FINAL = (0, 1, 2, 3)
_LIMIT = 3
_MARK = "mlbatch: error: "
_LIMIT_MARK = "mlbatch: limit exceeded: "
# A process whose driver was killed ends within milliseconds; another driver's does not.
_LOCK_S = 20.0
# Reasons of errors about a full disk, and free space in which no output fits.
_FULL = (os.strerror(errno.ENOSPC), os.strerror(errno.EDQUOT))
_LEAST_FREE_BYTES = 1 << 20
_POLL_S = 0.05


@dataclass(frozen=True, slots=True)
class Task:
    """A session to run; cwd: that paths in options are relative to.

    folder: of its output; upload: URL of the folder that the output is copied to, "" without.
    """

    session: Session
    folder: Path
    cwd: Path
    cache: Cache
    upload: str = ""
    retries: int = 1
    pages: bool = True

    @property
    def is_remote(self) -> bool:
        """Whether its state or its recordings are in a store."""
        return bool(self.upload) or any(map(is_url, self.session.inputs))


@dataclass(slots=True)
class Stop:
    """Ends the processes of sessions from another thread."""

    event: threading.Event = field(default_factory=threading.Event)
    _running: set[subprocess.Popen[bytes]] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @contextlib.contextmanager
    def watched(self, process: subprocess.Popen[bytes]) -> Iterator[None]:
        """End the process with `now`; it may have been called already."""
        with self._lock:
            self._running.add(process)
        if self.event.is_set():
            process.terminate()
        try:
            yield
        finally:
            with self._lock:
                self._running.discard(process)

    def now(self) -> None:
        """Ask all processes to end in order, so that they can be resumed."""
        self.event.set()
        with self._lock:
            for process in self._running:
                process.terminate()


def finished(task: Task) -> SessionRecord | None:
    """The record of a session whose inputs, options and versions did not change since."""
    record = _earlier(task)
    if record is None:
        return None
    return (
        record if is_same(record.key, session_key(task.session, task.cwd), task.session) else None
    )


def _earlier(task: Task) -> SessionRecord | None:
    """The record of an earlier run whose outputs are there."""
    if task.upload:
        from mlbatch.batch.remote import read_text

        return parse_record(read_text(f"{task.upload}/{SESSION_JSON}"))
    record = read_record(task.folder)
    if record is None or any(not (task.folder / name).exists() for name in record.outputs):
        return None
    return record


def run_session(task: Task, stop: Stop | None = None) -> SessionRecord:
    """Convert a session and write its session.json.

    Raises Interrupted where `stop` ended it, ExportError where the folder cannot be used;
    DiskFullError where it has no space: the session is unfinished, and can be resumed.
    """
    try:
        return _run_session(task, stop or Stop())
    except (MlbatchError, OSError) as err:
        if isinstance(err, Interrupted) or not _is_full(task.folder, str(err)):
            raise
        raise _disk_full(task.folder) from err


def _is_full(folder: Path, reason: str) -> bool:
    """Whether a failure is that of a full disk; the log may have had no space for its reason."""
    if any(one in reason for one in _FULL):
        return True
    try:
        disk = os.statvfs(folder)
    except OSError:
        return False
    free = disk.f_bavail if os.geteuid() else disk.f_bfree
    # Some network file systems count no blocks.
    return disk.f_blocks > 0 and free * disk.f_frsize < _LEAST_FREE_BYTES


def _disk_full(folder: Path) -> DiskFullError:
    return DiskFullError(
        f"{folder}: expected space for its output, found a full disk; free space, and the same "
        "command continues with this session and those that were not begun"
    )


def _run_session(task: Task, stop: Stop) -> SessionRecord:
    session = task.session
    began_s = time.monotonic()
    try:
        key = session_key(session, task.cwd)
    except MlbatchError as err:
        key = {}
        failed = SessionRecord(session.name, FAILED, 1, str(err), key, inputs=[*session.inputs])
        task.folder.mkdir(parents=True, exist_ok=True)
        _publish(task, failed)
        return failed
    with _locked(task.folder, stop) as log:
        done = finished(task)
        if done is not None and done.is_done:
            # Another driver has made it meanwhile.
            return done
        _prepare(task, key)
        with _staged(task) as local:
            code, attempts = _attempts(local, log, stop)
            _add_page(local, code, log, stop)
        line = "" if code == 0 else _line(task.folder, code)
        if code not in (0, _LIMIT) and _is_full(task.folder, line):
            raise _disk_full(task.folder)
        record = SessionRecord(
            session.name,
            DONE if code == 0 else FAILED,
            code,
            line,
            key | {CONTENT: content(session)},
            attempts=attempts,
            inputs=[*session.inputs],
            wall_s=round(time.monotonic() - began_s, 3),
        )
        _add_figures(record, task)
        _publish(task, record)
        return record


@contextlib.contextmanager
def _staged(task: Task) -> Iterator[Task]:
    """The task with local copies of remote files, kept while it runs."""
    session = task.session
    urls = [one for one in (*session.inputs, session.rig or "") if is_url(one)]
    if not urls:
        yield task
        return
    with task.cache.staged(urls) as copies:
        local = {url: str(path) for url, path in copies.items()}
        inputs = tuple(local.get(one, one) for one in session.inputs)
        rig = None if session.rig is None else local.get(session.rig, session.rig)
        yield replace(task, session=replace(session, inputs=inputs, rig=rig))


def _publish(task: Task, record: SessionRecord) -> None:
    """Write session.json, after all else; with an upload there, and what is here is removed."""
    if not task.upload:
        write_record(task.folder, record)
        return
    from mlbatch.batch import remote

    # While files are replaced, nothing may say that they are complete.
    remote.remove(f"{task.upload}/{SESSION_JSON}")
    files = [path for path in _all_files(task.folder) if path.name != STARTED_JSON]
    names = {path.relative_to(task.folder).as_posix() for path in files}
    for path in files:
        remote.upload(path, f"{task.upload}/{path.relative_to(task.folder).as_posix()}")
    for one in remote.listed(task.upload):
        name = one.url.removeprefix(f"{task.upload}/")
        if name not in names and OWN.fullmatch(name.partition("/")[0]):
            remote.remove(one.url)
    write_record(task.folder, record)
    remote.upload(task.folder / SESSION_JSON, f"{task.upload}/{SESSION_JSON}")
    for path in own_files(task.folder):
        if path.name != LOG_TXT:
            _remove(path)


def _all_files(folder: Path) -> list[Path]:
    """All files that a run wrote to the folder of a session."""
    found = []
    for path in own_files(folder):
        found += [path] if path.is_file() else [one for one in path.rglob("*") if one.is_file()]
    return found


@contextlib.contextmanager
def _locked(folder: Path, stop: Stop) -> Iterator[BinaryIO]:
    """The log of a session, open and locked.

    The process of the session inherits the lock, so that it ends with the last of both.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOG_TXT).open("ab") as log:
        deadline_s = time.monotonic() + _LOCK_S
        while True:
            try:
                fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as err:
                if time.monotonic() > deadline_s:
                    raise ExportError(
                        f"{folder}: expected no other run of this session, found one; wait for its "
                        "end"
                    ) from err
                if stop.event.wait(_POLL_S):
                    raise Interrupted("interrupted") from err
            except OSError:
                # Some network file systems have no locks.
                break
        yield log


def _prepare(task: Task, key: Key) -> None:
    """Keep what can be resumed; remove what was made from other inputs or options."""
    folder = task.folder
    for path in folder.iterdir():
        if not OWN.fullmatch(path.name):
            raise ExportError(
                f"{folder}: expected the folder of a session, found {path.name} in it; choose "
                "another output or name"
            )
    started = read_started(folder)
    is_begun = started is not None and is_same(started, key, task.session)
    kept = {LOG_TXT, STARTED_JSON}
    if not is_begun:
        # session.json first: what is deleted must not look complete.
        (folder / SESSION_JSON).unlink(missing_ok=True)
        for path in own_files(folder):
            if path.name not in kept:
                _remove(path)
        write_started(folder, key | {CONTENT: content(task.session)})


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _attempts(task: Task, log: BinaryIO, stop: Stop) -> tuple[int, int]:
    """Run the process until it ends; exit code and number of attempts."""
    attempt = 0
    code = 0
    while attempt <= task.retries:
        attempt += 1
        log.truncate(0)
        code = _run(words_of(task), task, log, stop)
        if stop.event.is_set():
            raise Interrupted("interrupted")
        if code in _FINAL:
            break
    return code, attempt


def _run(words: list[str], task: Task, log: BinaryIO, stop: Stop) -> int:
    command = [sys.executable, "-m", "mlbatch.cli.child", *words]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        cwd=task.cwd,
        start_new_session=True,
    )
    with stop.watched(process):
        try:
            return process.wait()
        finally:
            if process.stdin is not None:
                process.stdin.close()


def _add_page(task: Task, code: int, log: BinaryIO, stop: Stop) -> None:
    """Write the page of a run that was killed after its output and before its page."""
    output = task.folder / task.session.output
    is_there = any(path.name.startswith("page") for path in own_files(task.folder))
    if code in (0, _LIMIT) and task.pages and output.exists() and not is_there:
        words = ["report", str(output), "--report", str(task.folder / REPORT_JSON)]
        _run([*words, "-o", str(task.folder / PAGE_HTML)], task, log, stop)


def words_of(task: Task) -> list[str]:
    """The command line of a session, without the program."""
    session = task.session
    words = ["convert", *session.inputs, "-o", str(task.folder / session.output), "--resume"]
    words += ["--report", str(task.folder / REPORT_JSON), "--quiet"]
    if task.pages:
        words += ["--html", str(task.folder / PAGE_HTML)]
    if session.rig is not None:
        words += ["--rig", session.rig]
    return [*words, *(word for option in session.options for word in option.words)]


# -- what it made -----------------------------------------------------------------------------


def _line(folder: Path, code: int) -> str:
    """The line that says why a session failed."""
    lines = (folder / LOG_TXT).read_text(encoding="utf-8", errors="replace").splitlines()
    if code == _LIMIT:
        limits = [line.removeprefix(_LIMIT_MARK) for line in lines if line.startswith(_LIMIT_MARK)]
        return one_line("limit exceeded: " + "; ".join(limits))
    errors = [line.removeprefix(_MARK) for line in lines if line.startswith(_MARK)]
    if code in _FINAL and errors:
        return one_line(errors[-1])
    last = f": {lines[-1]}" if lines else ""
    return one_line(f"convert {_ended(code)}{last}")


def _ended(code: int) -> str:
    """How a process ended, in words."""
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    reason = " (out of memory?)" if name == "SIGKILL" else ""
    return f"was ended by {name}{reason}"


def _add_figures(record: SessionRecord, task: Task) -> None:
    """Sizes of inputs and outputs, and counts of the reports."""
    outputs = [path for path in own_files(task.folder) if path.name.startswith("scans")]
    record.outputs = [path.name for path in outputs]
    record.output_bytes = sum(map(_size, outputs))
    fills = []
    for path in own_files(task.folder):
        if path.name.startswith("report") and path.suffix == ".json":
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                fills += _add_report(record, parse_json(read_text(path)))
    record.fill = min(fills, default=None)


def _add_report(record: SessionRecord, report: dict[str, Any]) -> list[float]:
    """Add the counts of a report; the fill of its sensors."""
    record.input_bytes = sum(one["bytes"] for one in report["inputs"])
    record.recorded_s += report["timing"]["recorded_s"]
    record.scans += report["scans"]["written"]
    record.points += report["scans"]["points"]
    record.incomplete += report["scans"]["incomplete"]
    for sensor in report["sensors"]:
        packets = sensor["packets"]
        record.packets += packets["read"]
        record.lost += packets["lost"]
        record.rejected += sum(packets["rejected"].values())
    codes = {one["code"] for one in report["warnings"]}
    record.warnings = sorted({*record.warnings, *codes})
    return [sensor["fill"] for sensor in report["sensors"] if sensor["fill"] is not None]


def _size(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    if not path.is_dir():
        return path.stat().st_size
    return sum(one.stat().st_size for one in os.scandir(path) if one.is_file())
