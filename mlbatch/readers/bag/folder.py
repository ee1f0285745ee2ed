"""The files of a ROS 2 bag that is a folder.

Source: docs/sources/messages.md, section 5. The files on disk decide; metadata.yaml may be missing,
stale or empty, and differences are noted.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mlbatch.errors import RecordingError, RigError
from mlbatch.readers.datasets import BAG_METADATA, found_in_folder

_BAG_FILE = re.compile(r"\.(db3|mcap)(\.(zstd|zst|gz))?$", re.IGNORECASE)
_RECORDING = re.compile(r"\.(db3|mcap|bag|pcap|pcapng|cap)(\.(zstd|zst|gz))?$", re.IGNORECASE)
# Folders that an error names.
_SHOWN = 3


@dataclass(frozen=True, slots=True)
class BagFolder:
    """Files of a bag in the order of their names; notes: what is wrong, one line each."""

    files: tuple[Path, ...]
    notes: tuple[str, ...]


def bag_folder(folder: Path) -> BagFolder:
    """The files of a bag; RecordingError where the folder contains none."""
    try:
        inside = sorted(folder.iterdir(), key=lambda path: _natural(path.name))
        files = [path for path in inside if path.is_file() and _BAG_FILE.search(path.name)]
    except OSError as err:
        raise RecordingError(
            f"{folder}: expected the folder of a bag, could not read it ({err.strerror}); "
            "check its access rights"
        ) from err
    if not files:
        inner = [path.name for path in inside if has_bag(path, _RECORDING)]
        if inner:
            shown = ", ".join(inner[:_SHOWN]) + (", ..." if len(inner) > _SHOWN else "")
            many = (
                f", or of several drives: mlbatch batch '{folder}/*/' -o OUT" if inner[1:] else ""
            )
            raise RecordingError(
                f"{folder}: expected the recordings of one drive, found {len(inner)} folder(s) "
                f"with recordings ({shown}); name {folder / inner[0]}{many}"
            )
        known = found_in_folder(folder)
        if known:
            raise RecordingError(f"{folder}: expected a recording, {known}")
        raise RecordingError(
            f"{folder}: expected a recording, found a folder without .db3 or .mcap files; "
            "name the files inside it"
        )
    names = {path.name for path in files}
    # `ros2 bag record` leaves both if it is stopped while compressing.
    whole = [path for path in files if path.suffix in (".db3", ".mcap") or path.stem not in names]
    filled = [path for path in whole if path.stat().st_size] or whole[:1]
    notes = [f"{path.name}: has 0 bytes and is left out" for path in whole if path not in filled]
    return BagFolder(tuple(filled), (*notes, *_stale(folder / BAG_METADATA, names, filled)))


def has_bag(path: Path, names: re.Pattern[str] = _BAG_FILE) -> bool:
    """Whether a path is a folder with files of a bag, or with other names."""
    try:
        return path.is_dir() and any(names.search(file.name) for file in path.iterdir())
    except OSError:
        return False


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts bag_10 behind bag_9."""
    return [(int(digits or 0), text) for text, digits in re.findall(r"(\D*)(\d*)", name)]


def _stale(metadata: Path, names: set[str], read: Sequence[Path]) -> list[str]:
    """How metadata.yaml differs from the files on disk."""
    if not metadata.is_file():
        return []
    listed = _listed(metadata)
    if listed is None:
        return [f"{metadata.name}: cannot be read; the files in the folder are read"]
    missing = [name for name in listed if name not in names and not _is_packed(name, names)]
    known = {*listed, *(f"{name}.zstd" for name in listed)}
    notes = [f"{name}: listed in {metadata.name}, but missing" for name in missing]
    extra = [
        f"{path.name}: not listed in {metadata.name}, but read"
        for path in read
        if path.name not in known
    ]
    return [*notes, *extra]


def _is_packed(name: str, names: set[str]) -> bool:
    """Whether a listed file exists under its name with or without the compression's suffix."""
    return f"{name}.zstd" in names or name.removesuffix(".zstd") in names


def _listed(metadata: Path) -> list[str] | None:
    """Names of files in metadata.yaml; None where it cannot be read as such."""
    from mlbatch.rig.yaml_tree import read_yaml

    # Only names are compared: no file outside the folder is ever opened.
    try:
        bag = read_yaml(metadata).entries["rosbag2_bagfile_information"]
        paths = bag.entries["relative_file_paths"].elements("files")
    except (KeyError, RigError):
        return None
    return [Path(path.text).name for path in paths]
