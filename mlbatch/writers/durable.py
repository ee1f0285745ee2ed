"""Files forced to the disk, so that a power cut does not lose them."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

# Errors that mean lost data.
_LOSSES = frozenset({errno.EIO, errno.ENOSPC, errno.EDQUOT})


def sync_to_disk(path: Path) -> None:
    """Force a file, or a folder with all that is in it, to the disk; OSError if that fails.

    The entry of `path` in its own folder is not included: `sync_entries` of that folder is.
    """
    if not path.is_dir():
        _sync(path)
    elif not _sync_file_system(path):
        for one in _inside(path):
            _sync(one)


def sync_entries(folder: Path) -> None:
    """Force the names in a folder to the disk: what was created, renamed and removed in it.

    Folders that cannot be synced, by their file system or their permissions, are left to it.
    """
    try:
        _sync(folder)
    except OSError as err:
        if err.errno in _LOSSES:
            raise


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _inside(folder: Path) -> Iterator[Path]:
    """A folder and all in it; each folder after its content."""
    for entry in folder.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            yield from _inside(entry)
        else:
            yield entry
    yield folder


def _sync_file_system(path: Path) -> bool:
    """Force the file system of `path` to the disk by one call; False if the system has none.

    Every fsync flushes the cache of the disk, so a call for each of many small files is slow.
    """
    # Imported on demand: most outputs are single files.
    import ctypes

    try:
        syncfs = ctypes.CDLL(None, use_errno=True).syncfs  # Linux only
    except (AttributeError, OSError):
        return False
    descriptor = os.open(path, os.O_RDONLY)
    try:
        if syncfs(descriptor):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), str(path))
    finally:
        os.close(descriptor)
    return True
