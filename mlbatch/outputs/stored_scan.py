"""One scan as stored in an output of any format; None for what the format has no place for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array, U32Array

# Longest time from the stamp of a column to its last firing, with room: the longest of the
# supported lidars is 0.14 ms (PandarQT64).
COLUMN_NS = 1_000_000


# Arrays with a value for each point, and their types, as users get them: of npz and `Scan`.
POINT_ARRAYS = {
    "intensity": "<f4",
    "reflectivity": "<u2",
    "range_m": "<f4",
    "time_ns": "<u4",
    "ring": "<u2",
    "return_type": "|u1",
    "lidar_id": "|u1",
}
_NS = 10**9
# Of damaged times, before they are converted.
_MOST_S = 4.0


def seconds_to_ns(time_s: F32Array | F64Array) -> tuple[I64Array, int]:
    """Times as stored, s, in ns, and their largest error; float32 are rounded toward zero."""
    # Before the conversion, which warns of signalling NaN.
    exact: F64Array = np.nan_to_num(time_s).astype(np.float64)
    # In place: new memory takes longer than the sums.
    np.clip(exact, -_MOST_S, _MOST_S, out=exact)
    longest_s = max(float(exact.max(initial=0)), -float(exact.min(initial=0)))
    exact *= _NS
    if time_s.dtype.itemsize > np.dtype("f4").itemsize:
        return np.rint(exact, out=exact).astype(np.int64), 0
    # Never later than the true time.
    step_s = float(np.spacing(np.float32(longest_s)))
    return np.floor(exact, out=exact).astype(np.int64), int(step_s * _NS) + 1


@dataclass(slots=True)
class StoredScan:
    """A scan; point arrays are (p,), or (n, slots) in an organized scan."""

    # File, and message in it.
    where: str
    start_ns: int
    # (p, 3) or (n, slots, 3), m.
    xyz: F32Array
    organized: bool
    # The only sensor of the scan (`--split`).
    sensor: int | None = None
    end_ns: int | None = None
    # Of the scan, as in its name.
    index: int | None = None
    # Of a window (`--slices`).
    slice: int | None = None
    complete: bool | None = None
    intensity: F32Array | None = None
    reflectivity: U16Array | None = None
    # Instead of `intensity` in layouts that store 8 bits of it.
    byte_intensity: U8Array | None = None
    range_m: F32Array | F64Array | None = None
    # Distance from the origin of the sensor, exact to a float32.
    distance_m: F32Array | None = None
    # Azimuth and elevation in the sensor frame.
    angles_rad: tuple[F32Array, F32Array] | None = None
    # After `start_ns`; error up to `time_step_ns`.
    time_ns: I64Array | None = None
    # Resolution of `time_ns`.
    time_step_ns: int = 0
    # The times as stored, if they are s after `start_ns`.
    time_s: F32Array | F64Array | None = None
    ring: U16Array | I64Array | None = None
    return_type: U8Array | None = None
    lidar_id: U8Array | None = None
    # Column of each point.
    column: U32Array | None = None
    # (n,)
    column_stamp_ns: I64Array | None = None
    # (n,)
    column_lidar_id: U8Array | None = None
    # (s,) by sensor of the run, or of the only sensor; NaN: unknown.
    fill: F32Array | None = None
    # Points by time instead of by column.
    by_time: bool = False
    # Of the bytes: sum of the CRC-32 of its files, or that of the data of its message.
    checksum: int | None = None
    # Times of points count from the first column of their sensor.
    own_times: bool = False

    @property
    def point(self) -> str:
        """Prefix of the index of a point in a violation."""
        return f"{self.where} slot" if self.organized else f"{self.where} point"


@dataclass(frozen=True, slots=True)
class Points:
    """The valid points of a scan, (p,) each; fields as in `StoredScan`."""

    count: int
    # (n, slots): slots with a point; None in a dense scan.
    valid: BoolArray | None
    # Column of each point of an organized scan.
    row: I64Array | None
    xyz: F32Array
    time_ns: I64Array | None
    ring: U16Array | I64Array | None
    return_type: U8Array | None
    lidar_id: U8Array | None
