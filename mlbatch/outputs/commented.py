"""Folders of files with comments and points: what PLY, PCD and LAS have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array
from mlbatch.outputs.comments import ScanComments
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.folders import ScanFile, readable
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import StoredScan

_NS = 1e9
_MOST_S = 4.0

Values: TypeAlias = npt.NDArray[np.generic]


@dataclass(slots=True)
class StoredPoints:
    """Point arrays as stored: (p,), or (n, slots) in an organized scan; None: not stored."""

    xyz: F32Array
    # One of both: float s after the start, or ns.
    time_s: F32Array | F64Array | None
    time_ns: I64Array | None
    ring: Values | None
    return_type: Values | None
    lidar_id: Values | None
    intensity: F32Array | None = None
    organized: bool = False
    reflectivity: Values | None = None


@dataclass(slots=True)
class CommentedReader:
    """Reads the files of one folder; all of a run have the same metadata."""

    log: CheckLog
    sensors: tuple[str, ...] = ()
    organized: bool = False
    _metadata: RunMetadata = field(default_factory=RunMetadata)

    def parse(self, data: bytes) -> tuple[ScanComments, StoredPoints]:
        """Comments and points of a file; DamageError for another file. By format."""
        raise NotImplementedError

    def begin(self, file: ScanFile) -> RunMetadata:
        """Metadata of the run in the first scan."""
        comments, points = self.parse(file.read())
        self._metadata = comments.metadata(self.log, file.where)
        self.sensors = self._metadata.sensors or ()
        self.organized = points.organized
        return self._metadata

    def scans(self, files: list[ScanFile]) -> Iterator[StoredScan]:
        """Every readable scan; the others are violations."""
        return readable(self.log, files, self._scan)

    def _scan(self, file: ScanFile) -> StoredScan:
        log = self.log
        comments, points = self.parse(file.read())
        log.ok("layout")
        self._metadata.joined(log, file.where, comments.metadata(log, file.where))
        where = f"{file.where} {'slot' if points.organized else 'point'}"
        time_ns, step_ns = self._times(where, points)
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
            xyz=points.xyz,
            organized=points.organized,
            sensor=file.sensor_index(log, self.sensors),
            intensity=points.intensity,
            time_ns=time_ns,
            time_step_ns=step_ns,
            ring=self._labels("rings", where, points.ring, np.dtype("u2")),
            return_type=_bytes(self._labels("returns", where, points.return_type, np.dtype("u1"))),
            lidar_id=_bytes(self._labels("sensors", where, points.lidar_id, np.dtype("u1"))),
            fill=comments.fill(),
        )

    def _times(self, where: str, points: StoredPoints) -> tuple[I64Array, int]:
        """Times in ns and their resolution."""
        time_s = points.time_s
        if time_s is None:
            if points.time_ns is None:
                raise DamageError("times of points", "none")
            return points.time_ns, 0
        bad: BoolArray = np.logical_not(np.isfinite(time_s))
        if bad.any():
            found = time_s.reshape(-1).item
            self.log.none("times", where, bad.reshape(-1), "a finite number", found)
        # Before the conversion, which warns of signalling NaN.
        exact_s: F64Array = np.clip(np.nan_to_num(time_s).astype(np.float64), -_MOST_S, _MOST_S)
        if time_s.dtype.itemsize > np.dtype("f4").itemsize:
            return np.rint(exact_s * _NS).astype(np.int64), 0
        # Rounded toward zero: never later than the true time.
        step_s = float(np.spacing(np.float32(np.abs(exact_s).max(initial=0))))
        return np.floor(exact_s * _NS).astype(np.int64), int(step_s * _NS) + 1

    def _labels(
        self,
        check: str,
        where: str,
        values: Values | None,
        kind: np.dtype[np.unsignedinteger[Any]],
    ) -> I64Array | None:
        """Whole numbers of an unsigned type; others are violations, and cut."""
        if values is None:
            return None
        if values.dtype.kind == "u" and values.dtype.itemsize <= kind.itemsize:
            return values.astype(np.int64)
        most = int(np.iinfo(kind).max)
        whole: I64Array = values.astype(np.int64)
        cut: I64Array = np.clip(whole, 0, most)
        bad: BoolArray = (cut != whole).reshape(-1)
        name = {"rings": "ring", "returns": "return type", "sensors": "sensor"}[check]
        self.log.none(check, where, bad, f"a {name} from 0 to {most}", values.reshape(-1).item)
        return cut


def _bytes(values: I64Array | None) -> U8Array | None:
    return None if values is None else values.astype(np.uint8)
