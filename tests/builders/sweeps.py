"""Folders of sweeps from values: raw points and PCD, written field by field."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

# numpy types of a rig, with the code of `struct`, and kind and size of PCD.
CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d",
         "i8": "q", "u8": "Q"}  # fmt: skip
KINDS = {"i": "I", "u": "U", "f": "F"}
Point = Sequence[float]


def raw(fields: Mapping[str, str], points: Sequence[Point]) -> bytes:
    """Points without gaps, little endian."""
    code = "<" + "".join(CODES[kind] for kind in fields.values())
    return b"".join(struct.pack(code, *point) for point in points)


def dtype_text(fields: Mapping[str, str]) -> str:
    """The key of a rig."""
    return "{" + ", ".join(f"{name}: {kind}" for name, kind in fields.items()) + "}"


def pcd(fields: Mapping[str, str], points: Sequence[Point], data: str = "binary") -> bytes:
    """A PCD file; data: binary or ascii."""
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(fields)}",
        f"SIZE {' '.join(kind[1:] for kind in fields.values())}",
        f"TYPE {' '.join(KINDS[kind[0]] for kind in fields.values())}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        f"DATA {data}",
    ]
    head = ("\n".join(lines) + "\n").encode()
    if data == "ascii":
        return head + "".join(" ".join(map(repr, point)) + "\n" for point in points).encode()
    return head + raw(fields, points)


def write_sweeps(folder: Path, sweeps: Mapping[str, bytes]) -> None:
    """Files by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in sweeps.items():
        (folder / name).write_bytes(data)
