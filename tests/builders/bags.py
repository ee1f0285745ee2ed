"""Messages of bags from values: raw packets, metadata, transforms, IMU samples; CDR and ROS 1.

Layouts: docs/sources/messages.md, sections 1 and 4; written here once more, apart from the package.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import cos, radians, sin

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.readers import open_recording
from mlbatch.readers.bag.packet_messages import PacketsFound, Unpacker
from mlbatch.ros.encoding import MessageError
from mlbatch.types import StreamTable, Topic
from tests.builders import reading
from tests.builders.two_lidars import FOLDER, LEFT, RIGHT, FixtureLidar

OUSTER_ROS1 = "ouster_ros/PacketMsg"
NS_PER_S = 1_000_000_000
BREAK = "=" * 80
HEADERS = {
    "ros1": "uint32 seq\ntime stamp\nstring frame_id\n",
    "cdr": "builtin_interfaces/Time stamp\nstring frame_id\n",
}
_STAMPED = "Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
# Main text, then types it needs (a header is added by its encoding).
TEXTS: dict[str, tuple[str, dict[str, str]]] = {
    "PacketMsg": ("uint8[] buf\n", {}),
    "String": ("string data\n", {}),
    "RobosenseScan": (
        "Header header\nrobosense_msgs/RobosensePacket[] packets\n",
        {
            "robosense_msgs/RobosensePacket": (
                "builtin_interfaces/Time stamp\nuint8 is_difop\nuint8[1500] data\nuint32 size\n"
            )
        },
    ),
    "UInt8MultiArray": (
        "MultiArrayLayout layout\nuint8[] data\n",
        {
            "std_msgs/MultiArrayLayout": "MultiArrayDimension[] dim\nuint32 data_offset\n",
            "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
        },
    ),
    "TFMessage": (
        "geometry_msgs/TransformStamped[] transforms\n",
        {
            "geometry_msgs/TransformStamped": _STAMPED,
            "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation\n",
            "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
            "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
        },
    ),
    "Imu": (
        "Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n",
        {
            "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
            "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
        },
    ),
}


@dataclass(frozen=True, slots=True)
class Recorded:
    """A message as it is recorded; type: package/Type."""

    topic: str
    type: str
    log_ns: int
    data: bytes
    latched: bool = False


class Body:
    """Serialises a message; `cdr` aligns and ends strings with NUL, `ros1` does neither."""

    def __init__(self, encoding: str) -> None:
        self.cdr = encoding == "cdr"
        self.data = bytearray(b"\x00\x01\x00\x00" if self.cdr else b"")

    def put(self, code: str, *values: float) -> Body:
        """Numbers of one kind."""
        size = struct.calcsize(code)
        for value in values:
            if self.cdr:
                self.data += bytes((4 - len(self.data)) % size)
            self.data += struct.pack("<" + code, value)
        return self

    def time(self, ns: int) -> Body:
        """A time."""
        return self.put("I", ns // NS_PER_S, ns % NS_PER_S)

    def text(self, text: str) -> Body:
        """A string."""
        raw = text.encode() + (b"\0" if self.cdr else b"")
        return self.blob(raw)

    def blob(self, raw: bytes) -> Body:
        """A sequence of bytes."""
        self.put("I", len(raw))
        return self.raw(raw)

    def raw(self, raw: bytes) -> Body:
        """A fixed array of bytes."""
        self.data += raw
        return self

    def header(self, stamp_ns: int, frame: str = "") -> Body:
        """A std_msgs/Header."""
        if not self.cdr:
            self.put("I", 7)
        return self.time(stamp_ns).text(frame)

    def done(self) -> bytes:
        """The message."""
        return bytes(self.data)


def packet_message(encoding: str, payload: bytes) -> bytes:
    """An Ouster packet."""
    return Body(encoding).blob(payload).done()


def transforms_message(
    encoding: str, edges: Sequence[tuple[str, str, Sequence[float], Sequence[float]]]
) -> bytes:
    """A TFMessage of (parent, child, translation, quaternion xyzw)."""
    body = Body(encoding).put("I", len(edges))
    for parent, child, translation, rotation in edges:
        body.header(0, parent).text(child).put("d", *translation).put("d", *rotation)
    return body.done()


def imu_message(encoding: str, stamp_ns: int, frame: str, up: float) -> bytes:
    """A sensor_msgs/Imu at rest."""
    body = Body(encoding).header(stamp_ns, frame).put("d", 0, 0, 0, 1, *[0.0] * 9)
    return body.put("d", 0, 0, 0, *[0.0] * 9).put("d", 0, 0, up, *[0.0] * 9).done()


def definition(type_name: str, encoding: str) -> str:
    """The definition that recording tools store with a type; "" for types not in TEXTS."""
    main, needed = TEXTS.get(type_name.rpartition("/")[2], ("", {}))
    parts = dict(needed)
    if "Header header" in main + "".join(needed.values()):
        parts["std_msgs/Header"] = HEADERS[encoding]
    if encoding == "cdr":
        main = main.replace("Header header", "std_msgs/Header header")
        parts = {k: v.replace("Header header", "std_msgs/Header header") for k, v in parts.items()}
        if "std_msgs/Header" in parts:
            parts["builtin_interfaces/Time"] = "int32 sec\nuint32 nanosec\n"
    return main + "".join(f"{BREAK}\nMSG: {name}\n{text}" for name, text in parts.items())


def found_in(topic: Topic, data: U8Array, begin: int, end: int, log_ns: int = 0) -> PacketsFound:
    """What is found in the message `data[begin:end]`; MessageError if it cannot be read."""
    places = (np.array([value], np.int64) for value in (begin, end, log_ns))
    found = Unpacker(topic).find_many(data, *places)
    if found.faults:
        raise MessageError(f"{topic.name}: {found.faults[0][1]}")
    return found


@lru_cache(maxsize=1)
def fixture_packets() -> tuple[tuple[str, int, bytes], ...]:
    """(topic, receive time in ns, payload) of every lidar and IMU packet of the two lidars."""
    names = {"10.5.5.87": LEFT.name, "10.5.5.88": RIGHT.name}
    tails = {7502: "lidar_packets", 7503: "imu_packets"}
    table = StreamTable()
    found = []
    for batch in open_recording(FOLDER / "two_lidars.pcap", table).packets():
        for number, host_ns, payload in reading.packets_in(batch):
            stream = table.streams[number]
            if stream.source_ip in names and stream.port in tails:
                topic = f"/{names[stream.source_ip]}/ouster/{tails[stream.port]}"
                found.append((topic, host_ns, payload))
    return tuple(found)


def fixture_messages(encoding: str, packet_type: str = "") -> list[Recorded]:
    """The two lidars as their drivers record them: packets, metadata, transforms, an IMU."""
    packets = fixture_packets()
    first_ns = packets[0][1]
    kind = packet_type or ("ouster_sensor_msgs/PacketMsg" if encoding == "cdr" else OUSTER_ROS1)
    transforms = "tf2_msgs/TFMessage"
    found = []
    for lidar in (LEFT, RIGHT):
        text = Body(encoding).text(json.dumps(lidar.metadata)).done()
        topic = f"/{lidar.name}/ouster/metadata"
        found.append(Recorded(topic, "std_msgs/String", first_ns, text, latched=True))
        edge = transforms_message(encoding, [_mounting(lidar)])
        found.append(Recorded("/tf_static", transforms, first_ns, edge, latched=True))
    found += [
        Recorded(topic, kind, host_ns, packet_message(encoding, payload))
        for topic, host_ns, payload in packets
    ]
    found += [
        Recorded("/imu/data", "sensor_msgs/Imu", at, imu_message(encoding, at, "imu", 9.80665))
        for at in range(first_ns, packets[-1][1], 10_000_000)
    ]
    return sorted(found, key=lambda message: message.log_ns)


def _mounting(lidar: FixtureLidar) -> tuple[str, str, Sequence[float], Sequence[float]]:
    """base_link to the sensor frame, as its driver names it."""
    return "base_link", f"{lidar.name}/os_sensor", lidar.translation_m, quaternion(lidar.rpy_deg)


def quaternion(rpy_deg: Sequence[float]) -> tuple[float, float, float, float]:
    """Quaternion xyzw of rotations about the fixed axes x, y, z."""
    (cr, cp, cy), (sr, sp, sy) = (
        [function(radians(angle) / 2) for angle in rpy_deg] for function in (cos, sin)
    )
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
