"""Outputs of the fixture in all formats, made once, and edits that damage copies of them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
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
Edit = Callable[[Path], object]
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


def arrays(name: str, change: Callable[[Arrays], None]) -> Edit:
    """Change arrays of a scan together."""

    def edit(folder: Path) -> None:
        with np.load(folder / name) as archive:
            found = dict(archive)
        change(found)
        np.savez(folder / name, **found)

    return edit
