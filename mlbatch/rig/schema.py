"""Single values of a rig file: each function reads one, checks it and converts its units.

Format: docs/rig.md.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import TypeVar

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError, UsageError
from mlbatch.frames.transforms import from_quaternion, from_rpy_deg, rigid
from mlbatch.rig.yaml_tree import Node
from mlbatch.units import NS_PER_S, parse_rate

# Beyond, float32 coordinates no longer resolve a millimetre.
MAX_TRANSLATION_M = 10_000.0
MAX_OFFSET_S = 2**31

EXTRINSICS_KEYS = ("translation_m", "rotation_rpy_deg", "rotation_xyzw", "matrix", "frame")
# What each key of the extrinsics or of a stream already says, so that it cannot be given as well.
EXCLUDES = {
    "rotation_xyzw": ("rotation_rpy_deg",),
    "matrix": ("translation_m", "rotation_rpy_deg", "rotation_xyzw"),
    "frame": ("translation_m", "rotation_rpy_deg", "rotation_xyzw", "matrix"),
    "topic": ("source_ip", "port"),
}

_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_FRAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TEXT = re.compile(r"\S(.*\S)?")
# Neither blanks nor control characters, nor halves of characters, which no output could hold.
_WORD = re.compile(r"[^\s\x00-\x1f\x7f-\x9f\ud800-\udfff]+")

T = TypeVar("T")
D = TypeVar("D")


def take(fields: Mapping[str, Node], key: str, read: Callable[[Node], T], default: D) -> T | D:
    """The value under `key`, or the default where the key is absent."""
    return read(fields[key]) if key in fields else default


def sensor_name(node: Node) -> str:
    """A name that fits ROS topics, frames and file names."""
    return node.word("a name of letters, digits and _ that begins with no digit", _NAME)


def frame_name(node: Node) -> str:
    """Name of the body frame; robots in a fleet put theirs before a slash."""
    return node.word("a frame name of letters, digits, _ and / that begins with no digit", _FRAME)


def model(node: Node) -> str | None:
    """Name of a sensor model; None for auto."""
    name = node.word("auto or a name from `mlbatch sensors`", _TEXT)
    return None if name == "auto" else name


def rate(node: Node) -> Fraction:
    """Scan rate, exactly the number in the text."""
    try:
        return parse_rate(node.word("a number of Hz", _TEXT))
    except UsageError as err:
        raise node.fault(str(err).removeprefix("rate: ")) from err


def ip_address(node: Node) -> str:
    """An IP address in its usual spelling."""
    text = node.word("an IP address", _WORD)
    try:
        return str(ipaddress.ip_address(text))
    except ValueError as err:
        raise node.error("an IP address", node.shown, "write it as 192.168.1.201") from err


def port(node: Node) -> int:
    """A UDP port."""
    return node.whole(1, 65535)


def topic(node: Node) -> str:
    """Name of a topic, whatever its recorder allowed."""
    return node.word("a topic without spaces", _WORD)


def serial(node: Node) -> str:
    """A serial number as it is written: leading zeros count."""
    return node.word("a serial number without spaces", _WORD)


def existing_file(node: Node) -> Path:
    """Path of a file, given relative to the rig file."""
    path = node.file.parent / node.word("a file name", _TEXT)
    if not os.path.isfile(path):
        remedy = "give its path relative to the rig file"
        raise node.error("an existing file", f"none at {str(path)!r}", remedy)
    return path


# Epochs that a rig may name; leap_seconds.py has how far they are ahead of UTC.
EPOCHS = ("utc", "tai", "gps")


def clock_source(node: Node) -> str:
    """Which clock stamps the columns."""
    return node.choice(("sensor", "host"))


def clock_epoch(node: Node) -> str:
    """What a sensor's clock counts."""
    return node.choice(EPOCHS)


def offset_ns(node: Node) -> int:
    """Clock offset in ns: exact to the digit, rounded once below 1 ns."""
    offset_s = node.exact()
    if abs(offset_s) > MAX_OFFSET_S:
        raise node.error(f"at most {MAX_OFFSET_S} s either way", node.shown, "give seconds")
    return round(offset_s * NS_PER_S)


def range_m(node: Node) -> float:
    """A limit of the range."""
    value = node.number()
    if value < 0:
        raise node.error("a range of 0 m or more", node.shown, "give metres from the sensor")
    return value


def options(node: Node) -> dict[str, str]:
    """A maker's options; their makers check them, so `on` stays `on`."""
    if node.kind != "mapping":
        raise node.error("a mapping of options", node.shown, "write {option: value}")
    return {key: value.word("one word", _WORD) for key, value in node.entries.items()}


def extrinsics(node: Node) -> F64Array | str:
    """(4, 4) body_from_sensor in metres, or the name of a frame of the recording."""
    fields = node.fields(EXTRINSICS_KEYS)
    if not fields:
        raise node.error(f"at least one of {', '.join(EXTRINSICS_KEYS)}", "none", "add one of them")
    check_exclusive(fields)
    if "frame" in fields:
        return fields["frame"].word("a frame of the recording", _WORD)
    origin = take(fields, "translation_m", _translation, [0.0, 0.0, 0.0])
    for key, read in _ROTATIONS.items():
        if key in fields:
            return read(fields[key], origin)
    return from_rpy_deg(origin, (0.0, 0.0, 0.0))


def check_exclusive(fields: Mapping[str, Node]) -> None:
    """Refuse two keys that say the same."""
    for key, others in EXCLUDES.items():
        for other in others:
            if key in fields and other in fields:
                got = f"{other} as well (line {fields[other].line})"
                raise fields[key].error(f"{key} without {other}", got, "keep one of the two")


def _translation(node: Node) -> list[float]:
    return [_near(item, value) for item, value in zip(node.items, node.numbers(3), strict=True)]


def _near(node: Node, value: float) -> float:
    if abs(value) > MAX_TRANSLATION_M:
        wanted = f"at most {MAX_TRANSLATION_M:g} m from the body origin"
        raise node.error(wanted, node.shown, "give metres in the body frame, not in the world")
    return value


def _from_rpy(node: Node, origin: list[float]) -> F64Array:
    return from_rpy_deg(origin, node.numbers(3))


def _from_xyzw(node: Node, origin: list[float]) -> F64Array:
    xyzw = node.numbers(4)
    return _placed(node, lambda: from_quaternion(origin, xyzw))


def _from_matrix(node: Node, origin: list[float]) -> F64Array:
    del origin  # The matrix holds its own.
    rows = node.elements("4 rows of 4 numbers")
    if len(rows) not in (3, 4):
        raise node.error("4 rows (or 3, without 0, 0, 0, 1)", node.shown, "give all rows")
    matrix = np.array([row.numbers(4) for row in rows])
    transform = _placed(node, lambda: rigid(matrix))
    for row in rows[:3]:
        _near(row.items[3], float(row.items[3].text))
    return transform


_ROTATIONS: dict[str, Callable[[Node, list[float]], F64Array]] = {
    "rotation_rpy_deg": _from_rpy,
    "rotation_xyzw": _from_xyzw,
    "matrix": _from_matrix,
}


def _placed(node: Node, build: Callable[[], F64Array]) -> F64Array:
    """What `build` gives; its error is told with the place of `node`."""
    try:
        return build()
    except RigError as err:
        raise node.fault(str(err)) from err


def boxes(node: Node) -> F64Array:
    """(k, 6) boxes: x0, y0, z0, x1, y1, z1 in metres."""
    return np.array([_box(item) for item in node.elements("boxes")]).reshape(-1, 6)


def _box(node: Node) -> list[float]:
    values = node.numbers(6)
    for axis, (low, high) in enumerate(zip(values[:3], values[3:], strict=True)):
        if low >= high:
            wanted = f"{'xyz'[axis]}0 < {'xyz'[axis]}1 in metres (x0, y0, z0, x1, y1, z1)"
            raise node.error(wanted, f"{low:g} and {high:g}", "swap the corners")
    return values
