"""Kind of a path: an output in one file, in a folder of a format, or none.

Libraries of a format are loaded only for outputs of that format.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mlbatch.bounded import open_file
from mlbatch.outputs import commented, las, npz, webdataset
from mlbatch.outputs import float_rows as rows
from mlbatch.outputs.damage import CheckLog, VerifyError
from mlbatch.outputs.folders import ScanFile, ScanReader, entries, refuse_shard, scan_files

METADATA = "metadata.yaml"
REPORT = "report.json"
_MAGICS = {b"\x89MCAP0\r\n": "mcap", b"#ROSBAG V2.0\n": "rosbag1"}
_HEAD_BYTES = 16
# Why `geometry` is limited where beams are not stored.
RANGES = "ranges to 1 m: beams do not leave from the origin of their sensor"


@dataclass(frozen=True, slots=True)
class FileFormat:
    """A format; suffix: of the first file of a scan.

    limits: why checks are not or only partly possible; inside: of a format whose files have several
    scans, see `scan_files`.
    """

    name: str
    suffix: str
    reader: Callable[[CheckLog], ScanReader]
    limits: Mapping[str, str]
    inside: Callable[[CheckLog, ScanFile], Iterator[ScanFile]] | None = None

    def files(self, log: CheckLog, output: Path) -> list[ScanFile]:
        """The scans of an output, see `scan_files`."""
        return scan_files(log, output, self.suffix, self.inside)

    def has(self, path: Path) -> bool:
        """Whether a file has the name of one of its files; archives may have any other name."""
        stem = path.name.removesuffix(self.suffix)
        return stem != path.name and (self.inside is None or stem.isdecimal())


# In the order in which suffixes are looked for: that of kitti is the end of that of nuscenes.
FILE_FORMATS = (
    FileFormat("npz", npz.SUFFIX, npz.NpzReader, npz.LIMITS | {"geometry": RANGES}),
    FileFormat(
        "webdataset",
        webdataset.SUFFIX,
        webdataset.SampleReader,
        npz.LIMITS | {"geometry": RANGES},
        webdataset.samples,
    ),
    FileFormat("ply", commented.PLY_SUFFIX, commented.PlyReader, commented.commented_limits("PLY")),
    FileFormat("pcd", commented.PCD_SUFFIX, commented.PcdReader, commented.commented_limits("PCD")),
    FileFormat("las", las.LAS_SUFFIX, las.LasReader, commented.commented_limits("LAS")),
    FileFormat("laz", las.LAZ_SUFFIX, las.LasReader, commented.commented_limits("LAS")),
    FileFormat("nuscenes", rows.NUSCENES_SUFFIX, rows.RowReader, rows.NUSCENES_LIMITS),
    FileFormat("kitti", rows.KITTI_SUFFIX, rows.RowReader, rows.KITTI_LIMITS),
)


def format_of(paths: Collection[Path]) -> FileFormat | None:
    """The format of files; None if there is none of a known one."""
    return next(
        (one for one in FILE_FORMATS if any(map(one.has, paths))),
        None,
    )


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
    form = format_of([path])
    if form is not None and path.with_name(f"{path.name}.{REPORT}").is_file():
        # The only scan of an output.
        return Kind("files", form)
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
