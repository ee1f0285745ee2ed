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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from mlbatch.batch.identity import CONTENT, Key, content, is_same, session_key
from mlbatch.batch.record import (
    DONE,
    FAILED,
    KNOWN_BAD,
    SessionRecord,
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
    STARTED_JSON,
    Session,
    is_url,
    own_files,
)
from mlbatch.bounded import read_text
from mlbatch.errors import (
    DiskFullError,
    ExportError,
    Interrupted,
    MlbatchError,
    RecordingError,
    one_line,
)
from mlbatch.outputs.run_files import SESSION_JSON
from mlbatch.reports.report import report_of

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
# The folder of a session is measured this often, and a process that should end has this long.
_DISK_POLL_S = 2.0
_GRACE_S = 60.0


@dataclass(frozen=True, slots=True)
class Task:
    """A session to run; cwd: that paths in options are relative to.

    folder: of its output; cache: for copies of remote files; upload: URL of the folder that the
    output is copied to, "" without.
    """

    session: Session
    folder: Path
    cwd: Path
    cache: Path
    upload: str = ""
    retries: int = 1
    pages: bool = True

    @property
    def is_remote(self) -> bool:
        """Whether its state or its recordings are in a store."""
        return bool(self.upload or self.session.urls)


def tasks_of(
    sessions: Sequence[Session], output: str, cache: Path, *, retries: int, pages: bool
) -> list[Task]:
    """The tasks of sessions; ExportError where the output cannot be one, UsageError for URLs."""
    urls = [output] if is_url(output) else [url for one in sessions for url in one.urls]
    folder = Path(output).absolute()
    if urls:
        from mlbatch.batch import remote

        # Without the package every session would fail.
        remote.check_package(urls[0])
    if is_url(output):
        # `convert` writes local files, which are uploaded in the end.
        folder = cache / "outputs" / remote.digest_of(output)
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder}: expected a folder, found a file; choose another output")
    upload = f"{output.rstrip('/')}/" if is_url(output) else ""
    return [
        Task(
            # Workers have other working folders.
            session=session.absolute(),
            folder=folder / session.name,
            cwd=Path.cwd(),
            cache=cache,
            upload=upload and upload + session.name,
            retries=retries,
            pages=pages,
        )
        for session in sessions
    ]


def finished(task: Task) -> SessionRecord | None:
    """The record of a session whose inputs, options and versions did not change since."""
    record = read_record(task.upload or task.folder)
    bad = task.session.known_bad
    if record is None or (record.state == KNOWN_BAD) != bool(bad):
        return None
    if bad:
        return record if record.line == bad else None
    if record.limit and record.limit not in task.session.limits.texts:
        return None
    if not task.upload and any(not (task.folder / name).exists() for name in record.outputs):
        return None
    is_current = is_same(record.key, session_key(task.session, task.cwd), task.session)
    return record if is_current else None


def run_session(task: Task, stop: threading.Event | None = None) -> SessionRecord:
    """Convert a session and write its session.json.

    stop: ends its process in order, so that it can be resumed. Raises Interrupted where it did,
    ExportError where the folder cannot be used; DiskFullError where it has no space: the session is
    unfinished, and can be resumed.
    """
    try:
        return _run_session(task, stop or threading.Event())
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


def _check(stop: threading.Event) -> None:
    if stop.is_set():
        raise Interrupted("interrupted")


def _run_session(task: Task, stop: threading.Event) -> SessionRecord:
    session = task.session
    began_s = time.monotonic()
    _check(stop)
    if session.known_bad:
        return _known_bad(task, stop)
    try:
        key = session_key(session, task.cwd)
    except MlbatchError as err:
        failed = SessionRecord(session.name, FAILED, 1, str(err), {}, inputs=[*session.inputs])
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
            code, attempts, limit = _attempts(local, log, stop)
            if not limit:
                _add_page(local, code, log, stop)
        line = "" if code == 0 else _limit_line(limit) if limit else _line(task.folder, code)
        if code not in (0, _LIMIT) and _is_full(task.folder, line):
            raise _disk_full(task.folder)
        record = SessionRecord(
            session.name,
            DONE if code == 0 else FAILED,
            code,
            line,
            key | {CONTENT: content(session)},
            limit=limit,
            attempts=attempts,
            inputs=[*session.inputs],
            wall_s=round(time.monotonic() - began_s, 3),
        )
        _add_figures(record, task.folder)
        _publish(task, record)
        return record


def _known_bad(task: Task, stop: threading.Event) -> SessionRecord:
    """Note why a session is not converted; what an earlier run made of it is removed."""
    session = task.session
    with _locked(task.folder, stop):
        _prepare(task, {})
        record = SessionRecord(session.name, KNOWN_BAD, 0, session.known_bad, {})
        _publish(task, record)
    return record


@contextlib.contextmanager
def _staged(task: Task) -> Iterator[Task]:
    """The task with local copies of remote files, removed when it has ended."""
    session = task.session
    if not session.urls:
        yield task
        return
    from mlbatch.batch.remote import fetched

    with fetched(session.urls, task.cache, task.upload or task.folder, session.local_rig) as copies:
        inputs = tuple(copies.get(one, one) for one in session.inputs)
        rig = None if session.rig is None else copies.get(session.rig, session.rig)
        yield replace(task, session=replace(session, inputs=inputs, rig=rig))


def _publish(task: Task, record: SessionRecord) -> None:
    """Write session.json, after all else; with an upload there, and what is here is removed."""
    if not task.upload:
        write_record(task.folder, record)
        return
    from mlbatch.batch import remote

    record_url = f"{task.upload}/{SESSION_JSON}"
    # While files are replaced, nothing may say that they are complete.
    remote.remove(record_url)
    mine = [
        path
        for path in own_files(task.folder)
        if path.name != STARTED_JSON and path.suffix != ".partial"
    ]
    files = {
        f"{task.upload}/{path.relative_to(task.folder).as_posix()}": path
        for top in mine
        for path in (top, *top.rglob("*"))
        if path.is_file()
    }
    for url, path in files.items():
        remote.upload(path, url)
    for one in remote.listed(task.upload):
        top = one.url.removeprefix(f"{task.upload}/").partition("/")[0]
        if one.url not in files and OWN.fullmatch(top):
            remote.remove(one.url)
    write_record(task.folder, record)
    remote.upload(task.folder / SESSION_JSON, record_url)
    _clear(task.folder, kept=(LOG_TXT,))


@contextlib.contextmanager
def _locked(folder: Path, stop: threading.Event) -> Iterator[BinaryIO]:
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
                stop.wait(_POLL_S)
                _check(stop)
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
    # session.json first: what is deleted, or continued, must not look complete.
    (folder / SESSION_JSON).unlink(missing_ok=True)
    if task.session.known_bad:
        _clear(folder, kept=(LOG_TXT,))
    elif not is_same(read_started(folder), key, task.session):
        _clear(folder, kept=(LOG_TXT, STARTED_JSON))
        write_started(folder, key | {CONTENT: content(task.session)})


def _clear(folder: Path, kept: Sequence[str]) -> None:
    """Remove what a run wrote."""
    for path in own_files(folder):
        if path.name in kept:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _attempts(task: Task, log: BinaryIO, stop: threading.Event) -> tuple[int, int, str]:
    """Run the process until it ends; exit code, number of attempts, the limit that ended it."""
    attempts = 0
    watch = _Watch(task)
    while True:
        attempts += 1
        log.truncate(0)
        code = _run(words_of(task), task, log, stop, watch)
        _check(stop)
        # A process that gets a signal at its end may be complete.
        if watch.limit and code not in _FINAL:
            if watch.is_full:
                _clear(task.folder, kept=(LOG_TXT, STARTED_JSON))
            return code, attempts, watch.limit
        if code in _FINAL or attempts > task.retries:
            return code, attempts, ""


class _Watch:
    """Whether a session is beyond its limits of time or disk."""

    def __init__(self, task: Task) -> None:
        self._folder = task.folder
        self._limits = task.session.limits
        self._began_s = self._measured_s = time.monotonic()
        self.limit = ""
        self.is_full = False

    def is_beyond(self) -> bool:
        """Look at the clock, and now and then at the folder."""
        time_s, disk_bytes = self._limits.time_s, self._limits.disk_bytes
        now_s = time.monotonic()
        if time_s is not None and now_s - self._began_s > time_s:
            (self.limit, *_) = self._limits.texts
        elif disk_bytes is not None and now_s - self._measured_s > _DISK_POLL_S:
            self._measured_s = now_s
            self.is_full = _size(self._folder) > disk_bytes
            if self.is_full:
                (*_, self.limit) = self._limits.texts
        return bool(self.limit)


def _size(folder: Path) -> int:
    """Bytes of all files in a folder; files may vanish meanwhile."""
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            total += path.lstat().st_size
    return total


def _limit_line(limit: str) -> str:
    what = "time" if limit.endswith(" s") else "disk"
    return f"beyond its limit of {what}, {limit}; with another limit the same command runs it again"


def _run(
    words: list[str],
    task: Task,
    log: BinaryIO,
    stop: threading.Event,
    watch: _Watch | None = None,
) -> int:
    process = subprocess.Popen(
        [sys.executable, "-m", "mlbatch.cli.child", *words],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        cwd=task.cwd,
        start_new_session=True,
    )
    with process:
        while process.poll() is None and not stop.is_set():
            if watch is not None and watch.is_beyond():
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    return process.wait(_GRACE_S)
                process.kill()
                break
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_POLL_S)
        if stop.is_set():
            # Once, since a second signal ends it at any place.
            process.terminate()
        return process.wait()


def _add_page(task: Task, code: int, log: BinaryIO, stop: threading.Event) -> None:
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


def _add_figures(record: SessionRecord, folder: Path) -> None:
    """Sizes of inputs and outputs, and counts of the reports."""
    reports = []
    for path in own_files(folder):
        if path.name.startswith("scans"):
            record.outputs.append(path.name)
            files = [path] if path.is_file() else path.iterdir()
            record.output_bytes += sum(one.stat().st_size for one in files if one.is_file())
        elif path.name.startswith("report") and path.suffix == ".json":
            with contextlib.suppress(OSError, ValueError, RecordingError):
                reports.append(report_of(path, read_text(path)))
    for report in reports:
        record.input_bytes = sum(one.bytes for one in report.inputs)
        record.recorded_s += report.recorded_s
        record.scans += report.scans.written
        record.points += report.scans.points
        record.incomplete += report.scans.incomplete
    sensors = [sensor for report in reports for sensor in report.sensors]
    for packets in (sensor.ledger.packets for sensor in sensors):
        record.packets += packets.read
        record.lost += packets.lost
        record.rejected += sum(packets.rejected.values())
    record.fill = min((one.fill for one in sensors if one.fill is not None), default=None)
    record.warnings = sorted({one.code for report in reports for one in report.warnings})
