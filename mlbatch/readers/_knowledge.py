"""Messages that tell of sensors: texts, calibration files and transforms, from their raw bytes.

Types: facts/messages.md, sections 2 and 6.
"""

from __future__ import annotations

from typing import TypeAlias

from mlbatch.errors import RecordingError
from mlbatch.readers._cdr import Cursor, Leaf, MessageError
from mlbatch.readers._definitions import definitions_of, type_key
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
        place = f"{prefix}.transform"
        x, y, z = (float(leaves[f"{place}.translation.{axis}"]) for axis in "xyz")
        qx, qy, qz, qw = (float(leaves[f"{place}.rotation.{axis}"]) for axis in "xyzw")
        parent, child = (str(leaves[f"{prefix}.{name}"]) for name in _FRAMES)
        found.append((parent.lstrip("/"), child.lstrip("/"), (x, y, z), (qx, qy, qz, qw)))
    return found


def _leaves(topic: Topic, data: bytes) -> dict[str, Leaf]:
    try:
        cursor = Cursor(definitions_of(topic), topic.encoding, memoryview(data), 0, len(data))
        return cursor.leaves(type_key(topic.type))
    except (MessageError, KeyError) as err:
        raise RecordingError(f"{topic.name}: {err}") from err
