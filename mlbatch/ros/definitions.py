"""Definitions of messages: a table of our own, from the recording, from `rosbags`.

The syntax is that of .msg files (ROS 1 and ROS 2), whose dependencies follow the main text after a
line of `=` and one of `MSG: package/Type`. Types of drivers: docs/sources/messages.md, section 1;
others: common_interfaces and geometry2 of ROS 2 Humble, section 4 of docs/sources/outputs.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from mlbatch.types import Topic

# Built-in types: bytes, alignment in CDR, codes of `struct`. A time is two words.
PRIMITIVES: Mapping[str, tuple[int, int, str]] = {
    "bool": (1, 1, "?"),
    "byte": (1, 1, "B"),
    "char": (1, 1, "B"),
    "int8": (1, 1, "b"),
    "uint8": (1, 1, "B"),
    "int16": (2, 2, "h"),
    "uint16": (2, 2, "H"),
    "int32": (4, 4, "i"),
    "uint32": (4, 4, "I"),
    "int64": (8, 8, "q"),
    "uint64": (8, 8, "Q"),
    "float32": (4, 4, "f"),
    "float64": (8, 8, "d"),
    "time": (8, 4, "Ii"),
    "duration": (8, 4, "ii"),
}
STRINGS = ("string", "wstring")
_ALIASES = {
    "builtin_interfaces/Time": "time",
    "builtin_interfaces/Duration": "duration",
    "Header": "std_msgs/Header",
}
_TIMES = re.compile(r"^(builtin_interfaces/\w+) ", re.MULTILINE)
_RULE = re.compile(r"^=+[ \t]*\r?$", re.MULTILINE)
_FIELD = re.compile(r"^([\w/]+)(?:<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=?)", re.ASCII)
_BREAK = "=" * 80
# Definitions come with the recording. The longest of ROS have some 10 kB; no array is as long.
_MOST_CHARACTERS = 400_000
_MOST_DIGITS = 12


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message; count: None for a single value, SEQUENCE, or number of elements."""

    name: str
    type: str
    count: int | None = None


Definitions: TypeAlias = Mapping[str, tuple[Field, ...]]
SEQUENCE = -1

# A `;` ends a field. std_msgs/Header is that of ROS 2; ROS 1 counts messages, too.
_TABLE = """
builtin_interfaces/Time: int32 sec; uint32 nanosec
std_msgs/Header: builtin_interfaces/Time stamp; string frame_id
ouster_ros/PacketMsg: uint8[] buf
ouster_msgs/PacketMsg: uint8[] buf
ouster_sensor_msgs/PacketMsg: uint8[] buf
velodyne_msgs/VelodyneScan: std_msgs/Header header; velodyne_msgs/VelodynePacket[] packets
velodyne_msgs/VelodynePacket: builtin_interfaces/Time stamp; uint8[1206] data
hesai_lidar/PandarScan: std_msgs/Header header; hesai_lidar/PandarPacket[] packets
hesai_lidar/PandarPacket: builtin_interfaces/Time stamp; uint8[] data; uint32 size
pandar_msgs/PandarScan: std_msgs/Header header; pandar_msgs/PandarPacket[] packets
pandar_msgs/PandarPacket: builtin_interfaces/Time stamp; uint8[1500] data; uint32 size
pandar_msgs/PandarJumboPacket: builtin_interfaces/Time stamp; uint8[] data; uint32 size
hesai_ros_driver/UdpFrame: std_msgs/Header header; hesai_ros_driver/UdpPacket[] packets
hesai_ros_driver/UdpPacket: builtin_interfaces/Time stamp; uint8[] data; uint32 size
nebula_msgs/NebulaPackets: std_msgs/Header header; nebula_msgs/NebulaPacket[] packets
nebula_msgs/NebulaPacket: builtin_interfaces/Time stamp; uint8[] data
rslidar_msg/RslidarPacket: std_msgs/Header header; uint8 is_difop; uint8 is_frame_begin; \
uint8[] data
rslidar_msgs/rslidarScan: std_msgs/Header header; rslidar_msgs/rslidarPacket[] packets
rslidar_msgs/rslidarPacket: builtin_interfaces/Time stamp; uint8[1248] data
robosense_msgs/RobosenseScan: std_msgs/Header header; robosense_msgs/RobosensePacket[] packets
robosense_msgs/RobosensePacket: builtin_interfaces/Time stamp; uint8[1248] data
robosense_msgs/RobosenseInfoPacket: string lidar_model; robosense_msgs/RobosensePacket packet
udp_msgs/UdpPacket: std_msgs/Header header; string address; uint16 src_port; uint8[] data
std_msgs/String: string data
std_msgs/MultiArrayDimension: string label; uint32 size; uint32 stride
std_msgs/MultiArrayLayout: std_msgs/MultiArrayDimension[] dim; uint32 data_offset
std_msgs/UInt8MultiArray: std_msgs/MultiArrayLayout layout; uint8[] data
geometry_msgs/Vector3: float64 x; float64 y; float64 z
geometry_msgs/Quaternion: float64 x; float64 y; float64 z; float64 w
geometry_msgs/Transform: geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation
geometry_msgs/TransformStamped: std_msgs/Header header; string child_frame_id; \
geometry_msgs/Transform transform
tf2_msgs/TFMessage: geometry_msgs/TransformStamped[] transforms
tf/tfMessage: geometry_msgs/TransformStamped[] transforms
sensor_msgs/PointField: uint8 INT8=1; uint8 UINT8=2; uint8 INT16=3; uint8 UINT16=4; \
uint8 INT32=5; uint8 UINT32=6; uint8 FLOAT32=7; uint8 FLOAT64=8; \
string name; uint32 offset; uint8 datatype; uint32 count
sensor_msgs/PointCloud2: std_msgs/Header header; uint32 height; uint32 width; \
sensor_msgs/PointField[] fields; bool is_bigendian; uint32 point_step; uint32 row_step; \
uint8[] data; bool is_dense
sensor_msgs/Imu: std_msgs/Header header; geometry_msgs/Quaternion orientation; \
float64[9] orientation_covariance; geometry_msgs/Vector3 angular_velocity; \
float64[9] angular_velocity_covariance; geometry_msgs/Vector3 linear_acceleration; \
float64[9] linear_acceleration_covariance
"""
# Other forms of types in the table, which recordings without definitions may have.
_VARIANTS = {
    "robosense_msgs/RobosensePacket": (
        "builtin_interfaces/Time stamp; uint8 is_difop; uint8[1500] data; uint32 size"
    ),
}
# Datatypes of a PointField by numpy type.
FIELD_CODES = {"u1": 2, "<u2": 4, "<u4": 6, "<f4": 7, "<f8": 8}
_ROS1_HEADER = "uint32 seq\ntime stamp\nstring frame_id"


def type_key(name: str) -> str:
    """One key for `pkg/msg/Type` of ROS 2 and `pkg/Type` of ROS 1."""
    package, _, rest = name.partition("/")
    return f"{package}/{rest.removeprefix('msg/')}" if rest else name


# -- reading --------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def definitions_of(topic: Topic) -> Definitions:
    """All types in a topic's messages; definitions in the recording win over ours."""
    if len(topic.definition) > _MOST_CHARACTERS:
        return _ours(topic.encoding)
    if topic.format == "ros2idl":
        return {**_ours(topic.encoding), **_parse_idl(topic.definition)}
    return {**_ours(topic.encoding), **parse(topic.definition, type_key(topic.type))}


def variants_of(topic: Topic) -> list[Definitions]:
    """Other forms of the types of a topic whose definition is assumed, by our table."""
    ours = definition_text(topic.type)
    if topic.definition.strip() not in ("", ours.strip()):
        return []
    return [
        {**definitions_of(topic), name: parse(fields.replace("; ", "\n"), name)[name]}
        for name, fields in _VARIANTS.items()
        if name == type_key(topic.type) or f"MSG: {name}\n" in ours
    ]


def parse(text: str, root: str) -> dict[str, tuple[Field, ...]]:
    """Types of a .msg text with its dependencies; none for an empty text."""
    found: dict[str, tuple[Field, ...]] = {}
    for number, part in enumerate(_RULE.split(text)):
        name = root
        body = part.strip()
        if number:
            first, _, body = body.partition("\n")
            name = type_key(first.removeprefix("MSG:").strip())
        # A blank text means that none was stored, not a type without fields.
        if text.strip():
            found[name] = tuple(_fields(body, name.partition("/")[0]))
    return found


def _fields(text: str, package: str) -> Iterator[Field]:
    for line in text.splitlines():
        match = _FIELD.match(line.strip())
        # `=` follows the name of a constant, which takes no bytes.
        if match is None or match[4]:
            continue
        array = match[2]
        count = None
        if array is not None:
            digits = array.strip("[]")
            count = int(digits[:_MOST_DIGITS]) if digits.isdigit() else SEQUENCE
        yield Field(match[3], resolve(match[1], package), count)


def resolve(name: str, package: str) -> str:
    """The key of a type that a definition of `package` names."""
    key = type_key(name)
    if key in PRIMITIVES or key in STRINGS:
        return key
    return _ALIASES.get(key, key if "/" in key else f"{package}/{key}")


@lru_cache(maxsize=1)
def _table() -> dict[str, str]:
    """Text of each type of the table, one field per line."""
    rows = (line.partition(": ") for line in _TABLE.strip().splitlines())
    return {name: fields.replace("; ", "\n") for name, _, fields in rows}


@lru_cache(maxsize=2)
def _ours(encoding: str) -> dict[str, tuple[Field, ...]]:
    """The types of the table."""
    texts = dict(_table())
    if encoding == "ros1":
        texts["std_msgs/Header"] = _ROS1_HEADER
    return {name: parse(text, name)[name] for name, text in texts.items()}


# -- texts for ROS 2 ------------------------------------------------------------------------------


def is_known(name: str) -> bool:
    """Whether message `pkg/Type` is in the table, or else known to `rosbags`."""
    return name in _table() or bool(_rosbags_definition(name))


def definition(name: str) -> str:
    """The definition of message `pkg/Type`, followed by all it consists of (depth first)."""
    if name not in _table():
        return _rosbags_definition(name)
    return _with_dependencies(name, _depth_first(name, [])[1:], _table())


def definition_text(type_name: str, encoding: str = "cdr") -> str:
    """The table's definition of a recorded type, followed by all it consists of (breadth first).

    Without constants; "" for types that are not in the table. encoding: `ros1` for that of ROS 1.
    """
    root = type_key(type_name)
    table = _table()
    if root not in table:
        return ""
    needed = [root]
    for name in needed:
        needed += [part for part in _parts(name) if part not in needed]
    plain = {
        name: "\n".join(line for line in table[name].splitlines() if "=" not in line)
        for name in needed
    }
    if encoding == "ros1":
        # There a time is a built-in type.
        needed = [name for name in needed if name not in _ALIASES]
        plain = {name: _TIMES.sub(_ros1_time, text) for name, text in plain.items()}
        plain["std_msgs/Header"] = _ROS1_HEADER
    return _with_dependencies(root, needed[1:], plain)


def _ros1_time(match: re.Match[str]) -> str:
    return f"{_ALIASES[match[1]]} "


def _with_dependencies(root: str, others: list[str], texts: Mapping[str, str]) -> str:
    parts = [f"{_BREAK}\nMSG: {name}\n{texts[name]}\n" for name in others]
    return f"{texts[root]}\n" + "".join(parts)


def _parts(name: str) -> list[str]:
    """The types of the table that a type consists of, in order."""
    table = _table()
    words = (line.partition(" ")[0].partition("[")[0] for line in table[name].splitlines())
    return [word for word in dict.fromkeys(words) if word in table]


def _depth_first(name: str, known: list[str]) -> list[str]:
    """`known` with `name` and all it consists of added, each once."""
    known.append(name)
    for part in _parts(name):
        if part not in known:
            _depth_first(part, known)
    return known


@lru_cache(maxsize=256)
def _rosbags_definition(name: str) -> str:
    """The definition of a ROS 2 message by the type store of `rosbags`; "" if it has none."""
    from rosbags.typesys import Stores, TypesysError, get_typestore

    package, _, rest = type_key(name).partition("/")
    try:
        text, _ = get_typestore(Stores.ROS2_HUMBLE).generate_msgdef(
            f"{package}/msg/{rest}", ros_version=2
        )
    except TypesysError:
        return ""
    return text


# -- quality of service ---------------------------------------------------------------------------

# Words that ROS 2 Jazzy and later write; the index is the number (rmw/types.h).
_QOS_WORDS = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        "system_default",
        "automatic",
        "manual_by_node",
        "manual_by_topic",
        "unknown",
        "best_available",
    ),
}
_QOS_LINE = re.compile(rf"\b({'|'.join(_QOS_WORDS)}): ([a-z_]+)")


def qos(latched: bool) -> str:
    """QoS of a reliable topic as a YAML list; integers, since Humble cannot read words.

    latched: transient local, so that late subscribers get `/tf_static`.
    """
    infinite = "  sec: 9223372036\n    nsec: 854775807"
    return (
        "- history: 1\n"
        f"  depth: {1 if latched else 10}\n"
        "  reliability: 1\n"
        f"  durability: {1 if latched else 2}\n"
        f"  deadline:\n  {infinite}\n"
        f"  lifespan:\n  {infinite}\n"
        "  liveliness: 1\n"
        f"  liveliness_lease_duration:\n  {infinite}\n"
        "  avoid_ros_namespace_conventions: false\n"
    )


def qos_in_numbers(text: str) -> str:
    """A recorded QoS text with numbers for words, since Humble cannot read words."""

    def number(match: re.Match[str]) -> str:
        policy, word = match.groups()
        words = _QOS_WORDS[policy]
        return f"{policy}: {words.index(word)}" if word in words else match[0]

    return _QOS_LINE.sub(number, text)


# -- IDL ------------------------------------------------------------------------------------------
# OMG IDL 4.2 as ROS 2 derives it (schema encoding `ros2idl`): only what generated files contain,
# modules, structs, typedefs of arrays, sequences and strings.

# Unclosed text extends to the end: trying again at every place would take hours.
_IDL_NOISE = re.compile(
    r"//[^\n]*|/\*.*?(?:\*/|\Z)|^[ \t]*#[^\n]*|^=+\s*$|^IDL:[^\n]*"
    r"|@\w+\s*(\((\"(\\.|[^\"\\])*(?:\"|\\?\Z)|[^()\"])*\)?)?",
    re.MULTILINE | re.DOTALL,
)
_IDL_TOKEN = re.compile(r"\"(?:\\.|[^\"\\])*(?:\"|\\?\Z)|[\w:.+-]+|[{}<>\[\];,=()]")
_IDL_WORDS = {
    "boolean": "bool",
    "octet": "uint8",
    "float": "float32",
    "double": "float64",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
}


def _parse_idl(text: str) -> dict[str, tuple[Field, ...]]:
    """Types of an IDL text; everything but structs and typedefs is ignored."""
    found: dict[str, tuple[Field, ...]] = {}
    aliases: dict[str, Field] = {}
    scope: list[str] = []
    statement: list[str] = []
    fields: list[Field] | None = None
    for token in _IDL_TOKEN.findall(_IDL_NOISE.sub(" ", text)):
        if token == "{":
            scope.append(statement[-1] if statement else "")
            fields = [] if statement[:1] == ["struct"] else fields
        elif token == "}" and scope:
            name = scope.pop()
            if fields is not None:
                found[f"{scope[0] if scope else ''}/{name}"] = tuple(fields)
                fields = None
        elif token != ";":
            statement.append(token)
            continue
        elif statement[:1] == ["typedef"] and len(statement) > 2:
            alias = _idl_member(statement[1:], scope, aliases)
            aliases[alias.name] = alias
        elif fields is not None and statement:
            fields.append(_idl_member(statement, scope, aliases))
        statement = []
    return found


def _idl_member(words: list[str], scope: list[str], aliases: dict[str, Field]) -> Field:
    """A field (or typedef) from its words: type, name and perhaps [count]."""
    count: int | None = None
    if words[-1] == "]" and len(words) > 4 and words[-2].isdecimal():
        count = int(words[-2][:_MOST_DIGITS])
        words = words[:-3]
    name = words[-1]
    kind = words[:-1]
    if kind[:2] == ["sequence", "<"]:
        kind = kind[2:-1]
        count = SEQUENCE
        kind = kind[: kind.index(",")] if "," in kind else kind
    kind = kind[: kind.index("<")] if "<" in kind else kind
    text = " ".join(kind)
    alias = aliases.get(text.rpartition("::")[2])
    if alias is not None:
        return Field(name, alias.type, alias.count if count is None else count)
    word = _IDL_WORDS.get(text, text)
    package = scope[0] if scope else ""
    return Field(
        name, word if word in PRIMITIVES else resolve(word.replace("::", "/"), package), count
    )
