"""Folders of PCD files: points and times, but no columns.

The format: docs/formats.md; PCL, "The PCD (Point Cloud Data) file format", version 0.7.
"""

from __future__ import annotations

import re

import numpy as np

from mlbatch.outputs.commented import CommentedReader, Fields
from mlbatch.outputs.comments import ScanComments
from mlbatch.outputs.damage import DamageError

SUFFIX = ".pcd"
# Name, size, kind and numpy type.
_FIELDS = (
    ("x", 4, "F", "<f4"),
    ("y", 4, "F", "<f4"),
    ("z", 4, "F", "<f4"),
    ("intensity", 4, "F", "<f4"),
    ("time", 4, "F", "<f4"),
    ("ring", 2, "U", "<u2"),
    ("return_type", 1, "U", "u1"),
    ("lidar_id", 1, "U", "u1"),
)
_POINT = np.dtype([("xyz", "<f4", (3,)), *((name, kind) for name, _, _, kind in _FIELDS[3:])])
_FIXED = {
    "VERSION": "0.7",
    "FIELDS": " ".join(name for name, *_ in _FIELDS),
    "SIZE": " ".join(str(size) for _, size, *_ in _FIELDS),
    "TYPE": " ".join(kind for _, _, kind, _ in _FIELDS),
    "COUNT": " ".join("1" for _ in _FIELDS),
    "VIEWPOINT": "0 0 0 1 0 0 0",
}
_COUNTS = ("WIDTH", "HEIGHT", "POINTS")
_NUMBER = re.compile(r"\d{1,19}", re.ASCII)
_HEAD = b"# .PCD v0.7"
_END = b"\nDATA binary\n"
_LONGEST_HEAD = 1 << 20


class PcdReader(CommentedReader):
    """Reads the files of one folder."""

    __slots__ = ()

    def parse(self, data: bytes) -> tuple[ScanComments, Fields]:
        """Comments and points of a file; a row of an organized one is a slot."""
        end = data.find(_END, 0, _LONGEST_HEAD)
        if end < 0 or not data.startswith(_HEAD):
            raise DamageError("the header of a binary PCD file of mlbatch", repr(data[:40]))
        lines = data[:end].decode("utf-8", "replace").splitlines()
        comments = [line[2:] for line in lines[1:] if line.startswith("# ")]
        entries = dict(
            (name, value) for name, _, value in (x.partition(" ") for x in lines) if name != "#"
        )
        for name, expected in _FIXED.items():
            if entries.get(name) != expected:
                raise DamageError(f"{name} {expected}", entries.get(name, "none"))
        for name in _COUNTS:
            if _NUMBER.fullmatch(entries.get(name, "")) is None:
                raise DamageError(f"{name} with a number", entries.get(name, "none"))
        width, height, count = (int(entries[name]) for name in _COUNTS)
        begin = end + len(_END)
        if count != width * height or len(data) != begin + count * _POINT.itemsize:
            expected = f"{width} x {height} points of {_POINT.itemsize} bytes"
            raise DamageError(expected, f"{count} points, {len(data) - begin} bytes")
        points = np.frombuffer(data, _POINT, count, begin)
        if height != 1:
            points = points.reshape(height, width).T
        names = points.dtype.names or ()
        return ScanComments.of_lines(comments), {name: points[name] for name in names}
