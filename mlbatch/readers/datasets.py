"""Files of datasets that are no recordings: what they are, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

# Of a ROS 2 bag, in its folder.
BAG_METADATA = "metadata.yaml"
# Files and folders in a folder that are looked at.
_LOOKED_AT = 1000
# Folders in a folder that may be drives of a dataset.
_MOST_FOLDERS = 3


class DatasetFile(NamedTuple):
    """Files of one kind; magic: their first bytes, or empty: by the suffix alone."""

    suffixes: tuple[str, ...]
    magic: bytes
    found: str
    remedy: str


_MOVED = (
    "its points are moved to one time by the vehicle's motion and cannot be batched by the time "
    "that they were measured at"
)
_TIMELESS = (
    "a dataset without a time for each point (Complex Urban, KITTI, Lyft, nuPlan) cannot be batched"
)
DATASET_FILES = (
    DatasetFile(
        (".feather", ".arrow"),
        b"ARROW1",
        "a table of Arrow, as the sweeps of Argoverse 2",
        f"if it is one of these, {_MOVED}; else write its points as .bin files and describe them "
        "in a rig",
    ),
    DatasetFile(
        (".parquet",),
        b"PAR1",
        "a table of Parquet, as the range images of Waymo Open",
        f"if it is one of these, it has one time for all points, and {_MOVED}",
    ),
    DatasetFile(
        (".tfrecord",),
        b"",
        "a TFRecord, as the range images of Waymo Open",
        f"if it is one of these, it has one time for all points, and {_MOVED}",
    ),
    DatasetFile(
        (".pkl", ".pkl.gz"),
        b"",
        "a pickle, as the sweeps of PandaSet",
        f"if it is one of these, {_MOVED}; pickles are not read, as reading one runs its code",
    ),
    DatasetFile(
        (".bin",),
        b"",
        "raw points (.bin)",
        "describe its folder in a rig (points: {glob: '*.bin', dtype: {x: f4, y: f4, z: f4, t: "
        f"u4}}}}); {_TIMELESS}",
    ),
    DatasetFile(
        (".pcd",),
        b"",
        "a PCD file",
        f"describe its folder in a rig (points: {{glob: '*.pcd'}}); {_TIMELESS}",
    ),
    DatasetFile(
        (".npz",),
        b"",
        "numpy arrays (.npz), as the points of A2D2",
        "describe its folder in a rig (points: {glob: '*.npz', arrays: {x: points.0, t: times}})",
    ),
)


def found_in_file(path: Path, head: bytes) -> str:
    """`found X; remedy` for a file that is no recording; "" where it is not known."""
    name = path.name.lower()
    if name == BAG_METADATA:
        return f"found the description of a bag; name its folder {path.parent}"
    for one in DATASET_FILES:
        if (one.magic and head.startswith(one.magic)) or name.endswith(one.suffixes):
            return f"found {one.found}; {one.remedy}"
    return ""


def found_in_folder(folder: Path) -> str:
    """The same for a folder without recordings, by most of its files; "" without known ones."""
    from mlbatch.rig.recipes import by_files, proposal

    known = proposal(by_files(folder))
    if known:
        return f"found a folder of files; {known}"
    folders = sorted(path for path in islice(folder.glob("*"), _LOOKED_AT) if path.is_dir())
    for inner in folders[:_MOST_FOLDERS]:
        known = proposal(by_files(inner))
        if known:
            return f"found a folder of folders; name {inner}: {known}"
    names = [path.name.lower() for path in _some_files(folder)]
    counts = [sum(name.endswith(one.suffixes) for name in names) for one in DATASET_FILES]
    most = max(counts, default=0)
    if not most:
        return ""
    one = DATASET_FILES[counts.index(most)]
    return f"found a folder with {one.found}; {one.remedy}"


def _some_files(folder: Path) -> Sequence[Path]:
    """Files of a folder, and of the folders in it."""
    try:
        return [path for path in islice(folder.rglob("*"), _LOOKED_AT) if path.is_file()]
    except OSError:
        return ()
