"""Folders of files with comments and points: what PLY, PCD and LAS have in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.outputs.comments import ScanComments
from mlbatch.outputs.folders import ScanFile, ScanReader
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import POINT_ARRAYS, StoredScan, seconds_to_ns

Values: TypeAlias = npt.NDArray[Any]
Fields: TypeAlias = dict[str, Values]
_ORGANIZED_AXES = 3


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
class CommentedReader(ScanReader):
    """Reads the files of one folder; all of a run have the same metadata."""

    _metadata: RunMetadata = field(default_factory=RunMetadata)

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and points of a file; DamageError for another file. By format.

        Arrays are (p,), or (n, slots) in an organized scan: `xyz`, `time` (float s after the start)
        or `time_ns`, and perhaps other arrays of `StoredScan`.
        """
        raise NotImplementedError

    def begin(self, file: ScanFile) -> RunMetadata:
        """Metadata of the run in the first scan."""
        comments, points = self.parse(file.read())
        self._metadata = comments.metadata(self.log, file.where)
        self.sensors = self._metadata.sensors or ()
        self.organized = points["xyz"].ndim == _ORGANIZED_AXES
        return self._metadata

    def scan(self, file: ScanFile) -> StoredScan:
        """One scan, checked against the others."""
        log = self.log
        comments, points = self.parse(file.read())
        log.ok("layout")
        self._metadata.joined(log, file.where, comments.metadata(log, file.where))
        organized = points["xyz"].ndim == _ORGANIZED_AXES
        where = f"{file.where} {'slot' if organized else 'point'}"
        time_ns, step_ns = self._times(where, points)

        def labels(check: str, name: str) -> Any:
            return self._labels(check, where, points.get(name), POINT_ARRAYS[name])

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
            xyz=points["xyz"],
            organized=organized,
            sensor=file.sensor_index(log, self.sensors),
            intensity=points.get("intensity"),
            reflectivity=points.get("reflectivity"),
            time_ns=time_ns,
            time_step_ns=step_ns,
            time_s=points.get("time"),
            ring=labels("rings", "ring"),
            return_type=labels("returns", "return_type"),
            lidar_id=labels("sensors", "lidar_id"),
            fill=comments.fill(),
        )

    def _times(self, where: str, points: Fields) -> tuple[I64Array, int]:
        """Times in ns and their resolution."""
        if "time_ns" in points:
            return points["time_ns"], 0
        time_s = points["time"]
        bad: BoolArray = np.logical_not(np.isfinite(time_s))
        if bad.any():
            found = time_s.reshape(-1).item
            self.log.none("times", where, bad.reshape(-1), "a finite number", found)
        return seconds_to_ns(time_s)

    def _labels(self, check: str, where: str, values: Values | None, kind: str) -> Any:
        """Whole numbers of an unsigned type; others are violations, and cut."""
        if values is None:
            return None
        if values.dtype.str != kind:
            most = int(np.iinfo(kind).max)
            whole: I64Array = values.astype(np.int64)
            cut: I64Array = np.clip(whole, 0, most)
            bad: BoolArray = (cut != whole).reshape(-1)
            name = {"rings": "ring", "returns": "return type", "sensors": "sensor"}[check]
            self.log.none(check, where, bad, f"a {name} from 0 to {most}", values.reshape(-1).item)
            values = cut
        return values.astype(np.uint8 if kind == "|u1" else np.int64)
