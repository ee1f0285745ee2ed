"""Folders of files with comments and points: what PLY, PCD and LAS have in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array
from mlbatch.outputs.comments import ScanComments
from mlbatch.outputs.damage import DamageError
from mlbatch.outputs.folders import ScanFile, ScanReader
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import StoredScan, seconds_to_ns

Values: TypeAlias = npt.NDArray[np.generic]


def commented_limits(name: str) -> dict[str, str]:
    """Reasons why checks are not possible on files of a format with comments and points."""
    absent = {
        "geometry": "ranges",
        "duplicates": "columns",
        "tf_static": "transforms",
        "imu": "IMU samples",
        "messages": "messages",
        "stamps": "log times",
    }
    return {
        "columns": f"first and last column of a scan, by scans.csv; {name} has no column stamps",
        "order": f"points step back by less than a column's duration; {name} has no columns",
        **{check: f"{name} has no {what}" for check, what in absent.items()},
    }


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
class CommentedReader(ScanReader):
    """Reads the files of one folder; all of a run have the same metadata."""

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

    def scan(self, file: ScanFile) -> StoredScan:
        """One scan, checked against the others."""
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
            reflectivity=cast("U16Array | None", points.reflectivity),
            time_ns=time_ns,
            time_step_ns=step_ns,
            time_s=points.time_s,
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
        return seconds_to_ns(time_s)

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
