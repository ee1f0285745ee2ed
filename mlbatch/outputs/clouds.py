"""Clouds of any point layout to scans: the inverse of `writers/point_layouts.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.outputs.scan import Scan
from mlbatch.outputs.table import ScanRow
from mlbatch.types import RunInfo
from mlbatch.units import MM_PER_M, NS_PER_S

# A structured array; numpy has no type for the fields of a dtype.
Rows: TypeAlias = npt.NDArray[Any]
Values: TypeAlias = npt.NDArray[Any]


def _as_it_is(values: Values, start_ns: int) -> Values:
    return values


def _after_start(time_s: Values, start_ns: int) -> I64Array:
    """Seconds to ns: exact for float64; of float32, rounded toward zero, the smallest such ns."""
    # The product of a float32 and 10^9 has fewer bits than a float64.
    time_ns: F64Array = time_s.astype(np.float64) * NS_PER_S
    rounded = np.ceil(time_ns) if time_s.dtype.itemsize == 4 else np.rint(time_ns)
    return rounded.astype(np.int64)


def _since_epoch(time_s: Values, start_ns: int) -> I64Array:
    """Absolute float64 seconds, which resolve 0.24 us, to ns after the start."""
    whole_s, rest_ns = divmod(start_ns, NS_PER_S)
    after_ns: I64Array = np.rint((time_s - whole_s) * NS_PER_S).astype(np.int64) - rest_ns
    return np.maximum(after_ns, 0)


def _metres(range_mm: Values, start_ns: int) -> F64Array:
    return np.divide(range_mm, MM_PER_M, dtype=np.float64)


# Fields of the layouts, the array of a scan that each gives, its type, and the conversion.
_FIELDS: Mapping[str, tuple[str, str, Callable[[Values, int], Values]]] = {
    "intensity": ("intensity", "<f4", _as_it_is),
    "reflectivity": ("reflectivity", "<u2", _as_it_is),
    "range": ("range_m", "<f4", _metres),
    "time": ("time_ns", "<u4", _after_start),
    "t": ("time_ns", "<u4", _as_it_is),
    "time_stamp": ("time_ns", "<u4", _as_it_is),
    "timestamp": ("time_ns", "<u4", _since_epoch),
    "ring": ("ring", "<u2", _as_it_is),
    "return_type": ("return_type", "u1", _as_it_is),
    "lidar_id": ("lidar_id", "u1", _as_it_is),
}
_COLUMN_ARRAYS = ("column", "column_stamp_ns", "column_lidar_id")


@dataclass(frozen=True, slots=True)
class CloudPlace:
    """Window and stored figures of a cloud; only: the sensor of the cloud with `--split`."""

    info: RunInfo
    index: int
    slice: int
    start_ns: int
    end_ns: int
    row: ScanRow | None
    only: int | None = None


def scan_of_cloud(place: CloudPlace, rows: Rows, complete: bool) -> Scan:
    """A scan of records (p,), or (n, slots) when organized; fields as in the point layouts."""
    xyz = np.stack([rows[axis] for axis in "xyz"], axis=-1)
    return scan_of_fields(
        place, xyz, {name: rows[name] for name in rows.dtype.names or ()}, complete
    )


def scan_of_fields(
    place: CloudPlace, xyz: F32Array, fields: Mapping[str, Values], complete: bool
) -> Scan:
    """A scan of arrays by the names of the point layouts; xyz: (p, 3) or (n, slots, 3)."""
    found: dict[str, Values] = {}
    for name, values in fields.items():
        if name in _FIELDS:
            array, kind, convert = _FIELDS[name]
            found[array] = np.ascontiguousarray(convert(values, place.start_ns), kind)
    if place.only is not None:
        # All points are of this sensor, whether the layout has a field for it or not.
        found["lidar_id"] = np.full(xyz.shape[:-1], place.only, np.uint8)
    kinds = {array: kind for array, kind, _ in _FIELDS.values()}
    empty = {array: np.zeros(0, kind) for array, kind in kinds.items() if array not in found}
    arrays = found | empty
    row = place.row or ScanRow(complete)
    return Scan(
        info=place.info,
        index=place.index,
        slice=place.slice,
        start_ns=place.start_ns,
        end_ns=place.end_ns,
        complete=complete,
        ready_host_ns=row.ready_host_ns,
        xyz=np.ascontiguousarray(xyz),
        intensity=arrays["intensity"],
        reflectivity=found.get("reflectivity"),
        range_m=found.get("range_m"),
        time_ns=arrays["time_ns"],
        ring=arrays["ring"],
        return_type=arrays["return_type"],
        lidar_id=arrays["lidar_id"],
        column=None,
        column_stamp_ns=np.zeros(0, np.int64),
        column_lidar_id=np.zeros(0, np.uint8),
        columns_per_sensor=row.columns,
        max_gap_ns=row.max_gap_ns,
        coverage=row.coverage,
        overlap=row.overlap,
        fill=np.array(row.fill, np.float32),
        absent=frozenset({*empty, *_COLUMN_ARRAYS, "ring_base"}),
        sensor="" if place.only is None else place.info.sensors[place.only].name,
    )
