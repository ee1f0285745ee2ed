"""A folder of npz files, one array a key (CONTRACT.md, section 3).

The container is a zip without compression (PKWARE APPNOTE 6.3) around npy files of version 1.0
(NEP 1). It is made here and not by `numpy.savez`, which stamps files with the time of day and
copies arrays on the way.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.errors import ExportError
from mlbatch.types import EXTRAS, RunInfo, Scan
from mlbatch.writers.base import ScanWriter, WriterOptions
from mlbatch.writers.output_file import Bytes, crc32, write_all
from mlbatch.writers.scan_folder import FolderWriter

# Signature, version needed, flags, method, time, date, CRC, size stored and real, length of the
# name and of further fields.
_LOCAL = struct.Struct("<4s5HIIIHH")
# Signature, version and system that made it, and the same as above; length of a comment, disk,
# attributes inside and outside, place of the local head.
_CENTRAL = struct.Struct("<4s6HIII5HII")
# Signature, disks, entries here and in all, size and place of the central directory, comment.
_END = struct.Struct("<4s4HIIH")
_VERSION, _UNIX = 20, 3
# 1 January 1980, the earliest date a zip can hold: files must not depend on when they were written.
_TIME, _DATE = 0, (1 << 5) + 1
# Readable and writable by the owner.
_ATTRIBUTES = 0o600 << 16
# Sizes and places of a zip are 32 bits wide.
_LARGEST_BYTES = (1 << 32) - 1


def stored_zip(members: Iterable[tuple[str, Sequence[Bytes]]]) -> list[Bytes]:
    """The parts of a zip whose members have these names (ASCII) and bytes."""
    parts: list[Bytes] = []
    central, at, count = b"", 0, 0
    for name, content in members:
        crc, size = 0, sum(map(len, content))
        for part in content:
            crc = crc32(part, crc)
        if at + size > _LARGEST_BYTES:
            raise ExportError(
                f"{name}: wanted a scan of at most 4 GiB for an npz, got more; write a .mcap, or "
                "cut scans by --slices"
            )
        same = (_VERSION, 0, 0, _TIME, _DATE, crc, size, size, len(name), 0)
        local = _LOCAL.pack(b"PK\3\4", *same) + name.encode()
        made = _VERSION | _UNIX << 8
        central += _CENTRAL.pack(b"PK\1\2", made, *same, 0, 0, 0, _ATTRIBUTES, at)
        central += name.encode()
        parts += [local, *content]
        at += len(local) + size
        count += 1
    end = _END.pack(b"PK\5\6", 0, 0, count, count, len(central), at, 0)
    return [*parts, central, end]


FORMAT = "npz"
SUFFIX: str | None = None
COMPRESSES = False
SCHEMA = "mlbatch.scan/1"

Array: TypeAlias = npt.NDArray[np.generic]


def extras(options: WriterOptions) -> frozenset[str]:
    """All: an npz keeps what was decoded."""
    return EXTRAS


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of npz files."""
    return FolderWriter(target, info, options, ".npz", lambda: NpzSaver(info))


class NpzSaver:
    """Saves scans of one run; owns the buffers in which arrays come without gaps."""

    def __init__(self, info: RunInfo) -> None:
        self._packed: dict[str, Array] = {}
        self._constant: dict[str, Array] = {
            "slices": np.array(info.slices, dtype=np.int64),
            "sensors": np.array([sensor.name for sensor in info.sensors], dtype=np.str_),
            "frame_id": np.array(info.frame_id, dtype=np.str_),
            "rate_hz": np.array(info.rate_hz, dtype=np.str_),
            "timescale": np.array(info.timescale, dtype=np.str_),
            "schema": np.array(SCHEMA, dtype=np.str_),
        }

    def save(self, file: io.FileIO, scan: Scan) -> None:
        """Write the scan as a zip of npy files."""
        arrays = self._arrays(scan) | self._constant
        write_all(
            file, stored_zip((f"{key}.npy", self._npy(key, array)) for key, array in arrays.items())
        )

    def _arrays(self, scan: Scan) -> dict[str, Array]:
        """The keys of the contract that change from scan to scan, in its order."""
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
        }
        return {key: array for key, array in arrays.items() if array is not None}

    def _npy(self, key: str, array: Array) -> list[Bytes]:
        """The parts of an npy file."""
        array = self._without_gaps(key, array)
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
        return [head.getvalue(), array.reshape(-1).view(np.uint8).data]

    def _without_gaps(self, key: str, array: Array) -> Array:
        """The same values one after the other, in a buffer that is used for the next scan again."""
        if array.flags.c_contiguous:
            return array
        buffer = self._packed.get(key)
        if buffer is None or buffer.size < array.size:
            buffer = self._packed[key] = np.empty(array.size * 5 // 4, array.dtype)
        packed = buffer[: array.size].reshape(array.shape)
        if key != "xyz":
            packed[...] = array
            return packed
        # Axis by axis, since an innermost axis of three is slow to go through.
        for axis in range(3):
            packed[..., axis] = array[..., axis]
        return packed
