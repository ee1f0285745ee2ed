"""Outputs of the fixture in all formats, made once, and the edits that spoil copies of them."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.verify import Verdict, verify
from tests.builders.run import TWO_LIDARS, command

Values = npt.NDArray[Any]
Edit = Callable[[Path], None]

# Head and three windows of the fixture; near points only, to keep files small.
COMMON = ("--keep-partial", "--end", "+0.3", "--max-range", "9", "--quiet")
KINDS: dict[str, tuple[str, ...]] = {
    "npz": (),
    "npz-slices": ("--slices", "3"),
    "npz-split": ("--split",),
    "npz-organized": ("--layout", "organized"),
    "ply": ("--format", "ply"),
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
def _folder() -> Path:
    return Path(mkdtemp(prefix="verify-"))


@cache
def made(kind: str) -> Path:
    """The output of this kind; not to be changed."""
    target = _folder() / kind
    recording, rig = TWO_LIDARS / "two_lidars.pcap", TWO_LIDARS / "rig.yaml"
    told = command("convert", recording, "--rig", rig, "-o", target, *COMMON, *KINDS[kind])
    assert (told.code, told.err) == (0, "")
    return target


def forget() -> None:
    """Remove all of it."""
    shutil.rmtree(_folder(), ignore_errors=True)
    made.cache_clear()
    _folder.cache_clear()


def copied(kind: str, folder: Path) -> Path:
    """A copy of an output, with what lies beside it."""
    source = made(kind)
    if source.is_dir():
        return Path(shutil.copytree(source, folder / kind))
    for file in source.parent.glob(f"{kind}*"):
        shutil.copy(file, folder / file.name)
    return folder / kind


def spoiled(kind: str, folder: Path, edit: Edit) -> Verdict:
    """What is said of a copy after an edit."""
    path = copied(kind, folder)
    edit(path)
    return verify(path)


def found(places: list[tuple[str, str]], check: str, where: str) -> None:
    """A violation of this check names this place."""
    assert any(one == check and where in place for one, place in places), places


def spoiled_places(kind: str, folder: Path, edit: Edit) -> list[tuple[str, str]]:
    """Check and place of every violation."""
    return [(one.check, one.where) for one in spoiled(kind, folder, edit).violations]


# -- edits ----------------------------------------------------------------------------------------


def npz(name: str, key: str, change: Callable[[Values], Values]) -> Edit:
    """Change an array of a scan."""

    def edit(folder: Path) -> None:
        with np.load(folder / name) as archive:
            arrays = dict(archive)
        arrays[key] = change(arrays[key].copy())
        np.savez(folder / name, **arrays)

    return edit


def arrays(name: str, change: Callable[[dict[str, Values]], None]) -> Edit:
    """Change arrays of a scan together."""

    def edit(folder: Path) -> None:
        with np.load(folder / name) as archive:
            found = dict(archive)
        change(found)
        np.savez(folder / name, **found)

    return edit


def at(place: Any, value: Any) -> Callable[[Values], Values]:
    """Put a value at a place."""

    def change(values: Values) -> Values:
        values[place] = value
        return values

    return change


def plus(place: Any, value: Any) -> Callable[[Values], Values]:
    """Add a value at a place."""

    def change(values: Values) -> Values:
        values[place] = values[place].item() + value
        return values

    return change


def swapped(first: int, second: int) -> Callable[[Values], Values]:
    """Exchange two values."""

    def change(values: Values) -> Values:
        values[[first, second]] = values[[second, first]]
        return values

    return change


def row(line: int, column: str, value: object, name: str = "scans.csv") -> Edit:
    """Change a cell of a table; lines are counted from the first scan."""

    def edit(path: Path) -> None:
        table = path / name if path.is_dir() else path.with_name(f"{path.name}.{name}")
        table.write_text(with_cell(table.read_text(), line, column, value))

    return edit


def with_cell(text: str, line: int, column: str, value: object) -> str:
    """A table with another cell; a function of the old value, or a new one."""
    rows = list(csv.reader(io.StringIO(text)))
    where = rows[0].index(column)
    old = rows[line + 1][where]
    rows[line + 1][where] = str(value(int(old)) if callable(value) else value)
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def report(*path: str | int, to: Any) -> Edit:
    """Change a value of the report beside or inside; `to`: a value, or a function of the old."""

    def edit(output: Path) -> None:
        inside = output / "report.json"
        file = inside if output.is_dir() else output.with_name(f"{output.name}.report.json")
        file.write_text(with_value(file.read_text(), path, to))

    return edit


def with_value(text: str, path: tuple[str | int, ...], to: Any) -> str:
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
    """Take a file away."""

    def edit(folder: Path) -> None:
        (folder / name).unlink()

    return edit


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
