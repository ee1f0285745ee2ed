"""A scan as an npz, one array per key (docs/formats.md).

An npz is an uncompressed zip (PKWARE APPNOTE 6.3, sections 4.3 and 4.4) of npy files, version 1.0
(NEP 1). `numpy.savez` would stamp files with the time of day and copy arrays; `zipfile` would write
each part on its own and go back for checksums. `zipfile` writes the same bytes; tests compare.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from isal.isal_zlib import crc32

from mlbatch.errors import ExportError
from mlbatch.types import RunInfo, Scan
from mlbatch.writers.output_file import Bytes

SCHEMA = "mlbatch.scan/1"

Array: TypeAlias = npt.NDArray[np.generic]

# Signature, version needed, flags, method, time, date, CRC, stored size, size, length of the name
# and of extra fields.
_LOCAL = struct.Struct("<4s5HIIIHH")
# Signature, version made by, and the same as above; length of a comment, disk, internal and
# external attributes, offset of the local header.
_CENTRAL = struct.Struct("<4s6HIII5HII")
# Signature, disks, entries here and in all, size and offset of the central directory, comment.
_END = struct.Struct("<4s4HIIH")
_VERSION = 20
_UNIX = 3
# 1 January 1980, the earliest date of a zip: files must not depend on when they were written.
_TIME = 0
_DATE = (1 << 5) + 1
# Readable and writable by the owner.
_ATTRIBUTES = 0o600 << 16
# Sizes and offsets of a zip are 32 bits wide.
_MAX_BYTES = (1 << 32) - 1


class NpzEncoder:
    """Encodes scans of one run; owns the buffers that make arrays contiguous."""

    def __init__(self, info: RunInfo, *, split: bool = False) -> None:
        """split: every scan is of one sensor."""
        self._split = split
        self._packed: dict[str, Array] = {}
        self._constant: dict[str, Array] = {
            "slices": np.array(info.slices, dtype=np.int64),
            "sensors": np.array([sensor.name for sensor in info.sensors], dtype=np.str_),
            "frame_id": np.array(info.frame_id, dtype=np.str_),
            "rate_hz": np.array(info.rate_hz, dtype=np.str_),
            "timescale": np.array(info.timescale, dtype=np.str_),
            "sort": np.array(info.sort, dtype=np.str_),
            "schema": np.array(SCHEMA, dtype=np.str_),
            **{name: np.array(value, dtype=np.str_) for name, value in info.variants},
        }

    def encode(self, scan: Scan) -> list[Bytes]:
        """Return the scan as a zip of npy files."""
        arrays = self._arrays(scan) | self._constant
        members = ((f"{key}.npy", self._npy(key, array)) for key, array in arrays.items())
        return stored_zip(members)

    def _arrays(self, scan: Scan) -> dict[str, Array]:
        """Return the arrays that change from scan to scan, in the order of the file."""
        arrays: dict[str, Array | None] = {
            "xyz": scan.xyz,
            "intensity": scan.intensity,
            "reflectivity": scan.reflectivity,
            "range_m": scan.range_m,
            "time_ns": scan.time_ns,
            "ring": scan.ring,
            "return_type": scan.return_type,
            "lidar_id": scan.lidar_id,
            "column": scan.column,
            "column_stamp_ns": scan.column_stamp_ns,
            "column_lidar_id": scan.column_lidar_id,
            "start_ns": np.array(scan.start_ns, dtype=np.int64),
            "end_ns": np.array(scan.end_ns, dtype=np.int64),
            "index": np.array(scan.index, dtype=np.int64),
            "slice": np.array(scan.slice, dtype=np.int64),
            "complete": np.array(scan.complete, dtype=np.bool_),
            "fill": scan.fill[scan.column_lidar_id[:1]] if self._split else scan.fill,
        }
        return {key: array for key, array in arrays.items() if array is not None}

    def _npy(self, key: str, array: Array) -> list[Bytes]:
        """Return the parts of an npy file."""
        array = self._contiguous(key, array)
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
        return [head.getvalue(), array.reshape(-1).view(np.uint8).data]

    def _contiguous(self, key: str, array: Array) -> Array:
        """Return the same values in contiguous memory; the buffer is reused by the next scan."""
        if array.flags.c_contiguous:
            return array
        buffer = self._packed.get(key)
        if buffer is None or buffer.size < array.size:
            buffer = self._packed[key] = np.empty(array.size * 5 // 4, array.dtype)
        packed = buffer[: array.size].reshape(array.shape)
        if key != "xyz":
            packed[...] = array
            return packed
        # Axis by axis, since copies with an innermost axis of three are slow.
        for axis in range(3):
            packed[..., axis] = array[..., axis]
        return packed


def stored_zip(members: Iterable[tuple[str, Sequence[Bytes]]]) -> list[Bytes]:
    """Return the parts of a zip with these names (ASCII) and contents."""
    parts: list[Bytes] = []
    central = b""
    offset = 0
    count = 0
    for name, content in members:
        size = sum(map(len, content))
        crc = 0
        for part in content:
            crc = crc32(part, crc)
        if offset + size > _MAX_BYTES:
            raise ExportError(
                f"{name}: expected a scan of at most 4 GiB for an npz, found more; write a .mcap, "
                "or cut scans by --slices"
            )
        same = (_VERSION, 0, 0, _TIME, _DATE, crc, size, size, len(name), 0)
        local = _LOCAL.pack(b"PK\3\4", *same) + name.encode()
        made_by = _VERSION | _UNIX << 8
        central += _CENTRAL.pack(b"PK\1\2", made_by, *same, 0, 0, 0, _ATTRIBUTES, offset)
        central += name.encode()
        parts += [local, *content]
        offset += len(local) + size
        count += 1
    end = _END.pack(b"PK\5\6", 0, 0, count, count, len(central), offset, 0)
    return [*parts, central, end]
