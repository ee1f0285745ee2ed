"""Recordings as users name them: files, folders of bags or captures, patterns in quotes."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Iterator
from pathlib import Path

from mlbatch.errors import RecordingError
from mlbatch.readers import FolderReader, readers
from mlbatch.readers.datasets import BAG_METADATA
from mlbatch.readers.source import read_head

_PARTIAL = ".partial"


def expand(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Files and bags for the paths given, each once, in their order; patterns and folders by name.

    A folder with captures or ROS 1 bags stands for all of them, one with a file or folder of a ROS
    2 bag for that, and a ROS 2 bag for itself.
    """
    return tuple(dict.fromkeys(found for path in paths for found in _expanded(path)))


def _expanded(path: Path) -> Iterator[Path]:
    if path.is_dir():
        # Outputs and notes name it.
        yield from _of_folder(path.resolve() if path.name in ("", "..") else path)
    elif path.exists() or not glob.has_magic(str(path)):
        yield path
    else:
        matches = sorted(glob.glob(str(path), recursive=True))
        if not matches:
            raise RecordingError(
                f"{path}: expected recordings, found no file that matches the pattern; "
                "check it with `ls`"
            )
        for match in matches:
            yield from _expanded(Path(match))


def _of_folder(folder: Path) -> Iterator[Path]:
    """The recordings in a folder, or the folder where it is a bag or has none."""
    # Not loaded for files.
    from mlbatch.readers.bag.folder import has_bag

    try:
        files = sorted(path for path in folder.iterdir() if _may_be_recording(path))
    except OSError as err:
        raise RecordingError(
            f"{folder}: expected a folder with recordings, could not read it ({err.strerror}); "
            "check its access rights"
        ) from err
    parts: list[Path] = []
    alone: list[Path] = []
    known = readers()
    for file in files:
        head = read_head(file)
        reader = next((one for one in known if one.recognises(head)), None)
        if reader is not None:
            (parts if isinstance(reader, FolderReader) else alone).append(file)
    if parts and alone:
        raise RecordingError(
            f"{folder}: expected one bag, or captures, found parts of a bag ({parts[0].name}) and "
            f"other recordings ({alone[0].name}); name the files"
        )
    if len(parts) == 1 and not (folder / BAG_METADATA).exists():
        # Calibrations are next to it.
        yield parts[0]
        return
    bags = [] if parts or alone else [path for path in folder.iterdir() if has_bag(path)]
    yield from alone or (bags if len(bags) == 1 else [folder])


def _may_be_recording(path: Path) -> bool:
    is_visible = not path.name.startswith(".") and path.suffix != _PARTIAL
    return is_visible and path.is_file() and path.stat().st_size > 0
