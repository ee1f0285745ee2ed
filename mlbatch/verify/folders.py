"""Folders of one file a scan: which file is which scan (CONTRACT.md, section 3)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mlbatch.verify.verdict import Judge, VerifyError

_NAME = re.compile(r"(?:(\d{6,})|(head))(?:-(\d+))?")
# What a folder may hold besides; other files are nobody's business, unless they look like scans.
_LIKE_SCANS = (".npz", ".ply", ".partial", ".mcap", ".bag")


@dataclass(frozen=True, slots=True)
class ScanFile:
    """A file of a scan; slice: None where windows are whole; sensor: folder with `--split`."""

    path: Path
    where: str
    sensor: str | None
    index: int
    slice: int | None


def entries(folder: Path) -> list[Path]:
    """What lies in a folder, by name."""
    try:
        return sorted(folder.iterdir())
    except OSError as err:
        raise VerifyError(f"{folder}: wanted to read it, got {err.strerror!r}") from err


def scan_files(judge: Judge, folder: Path, suffix: str) -> list[ScanFile]:
    """All files of scans, sensor by sensor, in the order of time; strange names are blamed."""
    found = list(_of_folder(judge, folder, suffix, None))
    split = [
        file
        for entry in entries(folder)
        if entry.is_dir() and not entry.name.startswith(".")
        for file in _of_folder(judge, entry, suffix, entry.name)
    ]
    if found and split:
        first = split[0].where
        judge.blame("names", first, "scans in the folder or in those of sensors", "both")
    sliced = {file.slice is not None for file in (*found, *split)}
    if len(sliced) > 1:
        judge.blame("names", str(folder.name), "names with or without a slice", "both")
    return sorted(
        (*found, *split), key=lambda file: (file.sensor or "", file.index, file.slice or 0)
    )


def _of_folder(judge: Judge, folder: Path, suffix: str, sensor: str | None) -> Iterator[ScanFile]:
    for path in entries(folder):
        where = path.name if sensor is None else f"{sensor}/{path.name}"
        if path.suffix not in _LIKE_SCANS or path.is_dir():
            continue
        judge.passed("names")
        name = _NAME.fullmatch(path.stem)
        if name is None or path.suffix != suffix:
            kind = "" if path.suffix == suffix else f" and {suffix}"
            judge.blame(
                "names", where, f"an index of six digits or head, perhaps -slice{kind}", path.name
            )
            continue
        index = -1 if name[2] else int(name[1])
        if not name[2] and name[1] != f"{index:06d}":
            judge.blame("names", where, f"{index:06d}", name[1])
        yield ScanFile(path, where, sensor, index, None if name[3] is None else int(name[3]))


def check_name(judge: Judge, file: ScanFile, index: int, part: int, slices: int) -> None:
    """The name against what the file says of itself."""
    wanted = "head" if index < 0 else f"{index:06d}"
    if slices > 1:
        wanted += f"-{part}"
    judge.equal("names", file.where, wanted + file.path.suffix, file.path.name)
