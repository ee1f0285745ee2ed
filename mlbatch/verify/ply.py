"""Folders of PLY files: points and times, but no columns.

The format: docs/formats.md; G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.verify.folders import ScanFile
from mlbatch.verify.report_checks import RunMetadata
from mlbatch.verify.scan import StoredScan
from mlbatch.verify.verdict import CheckLog, DamageError

SUFFIX = ".ply"
_TYPES = {"float": "<f4", "double": "<f8", "int": "<i4", "uchar": "u1"}
_PROPERTIES = {
    "x": "float",
    "y": "float",
    "z": "float",
    "intensity": "float",
    "time": "double",
    "ring": "int",
    "return_type": "uchar",
    "lidar_id": "uchar",
}
_VERTEX = np.dtype([(name, _TYPES[kind]) for name, kind in _PROPERTIES.items()])
_XYZ = np.dtype(
    {"names": ["xyz"], "formats": [("<f4", 3)], "offsets": [0], "itemsize": _VERTEX.itemsize}
)
_HEAD = "ply\nformat binary_little_endian 1.0\ncomment mlbatch "
_END = b"end_header\n"
_LONGEST_HEAD = 1 << 20
# Numbers of up to 19 digits: Python refuses very long ones.
_INDEX = re.compile(r"(-?\d{1,19}) slice (\d{1,19}) of (\d{1,19})", re.ASCII)
_VERTICES = re.compile(r"element vertex (\d{1,19})", re.ASCII)
_NS = 1e9

LIMITS = {
    "columns": "first and last column of a scan, by scans.csv; PLY has no column stamps",
    "order": "points step back by less than a column's duration; PLY has no columns",
    "geometry": "PLY has no ranges",
    "duplicates": "PLY has no columns",
    "tf_static": "PLY has no transforms",
    "imu": "PLY has no IMU samples",
    "messages": "PLY has no messages",
    "stamps": "PLY has no log times",
}


@dataclass(frozen=True, slots=True)
class _Head:
    """The header of a file."""

    # Comments by their first word.
    comments: dict[str, str]
    vertices: int
    # Offset of the first vertex.
    begin: int

    def number(self, name: str) -> int:
        """A comment that is a number."""
        try:
            return int(self.comments[name])
        except (KeyError, ValueError):
            found = self.comments.get(name, "none")
            raise DamageError(f"comment {name} with a number", found) from None

    def place(self) -> tuple[int, int, int]:
        """Index, slice and slices."""
        text = self.comments.get("index", "none")
        found = _INDEX.fullmatch(text)
        if found is None:
            raise DamageError("comment index I slice J of N", text)
        index, part, slices = map(int, found.groups())
        return index, part, slices

    def fill(self) -> F32Array:
        """Fill by sensor; `unknown` is NaN."""
        text = self.comments.get("fill", "none")
        try:
            return np.array(
                [math.nan if word == "unknown" else float(word) for word in text.split(" ")],
                np.float32,
            )
        except ValueError:
            raise DamageError("comment fill with a number for each sensor", text) from None

    def metadata(self) -> RunMetadata:
        """Metadata of the run."""
        _, _, slices = self.place()
        _, _, names = self.comments.get("lidar_id", "").partition("from 0: ")
        return RunMetadata(
            rate=self.comments.get("rate_hz"),
            slices=slices,
            sensors=tuple(names.split(" ")) if names else None,
            timescale=self.comments.get("timescale"),
            frame_id=self.comments.get("frame_id"),
            sort=self.comments.get("sort"),
        )


@dataclass(slots=True)
class PlyReader:
    """Reads the files of one folder; all of a run have the same metadata."""

    log: CheckLog
    sensors: tuple[str, ...] = ()
    _metadata: RunMetadata = field(default_factory=RunMetadata)

    def begin(self, file: ScanFile) -> RunMetadata:
        """Metadata of the run in the first scan."""
        self._metadata = _head(file.read()).metadata()
        self.sensors = self._metadata.sensors or ()
        return self._metadata

    def scans(self, files: list[ScanFile]) -> Iterator[StoredScan]:
        """Every readable scan; the others are violations."""
        for file in files:
            try:
                scan = self._scan(file)
            except DamageError as err:
                self.log.fail("container", file.where, err.expected, err.found)
                continue
            self.log.ok("container")
            yield scan

    def _scan(self, file: ScanFile) -> StoredScan:
        log = self.log
        data = file.read()
        head = _head(data)
        log.ok("layout")
        self._metadata.joined(log, file.where, head.metadata())
        if len(data) != head.begin + head.vertices * _VERTEX.itemsize:
            expected = f"{head.vertices} vertices of {_VERTEX.itemsize} bytes"
            raise DamageError(expected, f"{len(data) - head.begin} bytes after the header")
        points = np.frombuffer(data, _VERTEX, head.vertices, head.begin)
        xyz: F32Array = np.frombuffer(data, _XYZ, head.vertices, head.begin)["xyz"]
        time_s: F64Array = points["time"]
        finite = np.isfinite(time_s)
        if not finite.all():
            at = int(finite.argmin())
            log.fail("times", f"{file.where} point {at}", "a finite number", time_s[at])
            time_s = np.nan_to_num(time_s)
        time_ns: I64Array = np.rint(np.clip(time_s, -4e9, 4e9) * _NS).astype(np.int64)
        ring: I64Array = points["ring"].astype(np.int64)
        bad = (ring < 0) | (ring > 65535)
        log.none("rings", f"{file.where} point", bad, "a ring from 0 to 65535", ring.item)
        lidar_id: U8Array = np.ascontiguousarray(points["lidar_id"])
        index, part, slices = head.place()
        complete = head.comments.get("complete")
        if complete not in ("true", "false"):
            raise DamageError("comment complete true or false", str(complete))
        file.check_name(log, index, part, slices)
        return StoredScan(
            where=file.where,
            start_ns=head.number("start_ns"),
            end_ns=head.number("end_ns"),
            index=index,
            slice=part,
            complete=complete == "true",
            xyz=xyz,
            organized=False,
            sensor=file.sensor_index(log, self.sensors),
            time_ns=time_ns,
            ring=ring,
            return_type=points["return_type"],
            lidar_id=lidar_id,
            fill=head.fill(),
        )


def _head(data: bytes) -> _Head:
    end = data.find(_END, 0, _LONGEST_HEAD)
    text = data[: max(end, 0)].decode("utf-8", "replace")
    if not text.startswith(_HEAD):
        raise DamageError("the header of a binary PLY file of mlbatch", repr(text[:60]))
    comments: dict[str, str] = {}
    properties: dict[str, str] = {}
    vertices = -1
    for line in text.splitlines()[2:]:
        words = line.split(" ", 2)
        count = _VERTICES.fullmatch(line)
        if words[0] == "comment" and len(words) == 3:
            comments[words[1].rstrip(":")] = words[2]
        elif count is not None:
            vertices = int(count[1])
        elif words[0] == "property" and len(words) == 3:
            properties[words[2]] = words[1]
        else:
            raise DamageError("a line of a PLY header of mlbatch", repr(line))
    if vertices < 0 or list(properties.items()) != list(_PROPERTIES.items()):
        found = ", ".join(f"{kind} {name}" for name, kind in properties.items())
        raise DamageError("the properties of docs/formats.md", found or "none")
    return _Head(comments, vertices, end + len(_END))
