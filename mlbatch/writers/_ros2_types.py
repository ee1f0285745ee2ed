"""ROS 2 message definitions as `ros2msg` text, and QoS text (facts/outputs.md, section 4).

Fields and their order: common_interfaces, rcl_interfaces and geometry2 of ROS 2 Humble.
"""

from __future__ import annotations

import re

_SEPARATOR = "=" * 80

_FIELDS = {
    "builtin_interfaces/Time": ("int32 sec", "uint32 nanosec"),
    "std_msgs/Header": ("builtin_interfaces/Time stamp", "string frame_id"),
    "geometry_msgs/Vector3": ("float64 x", "float64 y", "float64 z"),
    "geometry_msgs/Quaternion": ("float64 x", "float64 y", "float64 z", "float64 w"),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation",
        "geometry_msgs/Quaternion rotation",
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header",
        "string child_frame_id",
        "geometry_msgs/Transform transform",
    ),
    "tf2_msgs/TFMessage": ("geometry_msgs/TransformStamped[] transforms",),
    "sensor_msgs/PointField": (
        "uint8 INT8=1",
        "uint8 UINT8=2",
        "uint8 INT16=3",
        "uint8 UINT16=4",
        "uint8 INT32=5",
        "uint8 UINT32=6",
        "uint8 FLOAT32=7",
        "uint8 FLOAT64=8",
        "string name",
        "uint32 offset",
        "uint8 datatype",
        "uint32 count",
    ),
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header",
        "uint32 height",
        "uint32 width",
        "sensor_msgs/PointField[] fields",
        "bool is_bigendian",
        "uint32 point_step",
        "uint32 row_step",
        "uint8[] data",
        "bool is_dense",
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header",
        "geometry_msgs/Quaternion orientation",
        "float64[9] orientation_covariance",
        "geometry_msgs/Vector3 angular_velocity",
        "float64[9] angular_velocity_covariance",
        "geometry_msgs/Vector3 linear_acceleration",
        "float64[9] linear_acceleration_covariance",
    ),
}

# Numbers of the words that recorders from Jazzy on write (rmw/types.h).
_QOS_WORDS = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        *("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown"),
        "best_available",
    ),
}
_QOS_LINE = re.compile(rf"\b({'|'.join(_QOS_WORDS)}): ([a-z_]+)")

# Codes of PointField for numpy types.
FIELD_CODES = {"u1": 2, "<u2": 4, "<u4": 6, "<f4": 7, "<f8": 8}


def is_known(name: str) -> bool:
    """Whether the definition of message `pkg/Type` is among ours."""
    return name in _FIELDS


def definition(name: str) -> str:
    """The definition of message `pkg/Type`, followed by all it is made of."""
    main, *others = _parts(name, [])
    return _lines(main) + "".join(f"{_SEPARATOR}\nMSG: {part}\n{_lines(part)}" for part in others)


def _lines(part: str) -> str:
    return "\n".join(_FIELDS[part]) + "\n"


def _parts(name: str, known: list[str]) -> list[str]:
    """`known` with `name` and the types of its fields added, each once."""
    known.append(name)
    for line in _FIELDS[name]:
        part = line.split()[0].split("[")[0]
        if part in _FIELDS and part not in known:
            _parts(part, known)
    return known


def qos(latched: bool) -> str:
    """QoS of a reliable topic as a YAML list; integers, since Humble reads no words.

    latched: transient local, so that late subscribers get `/tf_static`.
    """
    forever = "  sec: 9223372036\n    nsec: 854775807"
    return (
        "- history: 1\n"
        f"  depth: {1 if latched else 10}\n"
        "  reliability: 1\n"
        f"  durability: {1 if latched else 2}\n"
        f"  deadline:\n  {forever}\n"
        f"  lifespan:\n  {forever}\n"
        "  liveliness: 1\n"
        f"  liveliness_lease_duration:\n  {forever}\n"
        "  avoid_ros_namespace_conventions: false\n"
    )


def qos_in_numbers(text: str) -> str:
    """A recorder's QoS text with numbers for words, since Humble reads no words."""

    def number(match: re.Match[str]) -> str:
        policy, word = match.groups()
        words = _QOS_WORDS[policy]
        return f"{policy}: {words.index(word)}" if word in words else match[0]

    return _QOS_LINE.sub(number, text)
