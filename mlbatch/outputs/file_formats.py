"""Formats with files for each scan: how they are recognised and read, and their limits.

Libraries of a format are loaded only for outputs of that format.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from mlbatch.outputs import float_rows as rows
from mlbatch.outputs import las, npz, pcd, ply
from mlbatch.outputs.commented import commented_limits
from mlbatch.outputs.damage import CheckLog
from mlbatch.outputs.folders import ScanReader

_RANGES = "ranges to 1 m: beams do not leave from the origin of their sensor"


@dataclass(frozen=True, slots=True)
class FileFormat:
    """A format; suffix: of the first file of a scan; limits: as in `Output.verdict`."""

    name: str
    suffix: str
    reader: Callable[[CheckLog], ScanReader]
    limits: Mapping[str, str]


# In the order in which suffixes are looked for: that of kitti is the end of that of nuscenes.
FILE_FORMATS = (
    FileFormat("npz", npz.SUFFIX, npz.NpzReader, npz.LIMITS | {"geometry": _RANGES}),
    FileFormat("ply", ply.SUFFIX, ply.PlyReader, commented_limits("PLY")),
    FileFormat("pcd", pcd.SUFFIX, pcd.PcdReader, commented_limits("PCD")),
    FileFormat("las", las.LAS_SUFFIX, las.LasReader, commented_limits("LAS")),
    FileFormat("laz", las.LAZ_SUFFIX, las.LasReader, commented_limits("LAS")),
    FileFormat("nuscenes", rows.NUSCENES_SUFFIX, rows.RowReader, rows.NUSCENES_LIMITS),
    FileFormat("kitti", rows.KITTI_SUFFIX, rows.RowReader, rows.KITTI_LIMITS),
)


def format_of(paths: Collection[Path]) -> FileFormat | None:
    """The format of files; None if there is none of a known one."""
    return next(
        (one for one in FILE_FORMATS if any(path.name.endswith(one.suffix) for path in paths)),
        None,
    )
