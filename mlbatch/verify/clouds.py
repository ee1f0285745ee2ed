"""PointCloud2 messages: their fields against the presets of `--point-layout`, and their points.

Source: facts/outputs.md, sections 2 and 3; sensor_msgs of ROS.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.types import F32Array, F64Array, I64Array, U8Array, U16Array
from mlbatch.verify.encoding import Cursor
from mlbatch.verify.scan import HeldScan
from mlbatch.verify.verdict import DamageError

_TYPES = {2: "u1", 4: "<u2", 6: "<u4", 7: "<f4", 8: "<f8"}
_NS = 10**9
Records: TypeAlias = npt.NDArray[np.void]
# Name, offset and type code of each field.
Fields: TypeAlias = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, slots=True)
class Preset:
    """A point of `step` bytes; time: field that tells it."""

    step: int
    fields: Fields
    time: str | None


def _preset(step: int, time: str | None, text: str) -> Preset:
    """From `name type@offset`, types as numpy has them."""
    codes = {"u1": 2, "u2": 4, "u4": 6, "f4": 7, "f8": 8}
    fields = []
    for part in text.split():
        name, _, rest = part.partition(":")
        kind, _, offset = rest.partition("@")
        fields.append((name, int(offset), codes[kind]))
    return Preset(step, tuple(fields), time)


_XYZ = "x:f4@0 y:f4@4 z:f4@8"
PRESETS = {
    "standard": _preset(
        24,
        "time",
        f"{_XYZ} intensity:f4@12 time:f4@16 ring:u2@20 return_type:u1@22 lidar_id:u1@23",
    ),
    "velodyne": _preset(22, "time", f"{_XYZ} intensity:f4@12 ring:u2@16 time:f4@18"),
    "ouster": _preset(
        48,
        "t",
        f"{_XYZ} intensity:f4@16 t:u4@20 reflectivity:u2@24 ring:u2@26 ambient:u2@28 range:u4@32",
    ),
    "hesai": _preset(26, "timestamp", f"{_XYZ} intensity:f4@12 ring:u2@16 timestamp:f8@18"),
    "autoware": _preset(
        32,
        "time_stamp",
        f"{_XYZ} intensity:u1@12 return_type:u1@13 channel:u2@14 azimuth:f4@16 elevation:f4@20 "
        "distance:f4@24 time_stamp:u4@28",
    ),
    "kiss-icp": _preset(16, "time", f"{_XYZ} time:f4@12"),
    "minimal": _preset(12, None, _XYZ),
}


@dataclass(frozen=True, slots=True)
class Cloud:
    """A PointCloud2; layout: name of its preset; records: (height, width)."""

    stamp_ns: int
    frame_id: str
    layout: str
    records: Records
    is_dense: bool


def read_cloud(cursor: Cursor) -> Cloud:
    """One message; DamageError where it is none, or of no preset."""
    stamp_ns, frame_id = cursor.header()
    height, width, count = cursor.whole("I"), cursor.whole("I"), cursor.whole("I")
    fields = []
    for _ in range(count):
        fields.append((cursor.text(), cursor.whole("I"), cursor.whole("B")))
        repeats = cursor.whole("I")
        if repeats != 1:
            raise DamageError("fields of one value", f"{fields[-1][0]} of {repeats}")
    big_endian = cursor.whole("B")
    step, row = cursor.whole("I"), cursor.whole("I")
    name = next((n for n, p in PRESETS.items() if (p.step, p.fields) == (step, tuple(fields))), "")
    if not name or big_endian:
        got = ", ".join(f"{field}@{offset} type {code}" for field, offset, code in fields)
        raise DamageError("little-endian fields of a point layout", f"{got}; step {step}")
    data = cursor.raw(cursor.whole("I"))
    if row != step * width or len(data) != row * height:
        raise DamageError(
            f"{height} rows of {width} points of {step} bytes",
            f"rows of {row} bytes, {len(data)} in all",
        )
    is_dense = cursor.whole("B")
    cursor.end("a PointCloud2")
    records = np.frombuffer(data, _dtype(PRESETS[name])).reshape(height, width)
    return Cloud(stamp_ns, frame_id, name, records, bool(is_dense))


def _dtype(preset: Preset) -> np.dtype[np.void]:
    """Records of a preset; x, y and z also as one field."""
    names = ["xyz", *(name for name, _, _ in preset.fields)]
    formats: list[object] = [("<f4", 3), *(_TYPES[code] for _, _, code in preset.fields)]
    offsets = [0, *(offset for _, offset, _ in preset.fields)]
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": preset.step}
    )


def held(cloud: Cloud, where: str, sensor: int | None) -> HeldScan:
    """The message as a scan; an organized one is turned so that columns are rows."""
    organized = not cloud.is_dense
    records = cloud.records.T if organized else cloud.records.reshape(-1)
    names = {name for name, _, _ in PRESETS[cloud.layout].fields}
    time_ns, step_ns = _times(cloud, records)
    # An intensity of one byte, and ranges in mm, have no NaN for empty slots.
    intensity = "intensity" in names and records.dtype["intensity"].kind == "f"
    xyz: F32Array = records["xyz"]
    # Of `autoware`: the ring within its sensor, which is no ring of the run.
    ring: U16Array | None = records["ring"] if "ring" in names else None
    angles: tuple[F32Array, F32Array] | None = None
    if "azimuth" in names:
        angles = records["azimuth"], records["elevation"]
    types: U8Array | None = records["return_type"] if "return_type" in names else None
    return HeldScan(
        where=where,
        start_ns=cloud.stamp_ns,
        xyz=xyz,
        organized=organized,
        sensor=sensor,
        intensity=records["intensity"] if intensity else None,
        range_m=_range_m(records) if "range" in names else None,
        distance_m=records["distance"] if "distance" in names else None,
        angles_rad=angles,
        time_ns=time_ns,
        time_step_ns=step_ns,
        ring=ring,
        return_type=types,
        lidar_id=records["lidar_id"] if "lidar_id" in names else None,
    )


def _range_m(records: Records) -> F64Array:
    range_m: F64Array = records["range"] / 1000.0
    return range_m


def _times(cloud: Cloud, records: Records) -> tuple[I64Array | None, int]:
    """Times after the stamp, ns, and how inexact they are."""
    name = PRESETS[cloud.layout].time
    if name is None:
        return None, 0
    values = records[name]
    if name in ("t", "time_stamp"):
        return values.astype(np.int64), 0
    if not np.isfinite(values).all():
        raise DamageError(f"{name} that is a number", "NaN or infinity")
    if name == "time":
        # Rounded toward zero: never later than the true one.
        time_s: F64Array = np.clip(values.astype(np.float64), -4.0, 4e9 / _NS)
        grain_s = float(np.spacing(np.float32(np.abs(time_s).max(initial=0))))
        return np.floor(time_s * _NS).astype(np.int64), int(grain_s * _NS) + 1
    # Empty slots of organized scans hold the start itself.
    whole_s, rest_ns = divmod(cloud.stamp_ns, _NS)
    after_s: F64Array = np.clip(values - whole_s, -4.0, 5.0)
    grain_s = float(np.spacing(np.abs(values).max(initial=0)))
    return np.rint(after_s * _NS).astype(np.int64) - rest_ns, int(grain_s * _NS) + 1
