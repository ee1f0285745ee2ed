"""Files of one sweep, as PointCloud2 messages: points of a numpy dtype, numpy arrays, or PCD.

PCD: PCL, "The PCD (Point Cloud Data) file format", version 0.7. PointField:
docs/sources/messages.md section 8.
"""

from __future__ import annotations

import errno
import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.bounded import read_bytes
from mlbatch.rig.rig import Sweeps
from mlbatch.ros.encoding import Wire
from mlbatch.ros.point_rows import FIELD_NUMBERS
from mlbatch.ros.point_times import TIME_NAMES, PointRule

_PCD_HEADS = (b"# .PCD", b"VERSION", b"#.PCD", b"FIELDS")
_PCD_KEYS = (b"FIELDS", b"SIZE", b"TYPE", b"WIDTH", b"HEIGHT", b"POINTS", b"DATA")
_PCD_KINDS = {"F": "f", "U": "u", "I": "i"}
_MOST_HEAD_BYTES = 1 << 16
_SIZE = re.compile(r"[1-9]\d{0,4}", re.ASCII)
_DIGITS = re.compile(r"\d{1,12}", re.ASCII)
# Whole numbers of 64 bits, as times since 1970; a PointField has none, so they become float64.
_WIDE = ("i8", "u8")
_NPY_HEAD = b"\x93NUMPY"
_ZIP_HEAD = b"PK\x03\x04"
MOST_BYTES = 1 << 28


class SweepError(Exception):
    """A file that cannot be read as a sweep: file, expected, found, remedy."""


_Array = npt.NDArray[Any]
# A number for each point, by field.
_Columns = Mapping[str, _Array]


def read_sweep(path: Path, sweeps: Sweeps, stamp_ns: int) -> bytes:
    """Return a PointCloud2 in ROS 1 serialisation with the points of a file."""
    columns = _columns(path, sweeps)
    fields = {name: _kind(column) for name, column in columns.items()}
    sizes = {len(column) for column in columns.values()}
    if not all(fields.values()) or len(sizes) != 1:
        shown = ", ".join(f"{name} {_shown(column)}" for name, column in columns.items())
        raise SweepError(
            f"{path}: expected one number for each point in each field, found {shown or 'none'}; "
            "correct the description, or leave a field out"
        )
    rows = np.zeros(sizes.pop(), [(name, f"<{kind}") for name, kind in fields.items()])
    for name, column in columns.items():
        rows[name] = column
    return _message(rows, stamp_ns)


def first_ns(path: Path, sweeps: Sweeps, rule: PointRule) -> int:
    """The earliest time of points, which count from 1970 in the unit of the rule; 0: not known."""
    needed = tuple(pair for pair in sweeps.arrays if pair[0] == rule.time)
    try:
        columns = _columns(path, sweeps._replace(arrays=needed or sweeps.arrays))
    except SweepError:
        return 0
    times = [columns[name] for name in (rule.time, *TIME_NAMES) if name in columns]
    if not times or not len(times[0]):
        return 0
    first: float = times[0].min().item()
    # In two parts: a float64 of ns since 1970 has a step of 256.
    return int(first // 1) * rule.unit_ns + round(first % 1 * rule.unit_ns)


def _columns(path: Path, sweeps: Sweeps) -> _Columns:
    """The points of a file in any of the formats."""
    try:
        data = read_bytes(path, MOST_BYTES)
    except OSError as err:
        if err.errno == errno.EFBIG:
            raise SweepError(
                f"{path}: expected at most {MOST_BYTES} bytes, found {path.stat().st_size}; check "
                "that it is one sweep"
            ) from err
        raise SweepError(
            f"{path}: expected a readable file, found {(err.strerror or str(err)).lower()}; check "
            "the path"
        ) from err
    if not data:
        raise SweepError(f"{path}: expected points, found 0 bytes; remove it or copy it again")
    if data.startswith((_NPY_HEAD, _ZIP_HEAD)):
        return _of_arrays(path, data, sweeps)
    is_pcd = data.startswith(_PCD_HEADS)
    if is_pcd and (sweeps.fields or sweeps.arrays):
        raise SweepError(
            f"{path}: expected points of the dtype, found a PCD file; remove `dtype` and `arrays`, "
            "as PCD states its fields"
        )
    if not is_pcd and not sweeps.fields:
        raise SweepError(
            f"{path}: expected a PCD file, found one that begins with {data[:8].hex(' ')}; give "
            "the fields as `dtype`, or correct `glob`"
        )
    return _pcd(path, data) if is_pcd else _raw(path, data, sweeps)


def _raw(path: Path, data: bytes, sweeps: Sweeps) -> _Columns:
    layout = _layout(sweeps.fields)
    if len(data) % layout.itemsize:
        raise SweepError(
            f"{path}: expected a multiple of {layout.itemsize} bytes, the size of a point of the "
            f"dtype, found {len(data)}; correct `dtype`, or copy the file again"
        )
    return _named(sweeps.fields, np.frombuffer(data, layout))


def _layout(fields: Sequence[tuple[str, str]]) -> np.dtype[Any]:
    """Fields one after another, named by their numbers."""
    return np.dtype(
        [(str(at), kind if kind[0] == "V" else f"<{kind}") for at, (_, kind) in enumerate(fields)]
    )


def _named(fields: Sequence[tuple[str, str]], rows: _Array) -> _Columns:
    """The fields that a cloud can have."""
    return {name: rows[str(at)] for at, (name, kind) in enumerate(fields) if kind[0] != "V"}


# -- numpy arrays ---------------------------------------------------------------------------------


def _of_arrays(path: Path, data: bytes, sweeps: Sweeps) -> _Columns:
    """An array for each field of the points of a .npy or .npz file."""
    arrays = _arrays(path, data, [name for _, name in sweeps.arrays])
    if "" not in arrays:
        named = dict(sweeps.arrays) or {name: name for name in arrays}
        return {field: _column(path, arrays, name) for field, name in named.items()}
    array = arrays[""]
    if array.dtype.names and not sweeps.fields:
        return {name: array[name] for name in array.dtype.names}
    kinds = [kind for _, kind in sweeps.fields]
    if array.ndim != 2 or any(
        array.dtype.newbyteorder("<") != kind for kind in kinds if kind[0] != "V"
    ):
        kinds = []
    if not kinds or len(kinds) != array.shape[1]:
        given = "none" if not sweeps.fields else f"{len(sweeps.fields)} fields in the rig"
        raise SweepError(
            f"{path}: expected an array with named fields and no `dtype`, or of n rows of one type "
            f"and its columns as `dtype`, found {_shown(array)} and {given}; correct `dtype`"
        )
    return {name: array[:, at] for at, (name, kind) in enumerate(sweeps.fields) if kind[0] != "V"}


def _arrays(path: Path, data: bytes, names: Sequence[str]) -> Mapping[str, _Array]:
    """Arrays of a .npz file by name, or that of a .npy file as ""; pickles are not read.

    names: those that are needed, or columns of them; none: all.
    """
    needed = {*names, *(name.rpartition(".")[0] for name in names)}
    try:
        if data.startswith(_NPY_HEAD):
            return {"": np.load(io.BytesIO(data), allow_pickle=False)}
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MOST_BYTES:
            raise ValueError(f"{size} bytes of arrays, more than {MOST_BYTES}")
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            # Shown in an error where none of them is there.
            return {name: file[name] for name in needed & {*file} or file}
    except Exception as err:
        # Damaged headers and archives end in errors of many kinds.
        reason = (str(err).splitlines() or [type(err).__name__])[0]
        raise SweepError(
            f"{path}: expected arrays of numbers, found others ({reason}); copy the file again"
        ) from err


def _column(path: Path, arrays: Mapping[str, _Array], name: str) -> _Array:
    """An array with one number for each point, or a column of one with several: points.0."""
    table, _, column = name.rpartition(".")
    array = arrays.get(name)
    if array is None and _DIGITS.fullmatch(column) and table in arrays:
        rows = arrays[table]
        array = rows[:, int(column)] if rows.ndim == 2 and int(column) < rows.shape[1] else rows
    if array is None or array.ndim != 1:
        known = ", ".join(f"{key} {_shown(one)}" for key, one in arrays.items())
        raise SweepError(
            f"{path}: expected one number for each point as array {name}, found {known}; give the "
            "arrays of the fields in the rig (points: {arrays: {x: points.0, y: points.1}})"
        )
    return array


def _kind(column: _Array) -> str:
    """Type of a PointField that holds the numbers of an array; "" for others."""
    kind, size = column.dtype.kind, column.dtype.itemsize
    if column.ndim != 1 or kind not in "iufb":
        return ""
    text = {"b": "u1", "f": "f4" if size <= 4 else "f8"}.get(kind, f"{kind}{size}")
    return "f8" if text in _WIDE else text


def _shown(array: _Array) -> str:
    return f"({', '.join(map(str, array.shape))}) {array.dtype}"


# -- PCD ------------------------------------------------------------------------------------------


def _pcd(path: Path, data: bytes) -> _Columns:
    head, body = _pcd_head(path, data)
    fields: list[tuple[str, str]] = []
    names = head["FIELDS"].split()
    sizes = head["SIZE"].split()
    kinds = head["TYPE"].split()
    counts = head.get("COUNT", " ".join("1" for _ in names)).split()
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise SweepError(
            f"{path}: expected a SIZE, TYPE and COUNT for each of {len(names)} FIELDS, found "
            f"{len(sizes)}, {len(kinds)} and {len(counts)}; the file is damaged"
        )
    for name, size, kind, repeated in zip(names, sizes, kinds, counts, strict=True):
        if not (_SIZE.fullmatch(size) and _SIZE.fullmatch(repeated)):
            raise SweepError(
                f"{path}: expected whole numbers as SIZE and COUNT, found {size} and {repeated}; "
                "the file is damaged"
            )
        text = f"{_PCD_KINDS.get(kind, '?')}{size}"
        single = text in (*FIELD_NUMBERS, *_WIDE) and repeated == "1" and name != "_"
        fields.append((name, text if single else f"V{int(size) * int(repeated)}"))
    count = _count(path, head)
    step = sum(int(kind[1:]) for _, kind in fields)
    kind = head["DATA"].split()[0] if head["DATA"].split() else ""
    if kind == "ascii":
        return _named(fields, _ascii(path, body, fields, count))
    if kind != "binary":
        raise SweepError(
            f"{path}: expected DATA binary or ascii, found {kind!r}; convert it with PCL: "
            "pcl_convert_pcd_ascii_binary IN OUT 1"
        )
    if len(body) < step * count:
        raise SweepError(
            f"{path}: expected {count} points of {step} bytes, found {len(body)} bytes of data; "
            "copy the file again"
        )
    return _named(fields, np.frombuffer(body[: step * count], _layout(fields)))


def _pcd_head(path: Path, data: bytes) -> tuple[dict[str, str], bytes]:
    """The lines of the header, and the bytes behind them."""
    head: dict[str, str] = {}
    at = 0
    while "DATA" not in head:
        end = data.find(b"\n", at, _MOST_HEAD_BYTES)
        if end < 0:
            break
        line = data[at:end].decode("ascii", "replace").strip()
        at = end + 1
        if line and not line.startswith("#"):
            key, _, value = line.partition(" ")
            head[key] = value
    lacking = [key.decode() for key in _PCD_KEYS if key.decode() not in head]
    if lacking:
        raise SweepError(
            f"{path}: expected a PCD header with {', '.join(lacking)}, found none; the file is "
            "damaged"
        )
    return head, data[at:]


def _count(path: Path, head: dict[str, str]) -> int:
    values = [head[key].strip() for key in ("WIDTH", "HEIGHT", "POINTS")]
    is_known = all(_DIGITS.fullmatch(value) for value in values)
    if not is_known or int(values[0]) * int(values[1]) != int(values[2]):
        raise SweepError(
            f"{path}: expected POINTS = WIDTH x HEIGHT, found {values[2]} and {values[0]} x "
            f"{values[1]}; the file is damaged"
        )
    return int(values[2])


def _ascii(path: Path, body: bytes, fields: Sequence[tuple[str, str]], count: int) -> _Array:
    """The numbers of a file of text."""
    if any(kind.startswith("V") for _, kind in fields):
        raise SweepError(
            f"{path}: expected fields of one number in DATA ascii, found others; convert it with "
            "PCL: pcl_convert_pcd_ascii_binary IN OUT 1"
        )
    layout = _layout(fields)
    rows = np.zeros(0, layout)
    try:
        if body.strip():
            rows = np.loadtxt(io.BytesIO(body), dtype=layout, ndmin=1)
    except ValueError as err:
        reason = str(err).splitlines()[0]
        raise SweepError(
            f"{path}: expected numbers of the fields, found others ({reason}); the file is damaged"
        ) from err
    if len(rows) != count:
        raise SweepError(f"{path}: expected {count} lines, found {len(rows)}; copy the file again")
    return rows


# -- message --------------------------------------------------------------------------------------


def _message(rows: _Array, stamp_ns: int) -> bytes:
    """A sensor_msgs/PointCloud2 in ROS 1 serialisation, without a frame_id."""
    fields: Mapping[str, Any] = rows.dtype.fields or {}
    wire = Wire("ros1")
    wire.header(stamp_ns, "")
    wire.put("I", 1, len(rows), len(fields))
    for name, (kind, offset, *_) in fields.items():
        wire.text(name)
        wire.put("I", offset)
        wire.put("B", FIELD_NUMBERS[f"{kind.kind}{kind.itemsize}"])
        wire.put("I", 1)
    wire.put("B", False)
    wire.put("I", rows.dtype.itemsize, rows.nbytes, rows.nbytes)
    return b"".join((wire.data, rows.tobytes(), b"\1"))
