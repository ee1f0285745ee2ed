"""Folders of files with comments and points: PLY and PCD, and what LAS has in common with them.

Formats: docs/formats.md; G. Turk, "The PLY Polygon File Format", 1994; PCL, "The PCD (Point Cloud
Data) file format", version 0.7.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, I64Array
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.folders import ScanFile, ScanReader
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import POINT_ARRAYS, StoredScan, seconds_to_ns

# Numbers of up to 19 digits: Python refuses very long ones.
_INDEX = re.compile(r"(-?\d{1,19}) slice (\d{1,19}) of (\d{1,19})", re.ASCII)


@dataclass(frozen=True, slots=True)
class ScanComments:
    """Comments by their first word."""

    by_name: dict[str, str]

    @classmethod
    def of_lines(cls, lines: Iterable[str]) -> ScanComments:
        """Comments from lines: a name, a blank, a value."""
        parts = (line.partition(" ") for line in lines)
        return cls({name.rstrip(":"): value for name, _, value in parts if value})

    def number(self, name: str) -> int:
        """A comment that is a number."""
        try:
            return int(self.by_name[name])
        except (KeyError, ValueError):
            found = self.by_name.get(name, "none")
            raise DamageError(f"comment {name} with a number", found) from None

    def place(self) -> tuple[int, int, int]:
        """Index, slice and slices."""
        text = self.by_name.get("index", "none")
        found = _INDEX.fullmatch(text)
        if found is None:
            raise DamageError("comment index I slice J of N", text)
        index, part, slices = map(int, found.groups())
        return index, part, slices

    def is_complete(self) -> bool:
        """Whether every sensor covers the window."""
        text = self.by_name.get("complete")
        if text not in ("true", "false"):
            raise DamageError("comment complete true or false", str(text))
        return text == "true"

    def fill(self) -> F32Array:
        """Fill by sensor; `unknown` is NaN."""
        text = self.by_name.get("fill", "none")
        try:
            return np.array(
                [math.nan if word == "unknown" else float(word) for word in text.split(" ")],
                np.float32,
            )
        except ValueError:
            raise DamageError("comment fill with a number for each sensor", text) from None

    def metadata(self, log: CheckLog | None = None, where: str = "") -> RunMetadata:
        """Metadata of the run; log: for words that are unknown."""
        _, _, slices = self.place()
        _, _, names = self.by_name.get("lidar_id", "").partition("from 0: ")
        sensors = tuple(names.split(" ")) if names else None
        return RunMetadata.of(log or CheckLog(), where, self.by_name, sensors, slices=slices)


Values: TypeAlias = npt.NDArray[Any]
Fields: TypeAlias = dict[str, Values]
_ORGANIZED_AXES = 3


def commented_limits(name: str) -> dict[str, str]:
    """Reasons why checks are not possible on files of a format with comments and points."""
    absent = {
        "geometry": "ranges",
        "duplicates": "columns",
        "tf_static": "transforms",
        "imu": "IMU samples",
        "messages": "messages",
        "stamps": "log times",
    }
    return {
        "columns": f"first and last column of a scan, by scans.csv; {name} has no column stamps",
        "order": f"points step back by less than a column's duration; {name} has no columns",
        **{check: f"{name} has no {what}" for check, what in absent.items()},
    }


@dataclass(slots=True)
class CommentedReader(ScanReader):
    """Reads the files of one folder; all of a run have the same metadata."""

    _metadata: RunMetadata = field(default_factory=RunMetadata)

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and points of a file; DamageError for another file. By format.

        Arrays are (p,), or (n, slots) in an organized scan: `xyz`, `time` (float s after the start)
        or `time_ns`, and perhaps other arrays of `StoredScan`.
        """
        raise NotImplementedError

    def begin(self, file: ScanFile) -> RunMetadata:
        """Metadata of the run in the first scan."""
        comments, points = self.parse(file.read())
        self._metadata = comments.metadata(self.log, file.where)
        self.sensors = self._metadata.sensors or ()
        self.organized = points["xyz"].ndim == _ORGANIZED_AXES
        return self._metadata

    def scan(self, file: ScanFile) -> StoredScan:
        """One scan, checked against the others."""
        log = self.log
        comments, points = self.parse(file.read())
        log.ok("layout")
        self._metadata.joined(log, file.where, comments.metadata(log, file.where))
        organized = points["xyz"].ndim == _ORGANIZED_AXES
        where = f"{file.where} {'slot' if organized else 'point'}"
        time_ns, step_ns = self._times(where, points)

        def labels(check: str, name: str) -> Any:
            return self._labels(check, where, points.get(name), POINT_ARRAYS[name])

        index, part, slices = comments.place()
        complete = comments.is_complete()
        file.check_name(log, index, part, slices)
        return StoredScan(
            where=file.where,
            start_ns=comments.number("start_ns"),
            end_ns=comments.number("end_ns"),
            index=index,
            slice=part,
            complete=complete,
            xyz=points["xyz"],
            organized=organized,
            sensor=file.sensor_index(log, self.sensors),
            intensity=points.get("intensity"),
            reflectivity=points.get("reflectivity"),
            time_ns=time_ns,
            time_step_ns=step_ns,
            time_s=points.get("time"),
            ring=labels("rings", "ring"),
            return_type=labels("returns", "return_type"),
            lidar_id=labels("sensors", "lidar_id"),
            fill=comments.fill(),
        )

    def _times(self, where: str, points: Fields) -> tuple[I64Array, int]:
        """Times in ns and their resolution."""
        if "time_ns" in points:
            return points["time_ns"], 0
        time_s = points["time"]
        bad: BoolArray = np.logical_not(np.isfinite(time_s))
        if bad.any():
            found = time_s.reshape(-1).item
            self.log.none("times", where, bad.reshape(-1), "a finite number", found)
        return seconds_to_ns(time_s)

    def _labels(self, check: str, where: str, values: Values | None, kind: str) -> Any:
        """Whole numbers of an unsigned type; others are violations, and cut."""
        if values is None:
            return None
        if values.dtype.str != kind:
            most = int(np.iinfo(kind).max)
            whole: I64Array = values.astype(np.int64)
            cut: I64Array = np.clip(whole, 0, most)
            bad: BoolArray = (cut != whole).reshape(-1)
            name = {"rings": "ring", "returns": "return type", "sensors": "sensor"}[check]
            self.log.none(check, where, bad, f"a {name} from 0 to {most}", values.reshape(-1).item)
            values = cut
        return values.astype(np.uint8 if kind == "|u1" else np.int64)


PLY_SUFFIX = ".ply"
_PLY_TYPES = {"float": "<f4", "double": "<f8", "int": "<i4", "uchar": "u1"}
_XYZ = {"x": "float", "y": "float", "z": "float"}
_STANDARD = {
    "intensity": "float",
    "time": "double",
    "ring": "int",
    "return_type": "uchar",
    "lidar_id": "uchar",
}
_PLY_HEAD = "ply\nformat binary_little_endian 1.0\ncomment mlbatch "
_PLY_END = b"end_header\n"
_LONGEST_HEAD = 1 << 20
_VERTICES = re.compile(r"element vertex (\d{1,19})", re.ASCII)


# Properties by `--ply-style`.
_STYLES = (
    _XYZ | _STANDARD,
    _XYZ | {f"scalar_{name}": kind for name, kind in _STANDARD.items()},
    _XYZ | {"time": "float"},
)


class PlyReader(CommentedReader):
    """Reads the files of one folder."""

    __slots__ = ()

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and vertices of a file."""
        comments, properties, vertices, begin = _ply_head(data)
        kinds = ((name.removeprefix("scalar_"), _PLY_TYPES[kind]) for name, kind in properties[3:])
        vertex = np.dtype([("xyz", "<f4", (3,)), *kinds])
        if len(data) != begin + vertices * vertex.itemsize:
            expected = f"{vertices} vertices of {vertex.itemsize} bytes"
            raise DamageError(expected, f"{len(data) - begin} bytes after the header")
        points = np.frombuffer(data, vertex, vertices, begin)
        return comments, {name: points[name] for name in vertex.names or ()}


def _ply_head(data: bytes) -> tuple[ScanComments, list[tuple[str, str]], int, int]:
    """Comments, properties, number of vertices, and offset of the first one."""
    end = data.find(_PLY_END, 0, _LONGEST_HEAD)
    text = data[: max(end, 0)].decode("utf-8", "replace")
    if not text.startswith(_PLY_HEAD):
        raise DamageError("the header of a binary PLY file of mlbatch", repr(text[:60]))
    comments: list[str] = []
    properties: dict[str, str] = {}
    vertices = -1
    for line in text.splitlines()[2:]:
        words = line.split(" ", 2)
        count = _VERTICES.fullmatch(line)
        if words[0] == "comment" and len(words) == 3:
            comments.append(line.removeprefix("comment "))
        elif count is not None:
            vertices = int(count[1])
        elif words[0] == "property" and len(words) == 3:
            properties[words[2]] = words[1]
        else:
            raise DamageError("a line of a PLY header of mlbatch", repr(line))
    found = list(properties.items())
    if vertices < 0 or found not in [list(style.items()) for style in _STYLES]:
        names = ", ".join(f"{kind} {name}" for name, kind in found)
        raise DamageError("the properties of docs/formats.md", names or "none")
    return ScanComments.of_lines(comments), found, vertices, end + len(_PLY_END)


PCD_SUFFIX = ".pcd"
# Name, size, kind and numpy type.
_FIELDS = (
    ("x", 4, "F", "<f4"),
    ("y", 4, "F", "<f4"),
    ("z", 4, "F", "<f4"),
    ("intensity", 4, "F", "<f4"),
    ("time", 4, "F", "<f4"),
    ("ring", 2, "U", "<u2"),
    ("return_type", 1, "U", "u1"),
    ("lidar_id", 1, "U", "u1"),
)
_POINT = np.dtype([("xyz", "<f4", (3,)), *((name, kind) for name, _, _, kind in _FIELDS[3:])])
_FIXED = {
    "VERSION": "0.7",
    "FIELDS": " ".join(name for name, *_ in _FIELDS),
    "SIZE": " ".join(str(size) for _, size, *_ in _FIELDS),
    "TYPE": " ".join(kind for _, _, kind, _ in _FIELDS),
    "COUNT": " ".join("1" for _ in _FIELDS),
    "VIEWPOINT": "0 0 0 1 0 0 0",
}
_COUNTS = ("WIDTH", "HEIGHT", "POINTS")
_NUMBER = re.compile(r"\d{1,19}", re.ASCII)
_PCD_HEAD = b"# .PCD v0.7"
_PCD_END = b"\nDATA binary\n"


class PcdReader(CommentedReader):
    """Reads the files of one folder."""

    __slots__ = ()

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and points of a file; a row of an organized one is a slot."""
        end = data.find(_PCD_END, 0, _LONGEST_HEAD)
        if end < 0 or not data.startswith(_PCD_HEAD):
            raise DamageError("the header of a binary PCD file of mlbatch", repr(data[:40]))
        lines = data[:end].decode("utf-8", "replace").splitlines()
        comments = [line[2:] for line in lines[1:] if line.startswith("# ")]
        entries = dict(
            (name, value) for name, _, value in (x.partition(" ") for x in lines) if name != "#"
        )
        for name, expected in _FIXED.items():
            if entries.get(name) != expected:
                raise DamageError(f"{name} {expected}", entries.get(name, "none"))
        for name in _COUNTS:
            if _NUMBER.fullmatch(entries.get(name, "")) is None:
                raise DamageError(f"{name} with a number", entries.get(name, "none"))
        width, height, count = (int(entries[name]) for name in _COUNTS)
        begin = end + len(_PCD_END)
        if count != width * height or len(data) != begin + count * _POINT.itemsize:
            expected = f"{width} x {height} points of {_POINT.itemsize} bytes"
            raise DamageError(expected, f"{count} points, {len(data) - begin} bytes")
        flat = np.frombuffer(data, _POINT, count, begin)
        points = flat if height == 1 else flat.reshape(height, width).T
        names = points.dtype.names or ()
        return ScanComments.of_lines(comments), {name: points[name] for name in names}
