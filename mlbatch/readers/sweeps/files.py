"""Files of one sweep, as PointCloud2 messages: points of a numpy dtype, or PCD.

PCD: PCL, "The PCD (Point Cloud Data) file format", version 0.7. PointField:
docs/sources/messages.md section 8.
"""

from __future__ import annotations

import errno
import io
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.bounded import read_bytes
from mlbatch.rig.rig import Sweeps
from mlbatch.units import NS_PER_S

_PCD_HEADS = (b"# .PCD", b"VERSION", b"#.PCD", b"FIELDS")
_PCD_KEYS = (b"FIELDS", b"SIZE", b"TYPE", b"WIDTH", b"HEIGHT", b"POINTS", b"DATA")
_PCD_KINDS = {"F": "f", "U": "u", "I": "i"}
_MOST_HEAD_BYTES = 1 << 16
_SIZE = re.compile(r"[1-9]\d{0,4}", re.ASCII)
_DIGITS = re.compile(r"\d{1,12}", re.ASCII)
# sensor_msgs/PointField: number of a datatype.
_NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
# Whole numbers of 64 bits, as times since 1970; a PointField has none, so they become float64.
_WIDE = ("i8", "u8")
MOST_BYTES = 1 << 28


class SweepError(Exception):
    """A file that cannot be read as a sweep: file, expected, found, remedy."""


@dataclass(frozen=True, slots=True)
class _Points:
    """Points of a file; fields: name, type and offset of those that a cloud can have."""

    fields: tuple[tuple[str, str, int], ...]
    step: int
    data: bytes


def read_sweep(path: Path, sweeps: Sweeps, stamp_ns: int) -> bytes:
    """Return a PointCloud2 in ROS 1 serialisation with the points of a file."""
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
    is_pcd = data.startswith(_PCD_HEADS)
    if is_pcd and sweeps.fields:
        raise SweepError(
            f"{path}: expected points of the dtype, found a PCD file; remove `dtype`, as PCD "
            "states its fields"
        )
    if not is_pcd and not sweeps.fields:
        raise SweepError(
            f"{path}: expected a PCD file, found one that begins with {data[:8].hex(' ')}; give "
            "the fields as `dtype`, or correct `glob`"
        )
    points = _pcd(path, data) if is_pcd else _raw(path, data, sweeps)
    return _message(points, stamp_ns)


def _raw(path: Path, data: bytes, sweeps: Sweeps) -> _Points:
    fields, step = _offsets(sweeps.fields)
    if len(data) % step:
        raise SweepError(
            f"{path}: expected a multiple of {step} bytes, the size of a point of the dtype, found "
            f"{len(data)}; correct `dtype`, or copy the file again"
        )
    return _Points(fields, step, data)


def _offsets(
    fields: Sequence[tuple[str, str]],
) -> tuple[tuple[tuple[str, str, int], ...], int]:
    """Fields without padding, with their offsets; and the size of a point."""
    found = []
    offset = 0
    for name, kind in fields:
        if kind in _NUMBERS:
            found.append((name, kind, offset))
        # The bytes of a type are its last digits: f4, V12.
        offset += int(kind[1:])
    return tuple(found), offset


# -- PCD ------------------------------------------------------------------------------------------


def _pcd(path: Path, data: bytes) -> _Points:
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
        single = text in (*_NUMBERS, *_WIDE) and repeated == "1" and name != "_"
        fields.append((name, text if single else f"V{int(size) * int(repeated)}"))
    count = _count(path, head)
    found, step = _offsets([(name, "f8" if kind in _WIDE else kind) for name, kind in fields])
    kind = head["DATA"].split()[0] if head["DATA"].split() else ""
    if kind == "ascii":
        return _Points(found, step, _as_floats(_ascii(path, body, fields, count), fields))
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
    return _Points(found, step, _as_floats(body[: step * count], fields))


def _as_floats(data: bytes, fields: Sequence[tuple[str, str]]) -> bytes:
    """Points with the whole numbers of 64 bits as float64, where they are."""
    if not any(kind in _WIDE for _, kind in fields):
        return data
    before, after = (
        np.dtype(
            [(f"{at}", f"<{kind}" if kind[0] != "V" else kind) for at, kind in enumerate(kinds)]
        )
        for kinds in (
            [kind for _, kind in fields],
            ["f8" if kind in _WIDE else kind for _, kind in fields],
        )
    )
    return np.frombuffer(data, before).astype(after).tobytes()


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


def _ascii(path: Path, body: bytes, fields: Sequence[tuple[str, str]], count: int) -> bytes:
    """The numbers of a file of text, as bytes of the fields."""
    if any(kind.startswith("V") for _, kind in fields):
        raise SweepError(
            f"{path}: expected fields of one number in DATA ascii, found others; convert it with "
            "PCL: pcl_convert_pcd_ascii_binary IN OUT 1"
        )
    layout = np.dtype([(f"{name}_{at}", f"<{kind}") for at, (name, kind) in enumerate(fields)])
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
    return rows.tobytes()


# -- message --------------------------------------------------------------------------------------


def _message(points: _Points, stamp_ns: int) -> bytes:
    """A sensor_msgs/PointCloud2 in ROS 1 serialisation, without a frame_id."""
    count = len(points.data) // points.step
    seconds, rest = divmod(stamp_ns, NS_PER_S)
    head = struct.pack("<IIII", 0, seconds, rest, 0)
    head += struct.pack("<III", 1, count, len(points.fields))
    for name, kind, offset in points.fields:
        text = name.encode()
        head += struct.pack("<I", len(text)) + text
        head += struct.pack("<IBI", offset, _NUMBERS[kind], 1)
    head += struct.pack("<BIII", 0, points.step, len(points.data), len(points.data))
    return b"".join((head, points.data, b"\1"))
