"""Folders of PLY files: points and times, but no columns.

The format: docs/formats.md; G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mlbatch.outputs.commented import CommentedReader, Fields
from mlbatch.outputs.comments import ScanComments
from mlbatch.outputs.damage import DamageError

SUFFIX = ".ply"
_TYPES = {"float": "<f4", "double": "<f8", "int": "<i4", "uchar": "u1"}
_XYZ = {"x": "float", "y": "float", "z": "float"}
_STANDARD = {
    "intensity": "float",
    "time": "double",
    "ring": "int",
    "return_type": "uchar",
    "lidar_id": "uchar",
}
_HEAD = "ply\nformat binary_little_endian 1.0\ncomment mlbatch "
_END = b"end_header\n"
_LONGEST_HEAD = 1 << 20
_VERTICES = re.compile(r"element vertex (\d{1,19})", re.ASCII)


@dataclass(frozen=True, slots=True)
class _Style:
    """Properties of a `--ply-style`; prefix: of their names, apart from coordinates."""

    prefix: str
    properties: Mapping[str, str]

    @property
    def vertex(self) -> np.dtype[np.void]:
        """A vertex; x, y and z also as one field xyz."""
        names = list(self.properties)
        types = [np.dtype(_TYPES[kind]) for kind in self.properties.values()]
        sizes = [one.itemsize for one in types]
        return np.dtype(
            {
                "names": ["xyz", *names],
                "formats": [("<f4", 3), *types],
                "offsets": [0, *(sum(sizes[:number]) for number in range(len(sizes)))],
                "itemsize": sum(sizes),
            }
        )


_STYLES = (
    _Style("", _XYZ | _STANDARD),
    _Style("scalar_", _XYZ | {f"scalar_{name}": kind for name, kind in _STANDARD.items()}),
    _Style("", _XYZ | {"time": "float"}),
)


class PlyReader(CommentedReader):
    """Reads the files of one folder."""

    __slots__ = ()

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and vertices of a file."""
        comments, style, vertices, begin = _head(data)
        vertex = style.vertex
        if len(data) != begin + vertices * vertex.itemsize:
            expected = f"{vertices} vertices of {vertex.itemsize} bytes"
            raise DamageError(expected, f"{len(data) - begin} bytes after the header")
        points = np.frombuffer(data, vertex, vertices, begin)
        fields = {
            name: points[style.prefix + name]
            for name in _STANDARD
            if style.prefix + name in style.properties
        }
        return comments, {"xyz": points["xyz"], **fields}


def _head(data: bytes) -> tuple[ScanComments, _Style, int, int]:
    """Comments, properties, number of vertices, and offset of the first one."""
    end = data.find(_END, 0, _LONGEST_HEAD)
    text = data[: max(end, 0)].decode("utf-8", "replace")
    if not text.startswith(_HEAD):
        raise DamageError("the header of a binary PLY file of mlbatch", repr(text[:60]))
    comments: list[str] = []
    properties: dict[str, str] = {}
    vertices = -1
    for line in text.splitlines()[2:]:
        words = line.split(" ", 2)
        count = _VERTICES.fullmatch(line)
        if words[0] == "comment" and len(words) == 3:
            comments.append(line.removeprefix("comment "))
        elif count is not None:
            vertices = int(count[1])
        elif words[0] == "property" and len(words) == 3:
            properties[words[2]] = words[1]
        else:
            raise DamageError("a line of a PLY header of mlbatch", repr(line))
    found = list(properties.items())
    style = next((one for one in _STYLES if list(one.properties.items()) == found), None)
    if vertices < 0 or style is None:
        names = ", ".join(f"{kind} {name}" for name, kind in found)
        raise DamageError("the properties of docs/formats.md", names or "none")
    return ScanComments.of_lines(comments), style, vertices, end + len(_END)
