"""The rig: which sensors a vehicle has, where they are, and which packets are theirs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.types import Stream

if TYPE_CHECKING:
    from mlbatch.rig.convert_keys import RigOption
    from mlbatch.rig.recipes import Dataset
    from mlbatch.ros.point_times import PointRule

DEFAULT_BODY_FRAME = "base_link"
# Letters of the name of a sensor, which is that of a folder.
MAX_NAME = 100
# Key of the facts about a public dataset, in its recipe.
DATASET = "dataset"
# The time in the name of a file of sweeps, with its unit.
STAMP = re.compile(r"\{stamp(?::(\w+))?\}")
# Fields of `StreamSelector`, and keys of `stream` in the file.
STREAM_FIELDS = ("source_ip", "port", "topic", "serial", "frame_id", "lidar_id")


@dataclass(frozen=True, slots=True)
class StreamSelector:
    """The packets of a sensor; an empty string, port 0 or None matches anything.

    frame_id, lidar_id: of one of several lidars whose clouds share a topic.
    """

    source_ip: str = ""
    port: int = 0
    topic: str = ""
    serial: str = ""
    frame_id: str = ""
    lidar_id: int | None = None

    def selects(self, stream: Stream) -> bool:
        """Return whether a stream matches, apart from the serial numbers in its packets."""
        return (
            self.source_ip in ("", stream.source_ip)
            and self.port in (0, stream.port)
            and self.topic in ("", stream.topic)
            and self.frame_id in ("", stream.frame_id)
            and self.lidar_id in (None, stream.lidar_id)
        )

    def __str__(self) -> str:
        parts = {name: getattr(self, name) for name in STREAM_FIELDS}
        given = {name: value for name, value in parts.items() if value or name == "lidar_id"}
        return ", ".join(f"{name} {value}" for name, value in given.items() if value is not None)


class UnknownExtrinsics(NamedTuple):
    """`extrinsics: unknown`; place: file, line and key path of it."""

    place: str = ""


class Sweeps(NamedTuple):
    """Files of a sensor, one per sweep, in the folder that is given as recording.

    glob: pattern in the folder, and topic of the sensor, `{stamp:us}` is the time in the name;
    fields: name and numpy type of each field of a point, empty: the file states them; place: file,
    line and key path of the pattern; arrays: field and array of a .npz file.
    """

    glob: str
    fields: tuple[tuple[str, str], ...]
    place: str = ""
    arrays: tuple[tuple[str, str], ...] = ()

    @property
    def paths(self) -> str:
        """The pattern for paths, with * for the time."""
        return STAMP.sub("*", self.glob)


@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """One sensor of the rig; None: taken from the recording.

    extrinsics: (4, 4) float64 body_from_sensor, m, or the name of a frame of the recording, or
    unknown; extrinsics_files: files that it was read from; rotation_rpy_deg: as given, if it is;
    clock: sensor or host; epoch: of the sensor's clock, utc, tai or gps; offset_ns: added to the
    timestamps; decode: options as for `--decode`; points: how its clouds are read; sweeps: its
    files, of a folder of sweeps.
    """

    name: str
    model: str | None = None
    stream: StreamSelector | None = None
    metadata: Path | None = None
    extrinsics: F64Array | str | UnknownExtrinsics | None = None
    extrinsics_files: tuple[Path, ...] = ()
    rotation_rpy_deg: tuple[float, ...] = ()
    clock: str | None = None
    epoch: str | None = None
    offset_ns: int = 0
    min_range_m: float | None = None
    max_range_m: float | None = None
    optional: bool = False
    decode: dict[str, str] = field(default_factory=dict)
    points: PointRule | None = None
    sweeps: Sweeps | None = None


def no_boxes() -> F64Array:
    """Return an array of no boxes, (0, 6)."""
    return np.zeros((0, 6))


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """The sensors in the order of `lidar_id`, and settings of all.

    exclude_boxes_m: (k, 6) float64, x0, y0, z0, x1, y1, z1 in the body frame; options: of
    `mlbatch convert`; dataset: that it is a recipe for.
    """

    sensors: tuple[RigSensor, ...]
    body_frame: str = DEFAULT_BODY_FRAME
    rate: Fraction | None = None
    exclude_boxes_m: F64Array = field(default_factory=no_boxes)
    options: tuple[RigOption, ...] = ()
    dataset: Dataset | None = None


def read_rig(path: Path, recordings: Sequence[Path] = ()) -> Rig:
    """Read a rig file; RigError names file, line and key of the first mistake.

    recordings: files that the recipe of a dataset names are searched around them.
    """
    # Imported on demand: most runs have no rig and need no YAML parser.
    from mlbatch.rig.schema import rig_from
    from mlbatch.rig.yaml_tree import read_yaml

    root = read_yaml(Path(path))
    if DATASET in root.entries:
        from mlbatch.rig.recipes import with_files

        root = with_files(root, recordings)
    return rig_from(root)
