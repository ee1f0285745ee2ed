"""Copies of remote files in a folder of limited size; the longest unused ones are removed first."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mlbatch.batch import remote
from mlbatch.batch.remote import RemoteFile
from mlbatch.errors import ExportError

_INPUTS = "inputs"
_OUTPUTS = "outputs"
# Next to a copy: its version; locked while the copy is used.
_NOTE = ".version"
_BYTES_PER_GB = 1e9


def default_cache() -> Path:
    """`$MLBATCH_CACHE`, or the usual place of the user."""
    named = os.environ.get("MLBATCH_CACHE")
    if named:
        return Path(named)
    usual = os.environ.get("XDG_CACHE_HOME")
    return (Path(usual) if usual else Path.home() / ".cache") / "mlbatch"


@dataclass(frozen=True, slots=True)
class Cache:
    """A folder on a local disk."""

    folder: Path
    most_bytes: float

    @classmethod
    def of(cls, folder: Path | None, gigabytes: float) -> Cache:
        """The cache of `--cache` and `--cache-gb`."""
        return cls((folder or default_cache()).absolute(), gigabytes * _BYTES_PER_GB)

    def output(self, url: str) -> Path:
        """Where an output is made before it is uploaded."""
        return self.folder / _OUTPUTS / _digest(url)

    @contextlib.contextmanager
    def staged(self, urls: Sequence[str]) -> Iterator[Mapping[str, Path]]:
        """Local copies of files, with the calibrations next to them, kept while they are used."""
        with contextlib.ExitStack() as held:
            found = {}
            for url in urls:
                for near in remote.calibrations(url):
                    held.enter_context(self._copy(near))
                found[url] = held.enter_context(self._copy(remote.head(url)))
            yield found

    @contextlib.contextmanager
    def _copy(self, file: RemoteFile) -> Iterator[Path]:
        folder = self.folder / _INPUTS / _digest(file.url.rpartition("/")[0])
        folder.mkdir(parents=True, exist_ok=True)
        target = folder / file.name
        note = folder / f"{file.name}{_NOTE}"
        version = f"{file.size} {file.version}"
        with note.open("a+") as opened:
            # Several sessions may use a copy, but not while it is made or removed.
            fcntl.flock(opened, fcntl.LOCK_SH)
            if not _is_copy(opened, version, target):
                fcntl.flock(opened, fcntl.LOCK_EX)
                if not _is_copy(opened, version, target):
                    target.unlink(missing_ok=True)
                    self._make_room(file)
                    opened.truncate(0)
                    remote.download(file, target)
                    opened.write(version)
                    opened.flush()
                fcntl.flock(opened, fcntl.LOCK_SH)
            os.utime(note)
            yield target

    def _make_room(self, file: RemoteFile) -> None:
        """Remove copies that nobody uses until a file fits; ExportError if it cannot."""
        if file.size > self.most_bytes:
            raise ExportError(
                f"{file.url}: expected at most {self.most_bytes / _BYTES_PER_GB:g} GB of the "
                f"cache, found {file.size / _BYTES_PER_GB:.3g} GB; give more with --cache-gb"
            )
        notes = sorted((self.folder / _INPUTS).glob(f"*/*{_NOTE}"), key=_last_used)
        used = sum(map(_bytes_of, notes))
        for note in notes:
            if used + file.size <= self.most_bytes:
                break
            used -= _removed(note)
        free = shutil.disk_usage(self.folder).free
        if free < file.size:
            raise ExportError(
                f"{self.folder}: expected {file.size} free bytes for {file.url}, found {free}; "
                "give another folder with --cache"
            )


def _is_copy(note: IO[str], version: str, target: Path) -> bool:
    note.seek(0)
    return note.read() == version and target.exists()


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:16]


def _last_used(note: Path) -> int:
    try:
        return note.stat().st_mtime_ns
    except OSError:
        return 0


def _copy_of(note: Path) -> Path:
    return note.with_name(note.name.removesuffix(_NOTE))


def _bytes_of(note: Path) -> int:
    try:
        return _copy_of(note).stat().st_size
    except OSError:
        return 0


def _removed(note: Path) -> int:
    """Remove a copy; its bytes, 0 if it is in use."""
    size = _bytes_of(note)
    try:
        with note.open("r+") as opened:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            opened.truncate(0)
            _copy_of(note).unlink(missing_ok=True)
    except OSError:
        return 0
    return size
