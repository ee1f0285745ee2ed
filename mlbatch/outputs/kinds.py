"""What a path is: an output in one file, in a folder, or none."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mlbatch.bounded import open_file
from mlbatch.outputs.damage import VerifyError
from mlbatch.outputs.file_formats import FileFormat, format_of
from mlbatch.outputs.folders import entries, refuse_shard

METADATA = "metadata.yaml"
_MAGICS = {b"\x89MCAP0\r\n": "mcap", b"#ROSBAG V2.0\n": "rosbag1"}
_HEAD_BYTES = 16


class Kind(NamedTuple):
    """Kind of a path.

    name: mcap, rosbag1, rosbag2, files (one for each scan), or "" for what is no output; form: of
    the files; found: what else it is, for errors.
    """

    name: str
    form: FileFormat | None = None
    found: str = ""


def kind_of(path: Path) -> Kind:
    """The kind of a path; VerifyError for a shard, and for what cannot be read."""
    if path.is_dir():
        return _kind_of_folder(path)
    try:
        with open_file(path) as file:
            head = file.read(_HEAD_BYTES)
    except OSError as err:
        raise VerifyError(
            f"{path}: expected an output of `mlbatch convert`, found {err.strerror!r}; check the "
            "name"
        ) from err
    for magic, name in _MAGICS.items():
        if head.startswith(magic):
            return Kind(name)
    return Kind("", found="a file of another kind" if head else "an empty file")


def _kind_of_folder(path: Path) -> Kind:
    refuse_shard(path)
    inside = entries(path)
    if any(entry.name == METADATA for entry in inside):
        return Kind("rosbag2")
    folders = [entry for entry in inside if entry.is_dir() and not entry.name.startswith(".")]
    form = format_of([*inside, *(inner for folder in folders for inner in entries(folder))])
    if form is not None:
        return Kind("files", form)
    return Kind("", found="a folder without scans" if inside else "an empty folder")
