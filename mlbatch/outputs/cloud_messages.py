"""Messages of clouds: the point layouts, defined a second time, and their records.

Sources: docs/sources/outputs.md sections 2 to 4; sensor_msgs of ROS.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F64Array
from mlbatch.outputs.damage import DamageError
from mlbatch.outputs.encoding import MessageCursor
from mlbatch.outputs.stored_scan import StoredScan, seconds_to_ns

CLOUD = "sensor_msgs/PointCloud2"
_NS = 10**9

Records: TypeAlias = npt.NDArray[np.void]
# Name, offset and type code of each field.
Fields: TypeAlias = tuple[tuple[str, int, int], ...]
_CODES = {"u1": 2, "<u2": 4, "<u4": 6, "<f4": 7, "<f8": 8}


@dataclass(frozen=True, slots=True)
class Preset:
    """A point layout."""

    # Bytes of a point.
    step: int
    fields: Fields
    # Field with the time of a point.
    time: str | None
    # Records; x, y and z also as one field xyz.
    dtype: np.dtype[np.void]


def _preset(step: int, time: str | None, text: str) -> Preset:
    """A preset from `name:type@offset`, types as in numpy."""
    names = []
    types = []
    offsets = []
    for part in text.split():
        name, _, rest = part.partition(":")
        kind, _, offset = rest.partition("@")
        names.append(name)
        types.append(kind if kind == "u1" else f"<{kind}")
        offsets.append(int(offset))
    codes = [_CODES[kind] for kind in types]
    dtype = np.dtype(
        {
            "names": ["xyz", *names],
            "formats": [("<f4", 3), *types],
            "offsets": [0, *offsets],
            "itemsize": step,
        }
    )
    return Preset(step, tuple(zip(names, offsets, codes, strict=True)), time, dtype)


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
    """A PointCloud2."""

    stamp_ns: int
    frame_id: str
    # Name of its preset.
    layout: str
    # (height, width)
    records: Records
    is_dense: bool


def read_cloud(cursor: MessageCursor) -> Cloud:
    """One message; DamageError if it is damaged or of no preset."""
    stamp_ns, frame_id = cursor.header()
    height = cursor.number("I")
    width = cursor.number("I")
    fields = []
    for _ in range(cursor.number("I")):
        name = cursor.text()
        offset = cursor.number("I")
        code = cursor.number("B")
        count = cursor.number("I")
        if count != 1:
            raise DamageError("fields of one value", f"{name} of {count}")
        fields.append((name, offset, code))
    big_endian = cursor.number("B")
    step = cursor.number("I")
    row = cursor.number("I")
    layouts = [
        name for name, one in PRESETS.items() if (one.step, one.fields) == (step, tuple(fields))
    ]
    if not layouts or big_endian:
        found = ", ".join(f"{name}@{offset} type {code}" for name, offset, code in fields)
        raise DamageError("little-endian fields of a point layout", f"{found}; step {step}")
    data = cursor.bytes_of(cursor.number("I"))
    if row != step * width or len(data) != row * height:
        raise DamageError(
            f"{height} rows of {width} points of {step} bytes",
            f"rows of {row} bytes, {len(data)} in all",
        )
    is_dense = bool(cursor.number("B"))
    cursor.finish("a PointCloud2")
    records = np.frombuffer(data, PRESETS[layouts[0]].dtype).reshape(height, width)
    return Cloud(stamp_ns, frame_id, layouts[0], records, is_dense)


def stored_scan(cloud: Cloud, where: str, sensor: int | None) -> StoredScan:
    """The message as a scan; an organized one is transposed: its rows are columns."""
    organized = not cloud.is_dense
    records: Any = cloud.records.T if organized else cloud.records.reshape(-1)
    names = records.dtype.names or ()
    scan = StoredScan(where, cloud.stamp_ns, records["xyz"], organized, sensor)
    _add_times(scan, PRESETS[cloud.layout].time, records)
    # The `channel` of `autoware` is a ring of its sensor, not of the run.
    for name in ("reflectivity", "ring", "return_type", "lidar_id"):
        if name in names:
            setattr(scan, name, records[name])
    if "intensity" in names:
        # An intensity of one byte has no NaN for empty slots.
        is_real = records.dtype["intensity"].kind == "f"
        setattr(scan, "intensity" if is_real else "byte_intensity", records["intensity"])
    if "range" in names:
        scan.range_m = records["range"] / 1000.0
    if "distance" in names:
        scan.distance_m = records["distance"]
        scan.angles_rad = (records["azimuth"], records["elevation"])
    return scan


def _add_times(scan: StoredScan, name: str | None, records: Any) -> None:
    """Add the times after the stamp, and their largest error."""
    if name is None:
        return
    values = records[name]
    if name in ("t", "time_stamp"):
        scan.time_ns = values.astype(np.int64)
        return
    if not np.isfinite(values).all():
        raise DamageError(f"a finite {name}", "NaN or infinity")
    if name == "time":
        scan.time_s = values
        scan.time_ns, scan.time_step_ns = seconds_to_ns(values)
        return
    # Times of the clock; empty slots have the start.
    whole_s, rest_ns = divmod(scan.start_ns, _NS)
    after_s: F64Array = np.clip(values - whole_s, -4.0, 5.0)
    scan.time_ns = np.rint(after_s * _NS).astype(np.int64) - rest_ns
    scan.time_step_ns = int(float(np.spacing(np.abs(values).max(initial=0))) * _NS) + 1
