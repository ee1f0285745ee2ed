"""Messages of decoded clouds from values: PointCloud2 of any fields, Livox CustomMsg.

Layouts: docs/sources/messages.md, sections 1, 4 and 8; written here once more, apart from the
package.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import U8Array
from tests.builders.bags import Body, Recorded

CLOUD = "sensor_msgs/PointCloud2"
CUSTOM = "livox_ros_driver/CustomMsg"
CUSTOM2 = "livox_ros_driver2/CustomMsg"
# Number and code of `struct` of the types of a PointField.
TYPES = {
    "int8": (1, "b"),
    "uint8": (2, "B"),
    "int16": (3, "h"),
    "uint16": (4, "H"),
    "int32": (5, "i"),
    "uint32": (6, "I"),
    "float32": (7, "f"),
    "float64": (8, "d"),
}
XYZ = (("x", "float32"), ("y", "float32"), ("z", "float32"))
# Fields of drivers, by section 8: name and type in their order, without gaps.
OUSTER = (*XYZ, ("intensity", "float32"), ("t", "uint32"), ("ring", "uint16"))
VELODYNE = (*XYZ, ("intensity", "float32"), ("ring", "uint16"), ("time", "float32"))
HESAI = (*XYZ, ("intensity", "float32"), ("ring", "uint16"), ("timestamp", "float64"))
_XYZI = (*XYZ, ("intensity", "float32"))
LIVOX = (*_XYZI, ("tag", "uint8"), ("line", "uint8"), ("timestamp", "float64"))
_XYZIRC = (*XYZ, ("intensity", "uint8"), ("return_type", "uint8"), ("channel", "uint16"))
AUTOWARE = (*_XYZIRC, ("time_stamp", "uint32"))
STAMP_NS = 1_700_000_000_000_000_000

Point = Sequence[float]


@dataclass(frozen=True, slots=True)
class Form:
    """How a PointCloud2 is written; None: as it should be.

    gap: bytes behind each point; row_gap: behind each row; count: of every field.
    """

    encoding: str = "cdr"
    frame: str = "lidar"
    height: int = 1
    gap: int = 0
    row_gap: int = 0
    count: int = 1
    bigendian: bool = False
    width: int | None = None
    point_step: int | None = None
    row_step: int | None = None


def cloud_message(
    fields: Sequence[tuple[str, str]],
    points: Sequence[Point],
    stamp_ns: int = STAMP_NS,
    form: Form | None = None,
) -> bytes:
    """A sensor_msgs/PointCloud2; points: values in the order of the fields."""
    form = form or Form()
    code = "<" + "".join(TYPES[kind][1] for _, kind in fields)
    step = struct.calcsize(code) + form.gap
    width = len(points) // form.height
    rows = [
        b"".join(
            struct.pack(code, *point) + bytes(form.gap)
            for point in points[row * width : (row + 1) * width]
        )
        + bytes(form.row_gap)
        for row in range(form.height)
    ]
    places = []
    offset = 0
    for name, kind in fields:
        places.append((name, offset, kind))
        offset += struct.calcsize(TYPES[kind][1])
    return _cloud(places, width, step, b"".join(rows), stamp_ns, form)


def cloud_of(points: npt.NDArray[Any], stamp_ns: int, form: Form | None = None) -> bytes:
    """A sensor_msgs/PointCloud2 of a structured array."""
    kinds: Mapping[str, Any] = points.dtype.fields or {}
    places = [(name, offset, kind.name) for name, (kind, offset, *_) in kinds.items()]
    step = points.dtype.itemsize
    return _cloud(places, len(points), step, points.tobytes(), stamp_ns, form or Form())


def _cloud(
    places: Sequence[tuple[str, int, str]],
    width: int,
    step: int,
    data: bytes,
    stamp_ns: int,
    form: Form,
) -> bytes:
    """Fields by name, offset and type, and rows of points of `step` bytes."""
    body = Body(form.encoding).header(stamp_ns, form.frame)
    body.put("I", form.height, width if form.width is None else form.width, len(places))
    for name, offset, kind in places:
        body.text(name).put("I", offset).put("B", TYPES[kind][0]).put("I", form.count)
    body.put("B", form.bigendian)
    body.put("I", step if form.point_step is None else form.point_step)
    body.put("I", step * width + form.row_gap if form.row_step is None else form.row_step)
    return body.blob(data).put("B", 1).done()


def custom_message(
    points: Sequence[Point], timebase_ns: int = STAMP_NS, stamp_ns: int = 0, encoding: str = "cdr"
) -> bytes:
    """A CustomMsg; points: offset_time, x, y, z, reflectivity, tag, line."""
    body = Body(encoding).header(stamp_ns, "livox_frame").put("Q", timebase_ns)
    body.put("I", len(points)).put("B", 1, 0, 0, 0).put("I", len(points))
    for offset_ns, x, y, z, level, tag, line in points:
        body.put("I", int(offset_ns)).put("f", x, y, z).put("B", int(level), int(tag), int(line))
    return body.done()


def write_points(
    topic: str, messages: Sequence[bytes], kind: str = CLOUD, step_ns: int = 100_000_000
) -> list[Recorded]:
    """Recorded messages of a topic, each `step_ns` after the one before."""
    return [
        Recorded(topic, kind, STAMP_NS + (number + 1) * step_ns, data)
        for number, data in enumerate(messages)
    ]


HEAD_BYTES = 24
HEAD = [("magic", "S4"), ("version", "u1"), ("kind", "u1"), ("slots", "<u2"), ("stamp_ns", "<i8")]
HEAD += [("number", "<u4"), ("count", "<u2"), ("rest", "<u2")]


def read_packets(packets: U8Array) -> Any:
    """Packets (P, size) of our own making as records, by the layout that docs/formats states."""
    # A tuple, since numpy 1 takes the shape 1 for none.
    slots = ((packets.shape[1] - HEAD_BYTES) // 20,)
    planes = [(name, "<f4", slots) for name in ("x", "y", "z", "level")]
    planes += [("ring", "<u2", slots), ("return_type", "u1", slots), ("tag", "u1", slots)]
    data = np.ascontiguousarray(packets[:, : HEAD_BYTES + 20 * slots[0]])
    return data.view(np.dtype([*HEAD, *planes])).reshape(-1).view(np.recarray)
