"""Outputs that appear whole or not at all (CONTRACT.md, section 2).

An output grows under `<OUTPUT>.partial` and is renamed at the end. A killed run leaves its
`.partial` behind; the next run to the same output continues it (`--resume`) or replaces it. Renames
guard against killed processes; nothing is forced to the disk, so a power cut right after a run is
not covered.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mlbatch.errors import ExportError

PARTIAL_SUFFIX = ".partial"
SCANS_CSV = "scans.csv"
REPORT_JSON = "report.json"
# What a run writes into a folder; a folder with anything else is never replaced.
_OWN_FILE = re.compile(r"(\d{6,}|head)(-\d+)?\.(npz|ply)|scans\.csv|report\.json")
# The same of a ROS 2 bag. Recorders write such files, too: only a table of scans makes them ours.
_OWN_BAG_FILE = re.compile(r".+_0\.mcap|metadata\.yaml")
# A report may have any name (`--report`): what it begins with tells it, of any version, from
# somebody's only copy.
_REPORT = re.compile(rb'\{\s*"schema":\s*"mlbatch\.report/')
_HEAD_BYTES = 64
_ADVICE = {
    errno.ENOSPC: "free space on this disk or choose another output",
    errno.EDQUOT: "free space in your quota or choose another output",
    errno.EFBIG: "raise the limit of file sizes or choose another disk",
    errno.EACCES: "choose an output where you may write",
    errno.EPERM: "choose an output where you may write",
    errno.EROFS: "choose an output on a disk that is not read-only",
    errno.ENAMETOOLONG: "choose a shorter name",
}
_BYTES_PER_MB = 1_000_000


@contextlib.contextmanager
def export_errors(path: Path) -> Iterator[None]:
    """Turn an OSError while `path` is written into an ExportError of one line."""
    try:
        yield
    except OSError as err:
        advice = _ADVICE.get(err.errno or 0, "check the disk and the name of the output")
        reason = err.strerror or str(err)
        raise ExportError(f"{path}: wanted to write it, got {reason!r}; {advice}") from err


@dataclass(frozen=True, slots=True)
class Output:
    """A file or folder under construction at `partial`, meant for `target`."""

    target: Path
    partial: Path
    overwrite: bool

    def publish(self) -> None:
        """Give the finished output its final name; only now an older one is replaced."""
        with export_errors(self.target):
            old = old_path(self.target)
            if not os.path.lexists(self.target):
                self.partial.rename(self.target)
                # Of a run that was killed between two renames.
                _remove(old)
                return
            _check_replaceable(self.target, self.overwrite, self.partial.is_dir())
            if self.target.is_dir():
                self._replace_folder()
            else:
                os.replace(self.partial, self.target)

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
        shutil.rmtree(old)


def is_taken(name: str) -> bool:
    """Whether a file of this name in an output folder may be one of the run's own."""
    return bool(_OWN_FILE.fullmatch(name) or _OWN_BAG_FILE.fullmatch(name))


def is_report(path: Path) -> bool:
    """Whether a file holds the report of a run."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _REPORT.match(file.read(_HEAD_BYTES)) is not None


def check_name(target: Path) -> None:
    """Refuse what cannot be the name of an output, or stands in no folder."""
    if target.name in ("", ".", ".."):
        raise ExportError(f"{target}: wanted the name of a new output, got a folder; add a name")
    if not target.parent.is_dir():
        raise ExportError(
            f"{target}: wanted an output in an existing folder, got {target.parent}, "
            f"which is none; create it (mkdir -p) or choose another"
        )


def prepare(target: Path, overwrite: bool, folder: bool, keep: bool = False) -> Output:
    """Check that `target` can be written, and make a new `.partial` unless one is to be kept."""
    check_name(target)
    if os.path.lexists(target):
        _check_replaceable(target, overwrite, folder)
    partial = partial_path(target)
    if keep:
        return Output(target, partial, overwrite)
    with export_errors(partial):
        _remove(partial)
        if folder:
            partial.mkdir()
        else:
            partial.touch()
    return Output(target, partial, overwrite)


def discard(target: Path) -> None:
    """Remove the `.partial` of an output that will not be."""
    partial = partial_path(target)
    with export_errors(partial):
        _remove(partial)


def partial_path(target: Path) -> Path:
    """Where an output grows."""
    return target.with_name(target.name + PARTIAL_SUFFIX)


def old_path(target: Path) -> Path:
    """Where a folder stands while another takes its name."""
    return target.with_name(f"{target.name}.old{PARTIAL_SUFFIX}")


def discard_old(target: Path) -> None:
    """Remove a replaced folder that a killed run left beside its finished output."""
    with export_errors(target):
        _remove(old_path(target))


def side_path(target: Path, name: str) -> Path:
    """Where `name` lies beside an output that is a file."""
    return target.with_name(f"{target.name}.{name}")


def check_free_space(target: Path, wanted_bytes: int) -> None:
    """Refuse an output for which its disk has too little room."""
    with export_errors(target):
        free_bytes = shutil.disk_usage(target.parent).free
    if free_bytes < wanted_bytes:
        raise ExportError(
            f"{target}: wanted about {wanted_bytes // _BYTES_PER_MB} MB of free disk, got "
            f"{free_bytes // _BYTES_PER_MB} MB; free space or choose another output"
        )


def write_text(path: Path, text: str) -> None:
    """Write a small file under its final name at once, replacing an older one."""
    partial = partial_path(path)
    with export_errors(path):
        partial.write_text(text, encoding="utf-8", newline="\n")
        os.replace(partial, path)


def _check_replaceable(target: Path, overwrite: bool, folder: bool) -> None:
    """Refuse to touch what stands at `target` unless a run wrote it and may replace it."""
    if not overwrite:
        raise ExportError(
            f"{target}: wanted a new output, got an existing one; choose another or --overwrite"
        )
    wanted = "folder" if folder else "file"
    if not (target.is_dir() if folder else target.is_file()):
        raise ExportError(f"{target}: wanted a {wanted} to overwrite, got none; choose another")
    with export_errors(target):
        stranger = next(_strangers(target, deep=True), None) if folder else None
    if stranger is not None:
        raise ExportError(
            f"{target}: wanted a folder that only holds scans to overwrite, got {stranger.name} "
            f"in it as well; choose another output"
        )


def _strangers(folder: Path, deep: bool) -> Iterator[Path]:
    """Entries of a folder that no run wrote; `deep`: folders of single sensors are allowed."""
    has_scans = (folder / SCANS_CSV).is_file()
    for entry in folder.iterdir():
        if has_scans and _OWN_BAG_FILE.fullmatch(entry.name):
            continue
        if deep and entry.is_dir() and not entry.is_symlink():
            yield from _strangers(entry, deep=False)
        elif not (_OWN_FILE.fullmatch(entry.name) or is_report(entry)):
            yield entry


def _remove(path: Path) -> None:
    """Remove a file or a folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
