"""Messages that tell of sensors: texts, calibration files and transforms, from their raw bytes.

Types: facts/messages.md, sections 2 and 6.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

from mlbatch.errors import RecordingError
from mlbatch.ros.definitions import definitions_of, type_key
from mlbatch.ros.encoding import Cursor, Leaf, MessageError
from mlbatch.types import Topic

Transform: TypeAlias = tuple[
    str, str, tuple[float, float, float], tuple[float, float, float, float]
]
_FRAMES = ("header.frame_id", "child_frame_id")


def decode_string(topic: Topic, data: bytes) -> str:
    """The text of a std_msgs/String."""
    return str(_leaves(topic, data).get("data", ""))


def decode_bytes(topic: Topic, data: bytes) -> bytes:
    """The bytes of a std_msgs/UInt8MultiArray."""
    found = _leaves(topic, data).get("data", b"")
    return found if isinstance(found, bytes) else b""


def decode_transforms(topic: Topic, data: bytes) -> list[Transform]:
    """(parent, child, translation in m, quaternion xyzw) of a TFMessage; no leading slashes."""
    leaves = _leaves(topic, data)
    found: list[Transform] = []
    while f"transforms.{len(found)}.child_frame_id" in leaves:
        prefix = f"transforms.{len(found)}"
        try:
            x, y, z = (_value(leaves, f"{prefix}.transform.translation.{a}") for a in "xyz")
            qx, qy, qz, qw = (_value(leaves, f"{prefix}.transform.rotation.{a}") for a in "xyzw")
            parent, child = (_text(leaves, f"{prefix}.{name}") for name in _FRAMES)
        except KeyError as err:
            raise RecordingError(
                f"{topic.name}: wanted transforms of frames, got a definition without {err}; "
                "this variant of the message is not known"
            ) from err
        found.append((parent, child, (x, y, z), (qx, qy, qz, qw)))
    return found


def _leaves(topic: Topic, data: bytes) -> dict[str, Leaf]:
    try:
        cursor = Cursor(definitions_of(topic), topic.encoding, memoryview(data), 0, len(data))
        return cursor.leaves(type_key(topic.type))
    except (MessageError, KeyError) as err:
        raise RecordingError(f"{topic.name}: {err}") from err


def _value(leaves: Mapping[str, Leaf], name: str) -> float:
    """A number of a message whose definition may lack it."""
    value = leaves.get(name)
    if not isinstance(value, int | float):
        raise KeyError(name)
    return float(value)


def _text(leaves: Mapping[str, Leaf], name: str) -> str:
    value = leaves.get(name)
    if not isinstance(value, str):
        raise KeyError(name)
    return value.lstrip("/")
