"""Folders of LAS and LAZ files, read by laspy: points and times, but no columns.

The format: docs/formats.md; ASPRS, "LAS specification 1.4 R15".
"""

from __future__ import annotations

import importlib
import struct
from io import BytesIO
from types import ModuleType
from typing import Any

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.errors import install_extra
from mlbatch.outputs.commented import CommentedReader, Fields, ScanComments
from mlbatch.outputs.containers import check_unpacked_size, library_errors
from mlbatch.outputs.damage import DamageError, VerifyError

LAS_SUFFIX = ".las"
LAZ_SUFFIX = ".laz"
# Table 3: signature; size of the header, offset of the points, number of records, format and bytes
# of a point; wave data, number of extended records; number of points.
_HEAD = struct.Struct("<4s90xHIIBH120xQ8xIQ")
_HEAD_BYTES = 375
_MOST_RECORDS = 16
# Flag of the point format, set by LASzip.
_COMPRESSED = 0x80
_POINT_FORMAT = 6
_SCALE_M = 1e-4
_EXTRA_BYTES = {
    "time_ns": "<u4",
    "ring": "<u2",
    "return_type": "|u1",
    "intensity_f32": "<f4",
}
_REFLECTIVITY = {"reflectivity": "<u2"}
_USER = "mlbatch"
_NUMBER = 1
_NS = 10**9
_MOST_INTENSITY = 65535
# Return number and number of returns by return type.
_RETURNS = np.array(
    [(1, 1), (1, 1), (1, 1), (1, 2), (2, 2), (1, 2), (2, 2), (1, 1)], dtype=np.int64
)
# GPS time counts from 1980-01-06; adjusted, 10^9 s less. UTC is 18 s behind it from 2017 on.
_GPS_EPOCH_S = 315_964_800 + 10**9
_GPS_TAI_S = -19
_GPS_UTC_S = 18
_UTC_S_SINCE = 1_483_228_800
# A float64 of seconds resolves 0.24 us since 1970.
_TIME_ERROR_S = 5e-7


def _laspy() -> ModuleType:
    """laspy; VerifyError without it."""
    try:
        importlib.import_module("lazrs")
        return importlib.import_module("laspy")
    except ImportError as err:
        raise VerifyError(
            "LAS files: expected the packages laspy and lazrs to read LAS and LAZ, found none "
            f"({err}); {install_extra('las')}"
        ) from err


def _check_head(data: bytes) -> None:
    """Check numbers of the header that laspy and lazrs allocate for; DamageError for others."""
    if len(data) < _HEAD.size:
        raise DamageError(f"a header of {_HEAD.size} bytes", f"{len(data)} bytes")
    signature, size, begin, records, kind, step, waves, extended, count = _HEAD.unpack_from(data)
    found = (signature, size, waves, extended, kind & ~_COMPRESSED)
    expected = (b"LASF", _HEAD_BYTES, 0, 0, _POINT_FORMAT)
    if found != expected or records > _MOST_RECORDS or begin > len(data):
        raise DamageError("the header of a LAS file of mlbatch", f"{found}, {records} records")
    check_unpacked_size(count * step, len(data))
    if kind & _COMPRESSED:
        _check_chunks(data, begin)
    elif len(data) != begin + count * step:
        raise DamageError(f"{count} points of {step} bytes", f"{len(data) - begin} bytes")


def _check_chunks(data: bytes, begin: int) -> None:
    """Check the number of chunks; LASzip: points begin with the offset of the table of chunks."""
    if begin + 8 > len(data):
        raise DamageError("the offset of a table of chunks", "the end of the file")
    table = int.from_bytes(data[begin : begin + 8], "little", signed=True)
    if not begin < table <= len(data) - 8:
        raise DamageError("a table of chunks in the file", f"one at byte {table}")
    chunks = int.from_bytes(data[table + 4 : table + 8], "little")
    if chunks > len(data):
        raise DamageError(f"at most {len(data)} chunks", str(chunks))


def _parsed(data: bytes) -> tuple[ScanComments, Any, bool]:
    """Comments, points by name as in docs/formats.md, and whether there are reflectivities.

    DamageError for another file.
    """
    laspy = _laspy()
    with library_errors("a LAS or LAZ file"):
        _check_head(data)
        found = _read(laspy, data)
        header = found.header
        # Points that are missing at the end are read as fewer.
        if len(found.points) != header.point_count:
            raise DamageError(f"{header.point_count} points", str(len(found.points)))
        texts = [
            bytes(vlr.record_data)
            for vlr in header.vlrs
            if (vlr.user_id, vlr.record_id) == (_USER, _NUMBER)
        ]
        if len(texts) != 1:
            raise DamageError(f"one record of {_USER}", str(len(texts)))
        extra = {one.name: np.dtype(one.dtype).str for one in header.point_format.extra_dimensions}
        if extra not in (_EXTRA_BYTES, _EXTRA_BYTES | _REFLECTIVITY):
            raise DamageError("the extra bytes of docs/formats.md", ", ".join(extra) or "none")
        if header.point_format.id != _POINT_FORMAT or set(header.scales.tolist()) != {_SCALE_M}:
            expected = f"point format {_POINT_FORMAT} in steps of {_SCALE_M} m"
            raise DamageError(expected, f"{header.point_format.id}, {header.scales.tolist()}")
        lines = texts[0].decode("utf-8", "replace").splitlines()
        return ScanComments.of_lines(lines), found.points, "reflectivity" in extra


def _read(laspy: ModuleType, data: bytes) -> Any:
    """The file as laspy has it; laspy has no types."""
    try:
        return laspy.read(BytesIO(data))
    except BaseException as err:
        # lazrs raises its own BaseException on damaged chunks.
        if type(err).__name__ == "PanicException":
            raise DamageError("compressed points", str(err)) from err
        raise


class LasReader(CommentedReader):
    """Reads the files of one folder."""

    __slots__ = ()

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and points of a file, checked against each other."""
        comments, points, has_reflectivity = _parsed(data)
        time_ns: I64Array = np.asarray(points["time_ns"]).astype(np.int64)
        self._check_times(comments, points, time_ns)
        self._check_fields(comments, points)
        axes = [np.asarray(points[name]) * _SCALE_M for name in "XYZ"]
        source = np.asarray(points["point_source_id"]).astype(np.int64)
        names = ["ring", "return_type", *["reflectivity"] * has_reflectivity]
        return comments, {
            "xyz": np.stack(axes, axis=-1).astype(np.float32),
            "time_ns": time_ns,
            "lidar_id": np.clip(source - 1, 0, 255).astype(np.uint8),
            "intensity": np.asarray(points["intensity_f32"]),
            **{name: np.asarray(points[name]) for name in names},
        }

    def _check_times(self, comments: ScanComments, points: Any, time_ns: I64Array) -> None:
        """`gps_time` is the time of the clock as GPS time; of UTC before 2017 it is unchecked."""
        timescale = comments.by_name.get("timescale")
        start_ns = comments.number("start_ns")
        shift_s = 0
        if timescale == "tai":
            shift_s = _GPS_TAI_S - _GPS_EPOCH_S
        elif timescale == "utc":
            if start_ns < _UTC_S_SINCE * _NS:
                return
            shift_s = _GPS_UTC_S - _GPS_EPOCH_S
        whole_s, rest_ns = divmod(start_ns + shift_s * _NS, _NS)
        expected: F64Array = (time_ns + rest_ns) / _NS + whole_s
        gps_s: F64Array = np.asarray(points["gps_time"])
        bad: BoolArray = np.logical_not(np.abs(gps_s - expected) < _TIME_ERROR_S)
        where = f"scan {comments.by_name.get('index')} gps_time of point"
        self.log.none("times", where, bad, "start_ns + time_ns as GPS time", gps_s.item)

    def _check_fields(self, comments: ScanComments, points: Any) -> None:
        """Standard fields have the values of the extra bytes."""
        where = f"scan {comments.by_name.get('index')}"
        kind = np.minimum(np.asarray(points["return_type"]), len(_RETURNS) - 1)
        for axis, name in enumerate(("return_number", "number_of_returns")):
            found: I64Array = np.asarray(points[name]).astype(np.int64)
            bad: BoolArray = found != _RETURNS[kind, axis]
            self.log.none("returns", f"{where} {name} of point", bad, "by return_type", found.item)
        exact: F64Array = np.clip(
            np.rint(np.nan_to_num(np.asarray(points["intensity_f32"]))), 0, _MOST_INTENSITY
        )
        intensity: I64Array = np.asarray(points["intensity"]).astype(np.int64)
        different: BoolArray = intensity != exact
        self.log.none(
            "layout", f"{where} intensity of point", different, "intensity_f32", intensity.item
        )
        source: I64Array = np.asarray(points["point_source_id"]).astype(np.int64)
        none: BoolArray = (source < 1) | (source > 256)
        self.log.none("sensors", f"{where} point_source_id of point", none, "1 to 256", source.item)
