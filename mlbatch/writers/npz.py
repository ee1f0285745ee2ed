"""A folder of npz files, one array a key (CONTRACT.md, section 3).

The container is a zip without compression (PKWARE APPNOTE 6.3) around npy files of version 1.0
(NEP 1). It is made here and not by `numpy.savez`, which stamps files with the time of day and
copies arrays on the way.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.types import EXTRAS, F32Array, RunInfo, Scan
from mlbatch.writers._folder import FolderWriter
from mlbatch.writers._options import ScanWriter, WriterOptions

FORMAT = "npz"
SUFFIX: str | None = None
SCHEMA = "mlbatch.scan/1"

Array: TypeAlias = npt.NDArray[np.generic]

# The earliest date a zip can hold: files must not depend on when they were written.
_ZIP_DATE = (1980, 1, 1, 0, 0, 0)


def extras(options: WriterOptions) -> frozenset[str]:
    """All: an npz keeps what was decoded."""
    return EXTRAS


def open_writer(target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
    """Start a folder of npz files."""
    return FolderWriter(target, info, options, ".npz", NpzSaver(info).save)


class NpzSaver:
    """Saves scans of one run; owns the buffer that packs coordinates."""

    def __init__(self, info: RunInfo) -> None:
        self._xyz = np.empty((0, 3), dtype=np.float32)
        self._constant: dict[str, Array] = {
            "slices": np.array(info.slices, dtype=np.int64),
            "sensors": np.array([sensor.name for sensor in info.sensors], dtype=np.str_),
            "frame_id": np.array(info.frame_id, dtype=np.str_),
            "rate_hz": np.array(info.rate_hz, dtype=np.str_),
            "timescale": np.array(info.timescale, dtype=np.str_),
            "schema": np.array(SCHEMA, dtype=np.str_),
        }

    def save(self, file: BinaryIO, scan: Scan) -> None:
        """Write the scan as a zip of npy files."""
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for key, array in (self._arrays(scan) | self._constant).items():
                _write_npy(archive, key, array)

    def _arrays(self, scan: Scan) -> dict[str, Array]:
        """The keys of the contract that change from scan to scan, in its order."""
        arrays: dict[str, Array | None] = {
            "xyz": self._packed(scan.xyz),
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

    def _packed(self, xyz: F32Array) -> F32Array:
        """The same coordinates without gaps between points."""
        if xyz.flags.c_contiguous:
            return xyz
        rows = xyz.reshape(-1, 3)
        if len(self._xyz) < len(rows):
            self._xyz = np.empty((len(rows) * 5 // 4, 3), dtype=np.float32)
        packed = self._xyz[: len(rows)]
        for axis in range(3):
            packed[:, axis] = rows[:, axis]
        return packed.reshape(xyz.shape)


def _write_npy(archive: zipfile.ZipFile, key: str, array: Array) -> None:
    """Append one array to the zip without copying it."""
    array = np.ascontiguousarray(array) if array.ndim else array
    entry = zipfile.ZipInfo(f"{key}.npy", date_time=_ZIP_DATE)
    with archive.open(entry, "w") as member:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(member, header)
        member.write(array.data if array.dtype.kind != "U" else array.tobytes())
