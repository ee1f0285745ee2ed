"""Atomic outputs: complete under the final name, or not there at all.

An output is written to `<OUTPUT>.partial` and renamed at the end. A killed run leaves its
`.partial`; the next run to the same output continues it (`--resume`) or replaces it. A power cut
leaves the old or the new output: the data are forced to the disk before the output is renamed, and
its name after that, unless `--no-fsync` is given.

A run locks its `.partial`: the file, or `files.jsonl` in the folder. No other run writes it then.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mlbatch.errors import ExportError, write_error
from mlbatch.writers.durable import sync_entries, sync_to_disk
from mlbatch.writers.formats import format_of_files

PARTIAL_SUFFIX = ".partial"
SCANS_CSV = "scans.csv"
REPORT_JSON = "report.json"
METADATA = "metadata.yaml"  # of a ROS 2 bag
# In a folder with the files of one shard, instead of the report.
SHARD_JSON = "shard.json"
# In a folder under construction, and in that of a shard: the files that are whole, see
# `pipeline/files.py`.
FILES_JSONL = "files.jsonl"
# Files that a run writes into a folder. A folder with any other file is never replaced.
_SCAN_FILE = r"(\d{6,}|head)(-\d+)?\.([\w.]+)"
# Names that only mlbatch gives, or that its first versions wrote without a scans.csv.
_UNMARKED = ("npz", "ply")
# The same for a ROS 2 bag, lists of times and of files. Other programs write such files too, and
# scans of other formats: scans.csv marks an output of mlbatch.
_SHARED_FILE = r".+_\d+\.mcap|metadata\.yaml|times\.txt|files\.jsonl"
# A report may have any name (`--report`); it is recognised by its first bytes, in any version.
_REPORT = rb'\{\s*"schema":\s*"mlbatch\.report/'
_HEAD_BYTES = 64
_BYTES_PER_MB = 1_000_000


@contextlib.contextmanager
def export_errors(path: Path) -> Iterator[None]:
    """Convert an OSError while `path` is written to an ExportError of one line."""
    try:
        yield
    except OSError as err:
        raise write_error(path, err) from err


class Output(NamedTuple):
    """A file or folder under construction."""

    target: Path  # final path
    partial: Path  # path until `publish`
    overwrite: bool  # whether an earlier output at `target` may be replaced
    fsync: bool  # whether data and names are forced to the disk
    lock: io.FileIO  # keeps other runs away from `partial`

    def sync(self) -> None:
        """Force the data to the disk; call before the report of the output is written."""
        if self.fsync:
            with export_errors(self.partial):
                sync_to_disk(self.partial)

    def publish(self) -> None:
        """Move the finished output to its final path, replacing an earlier output."""
        with export_errors(self.target):
            if self.partial.is_dir():
                # The report in it is newer than `sync`.
                self._sync_entries(self.partial)
            self._move()
            self.close()
            tidy(self.target, self.fsync)
            self._sync_entries(self.target.parent)

    def close(self) -> None:
        """Let other runs use what is under construction."""
        self.lock.close()

    def _move(self) -> None:
        if not os.path.lexists(self.target):
            self.partial.rename(self.target)
            return
        _check_replaceable(self.target, self.overwrite, self.partial.is_dir())
        if self.target.is_dir():
            self._replace_folder()
        else:
            os.replace(self.partial, self.target)

    def _sync_entries(self, folder: Path) -> None:
        if self.fsync:
            sync_entries(folder)

    def _replace_folder(self) -> None:
        """Swap folders: a folder cannot be renamed onto one that is not empty."""
        old = old_path(self.target)
        _remove(old)
        self.target.rename(old)
        try:
            self.partial.rename(self.target)
        except OSError:
            old.rename(self.target)
            raise


def is_taken(name: str) -> bool:
    """Return whether a run may write a file of this name into an output folder."""
    return _is_own_file(name, marked=True)


def _is_own_file(name: str, *, marked: bool) -> bool:
    """marked: there is a scans.csv in the output, or a shard.json."""
    if name in (SCANS_CSV, REPORT_JSON, SHARD_JSON):
        return True
    scan = re.fullmatch(_SCAN_FILE, name)
    if scan is None:
        return marked and bool(re.fullmatch(_SHARED_FILE, name))
    return (marked or scan[3] in _UNMARKED) and format_of_files(scan[3]) is not None


def is_report(path: Path) -> bool:
    """Return whether a file is the report of a run."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return re.match(_REPORT, file.read(_HEAD_BYTES)) is not None


def check_name(target: Path) -> None:
    """Refuse a path that cannot be created: not a name, or without a parent folder."""
    if target.name in ("", ".", ".."):
        raise ExportError(
            f"{target}: expected the name of a new output, found a folder; add a name"
        )
    if not target.parent.is_dir():
        raise ExportError(
            f"{target}: expected an output in an existing folder, found no folder {target.parent}; "
            "create it (mkdir -p) or choose another"
        )


def prepare(
    target: Path, overwrite: bool, folder: bool, keep: bool = False, fsync: bool = False
) -> Output:
    """Check that `target` can be written; lock its `.partial`, and empty it unless `keep`.

    fsync: as in `Output`.
    """
    check_name(target)
    if os.path.lexists(target):
        _check_replaceable(target, overwrite, folder)
    partial = partial_path(target)
    with export_errors(partial):
        fits = partial.is_dir() if folder else partial.is_file()
        if not keep and (partial.is_symlink() or not fits):
            _remove(partial)
        if folder:
            partial.mkdir(exist_ok=True)
        lock = locked(target, partial / FILES_JSONL if folder else partial)
        if not keep:
            lock.truncate(0)
            for entry in partial.iterdir() if folder else ():
                if entry.name != FILES_JSONL:
                    _remove(entry)
    return Output(target, partial, overwrite, fsync, lock)


def locked(target: Path, path: Path) -> io.FileIO:
    """Open a file that all runs to `target` lock, created if absent; ExportError while one has it.

    The system releases the lock of a killed run.
    """
    file = io.FileIO(path, "a+")
    with contextlib.suppress(OSError):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Another run may have completed or removed it in between.
            is_free = path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())
        except BlockingIOError:
            is_free = False
        if not is_free:
            file.close()
            raise ExportError(
                f"{target}: expected no other run that writes it, found one; wait for its end or "
                "choose another output"
            )
    # Some network file systems have no locks.
    return file


def discard(target: Path) -> None:
    """Remove the `.partial` of an output."""
    partial = partial_path(target)
    with export_errors(partial):
        _remove(partial)


def partial_path(target: Path) -> Path:
    """Return the path of an output under construction."""
    return target.with_name(target.name + PARTIAL_SUFFIX)


def old_path(target: Path) -> Path:
    """Return the path of an older output folder while the new one is moved into place."""
    return target.with_name(f"{target.name}.old{PARTIAL_SUFFIX}")


def state_path(target: Path) -> Path:
    """Return the path of the state file that earlier versions kept of an unfinished output."""
    partial = partial_path(target)
    return partial.with_name(f"{partial.name}.state")


def tidy(target: Path, fsync: bool = True) -> None:
    """Remove what is of no use once `target` is complete; a killed run may have left it."""
    old = old_path(target)
    with export_errors(target):
        if old.exists():
            # Until now a power cut may bring the old name back.
            if fsync:
                sync_entries(target.parent)
            _remove(old)
        if target.is_dir() and not (target / SHARD_JSON).exists():
            (target / FILES_JSONL).unlink(missing_ok=True)


def side_path(target: Path, name: str) -> Path:
    """Return the path of the report or scan table of an output that is a file."""
    return target.with_name(f"{target.name}.{name}")


def free_bytes(target: Path) -> int:
    """Free space of the disk of an output."""
    with export_errors(target):
        return shutil.disk_usage(target.parent).free


def check_free_space(target: Path, needed_bytes: int) -> None:
    """Refuse an output if its disk has less free space than `needed_bytes`."""
    free = free_bytes(target)
    if free < needed_bytes:
        raise ExportError(
            f"{target}: expected about {needed_bytes // _BYTES_PER_MB} MB of free disk, found "
            f"{free // _BYTES_PER_MB} MB; free space or choose another output"
        )


def write_text(path: Path, text: str, fsync: bool = False) -> None:
    """Write a small file atomically, replacing an older one.

    fsync: force its data to the disk before it has its name, which is left to the caller.
    """
    partial = partial_path(path)
    with export_errors(path):
        # A byte of a file name that is no text: in JSON, its escape.
        partial.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")
        if fsync:
            sync_to_disk(partial)
        os.replace(partial, path)


def _check_replaceable(target: Path, overwrite: bool, folder: bool) -> None:
    """Refuse to replace what exists at `target` unless allowed and written by a run."""
    if not overwrite:
        raise ExportError(
            f"{target}: expected a new output, found an existing one; choose another or --overwrite"
        )
    expected = "folder" if folder else "file"
    if not (target.is_dir() if folder else target.is_file()):
        raise ExportError(
            f"{target}: expected a {expected} to overwrite, found none; choose another"
        )
    with export_errors(target):
        stranger = next(_strangers(target, deep=True), None) if folder else None
    if stranger is not None:
        raise ExportError(
            f"{target}: expected a folder with nothing but scans to overwrite, found "
            f"{stranger.name} in it; choose another output"
        )


def _strangers(folder: Path, deep: bool) -> Iterator[Path]:
    """Yield entries of a folder that no run wrote; deep: enter folders of single sensors."""
    folders = (folder,) if deep else (folder, folder.parent)
    marked = any((one / name).is_file() for one in folders for name in (SCANS_CSV, SHARD_JSON))
    for entry in folder.iterdir():
        if deep and entry.is_dir() and not entry.is_symlink():
            yield from _strangers(entry, deep=False)
        elif not (_is_own_file(entry.name, marked=marked) or is_report(entry)):
            yield entry


def _remove(path: Path) -> None:
    """Remove a file or folder if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
