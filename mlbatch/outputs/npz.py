"""Folders of npz files: every value of a scan is checkable.

`zipfile` reads the members and checks their checksums, `numpy` the headers of arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from typing import Any, cast
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32
from numpy.lib.format import read_array_header_1_0, read_magic

from mlbatch.arrays import I64Array
from mlbatch.outputs.containers import check_unpacked_size, library_errors
from mlbatch.outputs.damage import DamageError
from mlbatch.outputs.folders import ScanFile, ScanReader
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import POINT_ARRAYS, StoredScan
from mlbatch.types import VARIANTS

SUFFIX = ".npz"
SCHEMA = "mlbatch.scan/1"
_OPTIONAL = {"reflectivity": POINT_ARRAYS["reflectivity"]}
# Keys with a value, or three, for each point.
_POINTS = {"xyz": "<f4"} | {
    name: kind for name, kind in POINT_ARRAYS.items() if name not in _OPTIONAL
}
_DENSE = {"column": "<u4"}
_COLUMNS = {"column_stamp_ns": "<i8", "column_lidar_id": "|u1"}
_NUMBERS = {
    "start_ns": "<i8",
    "end_ns": "<i8",
    "index": "<i8",
    "slice": "<i8",
    "slices": "<i8",
    "complete": "|b1",
}
_BY_SENSOR = {"fill": "<f4"}
_TEXTS = ("sensors", "frame_id", "rate_hz", "timescale", "sort", "schema")
# The same in every scan of a run.
_CONSTANT = ("slices", *_TEXTS, *VARIANTS)

LIMITS = {
    "tf_static": "npz has no transforms",
    "imu": "npz has no IMU samples",
    "messages": "npz has no messages",
    "stamps": "npz has no log times",
}
ORGANIZED_LIMITS = {"order": "columns only: organized scans have no order within a column"}

Values = npt.NDArray[np.generic]


@dataclass(slots=True)
class NpzReader(ScanReader):
    """Reads the files of one folder; all of a run have the same keys and constants."""

    _first: str = ""
    _keys: dict[str | None, frozenset[str]] = field(default_factory=dict)
    # Bytes and values of the constants of the first scan.
    _constant: dict[str, bytes] = field(default_factory=dict)
    _values: dict[str, Values] = field(default_factory=dict)

    def begin(self, file: ScanFile) -> RunMetadata:
        """Metadata of the run in the first scan."""
        data = _members(file)
        self._first = file.where
        arrays = {key: _array(key, data[key]) for key in _CONSTANT if key in data}
        self._values = {key: one for key, one in arrays.items() if self._fits(file, key, one)}
        self._constant = {key: data[key] for key in self._values}
        xyz = data.get("xyz")
        self.organized = xyz is not None and _array("xyz", xyz).ndim == 3
        values = self._values
        texts = {
            key: str(values[key])
            for key in (*_TEXTS, *VARIANTS)
            if key in values and key != "sensors"
        }
        self.log.equal("layout", f"{file.where} schema", SCHEMA, texts.get("schema"))
        if "sensors" in values:
            self.sensors = tuple(map(str, values["sensors"].tolist()))
        slices = values.get("slices")
        number = None if slices is None else int(cast(I64Array, slices))
        return RunMetadata.of(self.log, file.where, texts, self.sensors or None, slices=number)

    def _fits(self, file: ScanFile, key: str, values: Values) -> bool:
        """Whether a constant has its type; a number of another type is a violation in each scan."""
        kind = values.dtype.str
        if key in _NUMBERS:
            return (kind, values.ndim) == (_NUMBERS[key], 0)
        expected = "texts" if key == "sensors" else "a text"
        fits = kind.startswith("<U") and values.ndim == (key == "sensors")
        found = expected if fits else f"{kind} of {values.ndim} axes"
        return self.log.equal("layout", f"{file.where} {key}", expected, found)

    def scan(self, file: ScanFile) -> StoredScan | None:
        """One scan, checked against the others."""
        data = _members(file)
        self._check_keys(file, data)
        values = {
            key: self._values[key] if self._constant.get(key) == raw else _array(key, raw)
            for key, raw in data.items()
        }
        types_fit = True
        for key, kind in self._kinds(data).items():
            if key in values and values[key].dtype.str != kind:
                self.log.fail("layout", f"{file.where} {key}", kind, values[key].dtype.str)
                types_fit = False
        if not types_fit or not self._check_shapes(file, values):
            return None
        return self._stored(file, values)

    def _check_keys(self, file: ScanFile, data: dict[str, bytes]) -> None:
        log = self.log
        log.ok("layout")
        keys = self._keys.setdefault(file.sensor, frozenset(data))
        if keys != data.keys():
            changed = ", ".join(sorted(keys ^ data.keys()))
            log.fail("layout", file.where, "the keys of the first scan", f"a difference: {changed}")
        for key, raw in self._constant.items():
            if key in data and data[key] != raw:
                found = _array(key, data[key])
                log.fail("metadata", f"{file.where} {key}", f"as in {self._first}", found)
        log.ok("metadata", len(self._constant))

    def _kinds(self, data: dict[str, bytes]) -> dict[str, str]:
        """Types by key; missing keys are damage."""
        required = _POINTS | ({} if self.organized else _DENSE)
        required |= _COLUMNS | _NUMBERS | _BY_SENSOR
        missing = [key for key in (*required, *_TEXTS) if key not in data]
        if missing:
            raise DamageError("all keys of a scan", f"no {', '.join(missing)}")
        return required | _OPTIONAL

    def _check_shapes(self, file: ScanFile, values: dict[str, Values]) -> bool:
        """Check that point arrays have one shape, column arrays another, and numbers none."""
        points = _POINTS | _OPTIONAL | ({} if self.organized else _DENSE)
        axes = 2 if self.organized else 1
        shape = values["time_ns"].shape
        columns = shape[:1] if self.organized else values["column_stamp_ns"].shape[:1]
        expected = {key: (*shape, 3) if key == "xyz" else shape for key in points}
        expected |= dict.fromkeys(_COLUMNS, columns)
        expected |= dict.fromkeys(_NUMBERS, ())
        expected["fill"] = (len(self.sensors) if file.sensor is None else 1,)
        fits = True
        for key, own in expected.items():
            if key in values and (values[key].shape != own or len(shape) != axes):
                self.log.fail("layout", f"{file.where} {key}", f"shape {own}", values[key].shape)
                fits = False
        return fits

    def _stored(self, file: ScanFile, values: dict[str, Values]) -> StoredScan:
        number: dict[str, Any] = {key: int(cast(I64Array, values[key])) for key in _NUMBERS}
        file.check_name(self.log, number["index"], number["slice"], number.pop("slices"))
        names = (*_POINTS, *_OPTIONAL, *_DENSE, *_COLUMNS, *_BY_SENSOR)
        arrays: dict[str, Any] = {name: values.get(name) for name in names}
        arrays["time_ns"] = arrays["time_ns"].astype(np.int64)
        return StoredScan(
            where=file.where,
            organized=self.organized,
            sensor=file.sensor_index(self.log, self.sensors),
            **number | {"complete": bool(number["complete"])},
            **arrays,
        )


def _members(file: ScanFile) -> dict[str, bytes]:
    """The bytes of each array by key."""
    data = file.read()
    found: dict[str, bytes] = {}
    with library_errors("a zip with whole members"), ZipFile(BytesIO(data)) as archive:
        members = archive.infolist()
        check_unpacked_size(sum(member.file_size for member in members), len(data))
        for member in members:
            if member.filename in found:
                raise DamageError(f"one member {member.filename}", "two")
            if member.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
                method = f"method {member.compress_type}"
                raise DamageError(f"member {member.filename} stored or deflated", method)
            # Unpacks no more than the declared size.
            with archive.open(member) as stream:
                content = _plain(data, member) or stream.read(member.file_size)
            if len(content) != member.file_size:
                expected = f"{member.file_size} bytes of member {member.filename}"
                raise DamageError(expected, str(len(content)))
            found[member.filename] = content
    return {name.removesuffix(".npy"): content for name, content in found.items()}


def _plain(data: bytes, member: ZipInfo) -> bytes:
    """The bytes of a member that is not compressed; none where they are damaged."""
    # PKWARE APPNOTE 4.3.7; `zipfile` has compared the name. Its CRC takes a third of a read.
    begin = member.header_offset + 30
    begin += sum(int.from_bytes(data[at : at + 2], "little") for at in (begin - 4, begin - 2))
    content = data[begin : begin + member.file_size]
    is_plain = member.compress_type == ZIP_STORED and crc32(content, 0) == member.CRC
    return content if is_plain else b""


def _array(key: str, data: bytes) -> Values:
    """The array in an npy of version 1.0."""
    with library_errors(f"{key} as an npy"):
        begin = 10 + int.from_bytes(data[8:10], "little")
        shape, dtype = _npy_header(data[:begin])
        count = math.prod(shape)
        if begin + count * dtype.itemsize != len(data):
            raise DamageError(f"{key}: {count} values of {dtype.str}", f"{len(data) - begin} bytes")
        values: Values = np.frombuffer(data, dtype, count, begin).reshape(shape)
    return values


@lru_cache(maxsize=256)
def _npy_header(head: bytes) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    """Shape and type in a header; the same ones are in every scan, and slow to parse."""
    stream = BytesIO(head)
    version = read_magic(stream)
    if version != (1, 0):
        raise DamageError("npy version 1.0", str(version))
    shape, is_fortran, dtype = read_array_header_1_0(stream)
    if is_fortran or dtype.hasobject:
        raise DamageError("numbers in C order", head[10:].decode("latin-1"))
    return shape, dtype
