"""Messages that describe sensors: texts, calibration files and transforms, from their raw bytes.

Types: docs/sources/messages.md, sections 2 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from mlbatch.errors import RecordingError
from mlbatch.ros.definitions import definitions_of, type_key
from mlbatch.ros.encoding import Leaf, MessageError, MessageReader
from mlbatch.types import Topic

Transform: TypeAlias = tuple[
    str, str, tuple[float, float, float], tuple[float, float, float, float]
]


def decode_string(topic: Topic, data: bytes) -> str:
    """The text of a std_msgs/String."""
    return str(_leaves(topic, data).get("data", ""))


def decode_bytes(topic: Topic, data: bytes) -> bytes:
    """The bytes of a std_msgs/UInt8MultiArray."""
    leaf = _leaves(topic, data).get("data", b"")
    return leaf if isinstance(leaf, bytes) else b""


def decode_transforms(topic: Topic, data: bytes) -> list[Transform]:
    """(parent, child, translation in m, quaternion xyzw) of a TFMessage; no leading slashes."""
    leaves = _leaves(topic, data)
    found: list[Transform] = []
    try:
        while f"transforms.{len(found)}.child_frame_id" in leaves:
            found.append(_transform(leaves, f"transforms.{len(found)}"))
    except KeyError as err:
        raise RecordingError(
            f"{topic.name}: expected transforms of frames, found a definition without {err}; "
            "this variant of the message is not supported"
        ) from err
    return found


def _transform(leaves: Mapping[str, Leaf], prefix: str) -> Transform:
    """A geometry_msgs/TransformStamped; KeyError for a field that is missing."""
    x, y, z = (_value(leaves, f"{prefix}.transform.translation.{axis}") for axis in "xyz")
    qx, qy, qz, qw = (_value(leaves, f"{prefix}.transform.rotation.{axis}") for axis in "xyzw")
    parent = _text(leaves, f"{prefix}.header.frame_id")
    child = _text(leaves, f"{prefix}.child_frame_id")
    return parent, child, (x, y, z), (qx, qy, qz, qw)


def _leaves(topic: Topic, data: bytes) -> dict[str, Leaf]:
    try:
        reader = MessageReader(definitions_of(topic), topic.encoding, data, 0, len(data))
        return reader.leaves(type_key(topic.type))
    except (MessageError, KeyError) as err:
        raise RecordingError(f"{topic.name}: {err}") from err


def _value(leaves: Mapping[str, Leaf], name: str) -> float:
    value = leaves.get(name)
    if not isinstance(value, int | float):
        raise KeyError(name)
    return float(value)


def _text(leaves: Mapping[str, Leaf], name: str) -> str:
    value = leaves.get(name)
    if not isinstance(value, str):
        raise KeyError(name)
    return value.lstrip("/")
