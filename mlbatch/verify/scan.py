"""One scan as an output holds it: whatever the format, with None for what it has no place for."""

from __future__ import annotations

from dataclasses import dataclass

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array, U32Array

# Longest time from a column's stamp to its last firing that any supported lidar has, with room:
# 0.14 ms of a PandarQT64.
COLUMN_NS = 1_000_000


@dataclass(slots=True)
class HeldScan:
    """A scan and where it stands; point arrays are (p,), or (n, slots) of an organized scan.

    where: file, and what of it; sensor: the only one (`--split`); xyz: (p, 3) or (n, slots, 3), m;
    time_ns: int64 after `start_ns`, less exact by up to `time_step_ns`; distance_m: from the
    sensor's origin, exact up to a float32; angles_rad: azimuth and elevation in the sensor frame;
    column_stamp_ns, column_lidar_id: (n,).
    """

    where: str
    start_ns: int
    xyz: F32Array
    organized: bool
    sensor: int | None = None
    end_ns: int | None = None
    index: int | None = None
    slice: int | None = None
    complete: bool | None = None
    intensity: F32Array | None = None
    range_m: F32Array | F64Array | None = None
    distance_m: F32Array | None = None
    angles_rad: tuple[F32Array, F32Array] | None = None
    time_ns: I64Array | None = None
    time_step_ns: int = 0
    ring: U16Array | I64Array | None = None
    return_type: U8Array | None = None
    lidar_id: U8Array | None = None
    column: U32Array | None = None
    column_stamp_ns: I64Array | None = None
    column_lidar_id: U8Array | None = None

    @property
    def point(self) -> str:
        """What a place among the points is called."""
        return f"{self.where} slot" if self.organized else f"{self.where} point"


@dataclass(frozen=True, slots=True)
class Points:
    """The valid points of a scan, (p,) each; the others as in `HeldScan`.

    valid: (n, slots), which slots of an organized scan hold them, else None; row: column of each
    point of an organized scan.
    """

    count: int
    valid: BoolArray | None
    row: I64Array | None
    xyz: F32Array
    time_ns: I64Array | None
    ring: U16Array | I64Array | None
    return_type: U8Array | None
    lidar_id: U8Array | None
