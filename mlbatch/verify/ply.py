"""A folder of PLY files (docs/formats.md): points and times, but no columns.

The format: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.verify.claims import Claims
from mlbatch.verify.folders import ScanFile, check_name
from mlbatch.verify.scan import HeldScan
from mlbatch.verify.verdict import DamageError, Judge

SUFFIX = ".ply"
_TYPES = {"float": "<f4", "double": "<f8", "int": "<i4", "uchar": "u1"}
_PROPERTIES = {
    **dict.fromkeys(("x", "y", "z", "intensity"), "float"),
    "time": "double",
    "ring": "int",
    "return_type": "uchar",
    "lidar_id": "uchar",
}
_VERTEX = np.dtype([(name, _TYPES[kind]) for name, kind in _PROPERTIES.items()])
_PLACE = np.dtype(
    {"names": ["xyz"], "formats": [("<f4", 3)], "offsets": [0], "itemsize": _VERTEX.itemsize}
)
_HEAD = "ply\nformat binary_little_endian 1.0\ncomment mlbatch "
_END = b"end_header\n"
_LONGEST_HEAD = 1 << 20
# Numbers of up to 19 digits: Python refuses to read very long ones.
_INDEX = re.compile(r"(-?\d{1,19}) slice (\d{1,19}) of (\d{1,19})", re.ASCII)
_VERTICES = re.compile(r"element vertex (\d{1,19})", re.ASCII)
_NS = 1e9

LIMITS = {
    "columns": "first and last column of a scan, by scans.csv; PLY has no column stamps",
    "order": "points step back by less than a column's duration; PLY has no columns",
    "geometry": "PLY has no ranges",
    "duplicates": "PLY has no columns",
    "tf_static": "PLY has no transforms",
    "imu": "PLY has no place for IMU samples",
    "messages": "PLY has no place for messages",
    "stamps": "PLY has no log times",
}


@dataclass(frozen=True, slots=True)
class _Head:
    """What the comments say, by their first word, and how many vertices follow at `begin`."""

    notes: dict[str, str]
    vertices: int
    begin: int

    def number(self, name: str) -> int:
        """A comment that is a number."""
        try:
            return int(self.notes[name])
        except (KeyError, ValueError):
            got = self.notes.get(name, "none")
            raise DamageError(f"comment {name} with a number", got) from None

    def place(self) -> tuple[int, int, int]:
        """Index, slice and slices."""
        found = _INDEX.fullmatch(self.notes.get("index", ""))
        if found is None:
            raise DamageError("comment index I slice J of N", self.notes.get("index", "none"))
        index, part, slices = map(int, found.groups())
        return index, part, slices


@dataclass(slots=True)
class PlyReader:
    """Reads files of one folder; what their headers say of the run is the same in all."""

    judge: Judge
    sensors: tuple[str, ...] = ()
    _first: str = ""
    _claims: Claims = field(default_factory=Claims)

    def begin(self, file: ScanFile) -> Claims:
        """What the first scan says of the run."""
        head = _head(_read(file))
        self._first, self._claims = file.where, _claims(head)
        self.sensors = self._claims.sensors or ()
        return self._claims

    def scans(self, files: list[ScanFile]) -> Iterator[HeldScan]:
        """Every scan that can be read; what cannot is blamed."""
        for file in files:
            try:
                scan = self._scan(file)
            except DamageError as err:
                self.judge.blame("container", file.where, err.wanted, err.got)
                continue
            self.judge.passed("container")
            yield scan

    def _scan(self, file: ScanFile) -> HeldScan:
        data = _read(file)
        head = _head(data)
        self.judge.passed("layout")
        self._claims.joined(self.judge, file.where, _claims(head))
        if len(data) != head.begin + head.vertices * _VERTEX.itemsize:
            wanted = f"{head.vertices} vertices of {_VERTEX.itemsize} bytes"
            raise DamageError(wanted, f"{len(data) - head.begin} bytes after the header")
        points = np.frombuffer(data, _VERTEX, head.vertices, head.begin)
        xyz: F32Array = np.frombuffer(data, _PLACE, head.vertices, head.begin)["xyz"]
        time_s: F64Array = points["time"]
        if not np.isfinite(time_s).all():
            at = int((~np.isfinite(time_s)).argmax())
            self.judge.blame("times", f"{file.where} point {at}", "a number", time_s[at])
            time_s = np.nan_to_num(time_s)
        time_ns: I64Array = np.rint(np.clip(time_s, -4e9, 4e9) * _NS).astype(np.int64)
        ring: I64Array = points["ring"].astype(np.int64)
        strange = (ring < 0) | (ring > 65535)
        self.judge.none("rings", f"{file.where} point", strange, "a ring of two bytes", ring.item)
        index, part, slices = head.place()
        complete = head.notes.get("complete")
        if complete not in ("true", "false"):
            raise DamageError("comment complete true or false", str(complete))
        check_name(self.judge, file, index, part, slices)
        return HeldScan(
            where=file.where,
            start_ns=head.number("start_ns"),
            end_ns=head.number("end_ns"),
            index=index,
            slice=part,
            complete=complete == "true",
            xyz=xyz,
            organized=False,
            sensor=self._sensor(file),
            time_ns=time_ns,
            ring=ring,
            return_type=points["return_type"],
            lidar_id=_bytes(points["lidar_id"]),
        )

    def _sensor(self, file: ScanFile) -> int | None:
        if file.sensor is None:
            return None
        if file.sensor in self.sensors:
            return self.sensors.index(file.sensor)
        wanted = f"the folder of one of {', '.join(self.sensors)}"
        self.judge.blame("names", file.where, wanted, file.sensor)
        return None


def _bytes(values: U8Array) -> U8Array:
    return np.ascontiguousarray(values)


def _read(file: ScanFile) -> bytes:
    try:
        return file.path.read_bytes()
    except OSError as err:
        raise DamageError("a file that can be read", str(err.strerror)) from err


def _head(data: bytes) -> _Head:
    end = data.find(_END, 0, _LONGEST_HEAD)
    text = data[: max(end, 0)].decode("utf-8", "replace")
    if not text.startswith(_HEAD):
        raise DamageError("the header of a binary PLY file of mlbatch", repr(text[:60]))
    notes: dict[str, str] = {}
    vertices, properties = -1, {}
    for line in text.splitlines()[2:]:
        words = line.split(" ", 2)
        if words[0] == "comment" and len(words) == 3:
            notes[words[1].rstrip(":")] = words[2]
        elif (count := _VERTICES.fullmatch(line)) is not None:
            vertices = int(count[1])
        elif words[0] == "property" and len(words) == 3:
            properties[words[2]] = words[1]
        else:
            raise DamageError("a line of a PLY header of mlbatch", repr(line))
    if vertices < 0 or list(properties.items()) != list(_PROPERTIES.items()):
        got = ", ".join(f"{kind} {name}" for name, kind in properties.items())
        raise DamageError("the properties of docs/formats.md", got or "none")
    return _Head(notes, vertices, end + len(_END))


def _claims(head: _Head) -> Claims:
    _, _, slices = head.place()
    _, _, names = head.notes.get("lidar_id", "").partition("from 0: ")
    return Claims(
        head.notes.get("rate_hz"),
        slices,
        None,
        tuple(names.split(" ")) if names else None,
        head.notes.get("timescale"),
        head.notes.get("frame_id"),
    )
