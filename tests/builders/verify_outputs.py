"""Outputs of the fixture in all formats, made once, and edits that damage copies of them."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.verification import Verdict, verify
from tests.builders.run import TWO_LIDARS, command

Values = npt.NDArray[Any]
Arrays = dict[str, Values]
Edit = Callable[[Path], None]
# Head and three windows of the fixture; near points only, to keep files small.
COMMON = ("--keep-partial", "--end", "+0.3", "--max-range", "9", "--quiet")
KINDS: dict[str, tuple[str, ...]] = {
    "npz": (),
    "npz-slices": ("--slices", "3"),
    "npz-split": ("--split",),
    "npz-organized": ("--layout", "organized"),
    "webdataset": ("--format", "webdataset"),
    "webdataset-split": ("--format", "webdataset", "--split", "--slices", "3"),
    "webdataset-organized": ("--format", "webdataset", "--layout", "organized"),
    "ply": ("--format", "ply"),
    "ply-cloudcompare": ("--format", "ply", "--ply-style", "cloudcompare"),
    "ply-float": ("--format", "ply", "--ply-style", "float"),
    "pcd": ("--format", "pcd"),
    "pcd-organized": ("--format", "pcd", "--layout", "organized"),
    "las": ("--format", "las"),
    "laz": ("--format", "laz"),
    "kitti": ("--format", "kitti"),
    "kitti-split": ("--format", "kitti", "--split", "--slices", "3"),
    "nuscenes": ("--format", "nuscenes"),
    "scans.mcap": (),
    "split.mcap": ("--split",),
    "organized.mcap": ("--layout", "organized"),
    "autoware.mcap": ("--point-layout", "autoware", "--split"),
    "ouster.mcap": ("--point-layout", "ouster", "--split"),
    "zstd.mcap": ("--compression", "zstd"),
    "lz4.mcap": ("--compression", "lz4"),
    "minimal.mcap": ("--point-layout", "minimal"),
    "bag2": ("--format", "rosbag2"),
    "scans.bag": (),
}


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="verify-")


@cache
def made(kind: str) -> Path:
    """The output of this kind; not to be changed."""
    target = Path(_folder().name) / kind
    recording = TWO_LIDARS / "two_lidars.pcap"
    rig = TWO_LIDARS / "rig.yaml"
    run = command("convert", recording, "--rig", rig, "-o", target, *COMMON, *KINDS[kind])
    assert (run.code, run.err) == (0, "")
    return target


def copied(kind: str, folder: Path) -> Path:
    """A copy of an output, with the files next to it."""
    source = made(kind)
    if source.is_dir():
        return Path(shutil.copytree(source, folder / kind))
    for file in source.parent.glob(f"{kind}*"):
        shutil.copy(file, folder / file.name)
    return folder / kind


def damaged(kind: str, folder: Path, edit: Edit) -> Verdict:
    """The verdict on a copy after an edit."""
    path = copied(kind, folder)
    edit(path)
    return verify(path)


# -- edits ----------------------------------------------------------------------------------------


def arrays(name: str, change: Callable[[Arrays], None]) -> Edit:
    """Change arrays of a scan together."""

    def edit(folder: Path) -> None:
        with np.load(folder / name) as archive:
            found = dict(archive)
        change(found)
        np.savez(folder / name, **found)

    return edit


def row(line: int, column: str, value: object) -> Edit:
    """Change a cell of scans.csv; lines are counted from the first scan."""

    def edit(path: Path) -> None:
        table = _part(path, "scans.csv")
        table.write_text(with_cell(table.read_text(), line, column, value))

    return edit


def report(*path: str | int, to: Any) -> Edit:
    """Change a value of report.json; `to`: a value, or a function of the old one."""

    def edit(output: Path) -> None:
        file = _part(output, "report.json")
        file.write_text(with_value(file.read_text(), path, to))

    return edit


def _part(output: Path, name: str) -> Path:
    return output / name if output.is_dir() else output.with_name(f"{output.name}.{name}")


def with_cell(text: str, line: int, column: str, value: object) -> str:
    """A table with another cell; a function of the old value, or a new one."""
    rows = list(csv.reader(io.StringIO(text)))
    where = rows[0].index(column)
    old = rows[line + 1][where]
    rows[line + 1][where] = str(value(int(old)) if callable(value) else value)
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def with_value(text: str, path: Sequence[str | int], to: Any) -> str:
    """A JSON text with another value."""
    root = json.loads(text)
    place = root
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = to(place.get(path[-1])) if callable(to) else to
    return json.dumps(root)


def both(*edits: Edit) -> Edit:
    """Several edits."""

    def edit(path: Path) -> None:
        for one in edits:
            one(path)

    return edit


def renamed(old: str, new: str) -> Edit:
    """Give a file another name."""

    def edit(folder: Path) -> None:
        (folder / old).rename(folder / new)

    return edit


def removed(name: str) -> Edit:
    """Remove a file."""
    return lambda folder: (folder / name).unlink()


def raw(name: str, change: Callable[[bytearray], bytes | bytearray]) -> Edit:
    """Change the bytes of a file; an empty name is the output itself."""

    def edit(path: Path) -> None:
        file = path / name if name else path
        file.write_bytes(change(bytearray(file.read_bytes())))

    return edit


def flipped(place: int) -> Callable[[bytearray], bytearray]:
    """Another byte at a place."""

    def change(data: bytearray) -> bytearray:
        data[place] ^= 0x55
        return data

    return change


def text(name: str, old: str, new: str) -> Edit:
    """Replace the first occurrence of a text in a file."""

    def change(data: bytearray) -> bytes:
        assert old.encode() in data, old
        return bytes(data).replace(old.encode(), new.encode(), 1)

    return raw(name, change)
