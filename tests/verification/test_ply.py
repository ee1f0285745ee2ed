"""Folders of PLY files: every damage is found, and named with its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.builders.verify_outputs import (
    Case,
    Edit,
    cases,
    check_case,
    raw,
    removed,
    renamed,
    report,
    row,
    text,
)

ONE = "000001.ply"
VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    + [("time", "<f8"), ("ring", "<i4"), ("return_type", "u1"), ("lidar_id", "u1")]
)


def vertex(name: str, place: int, value: float | None) -> Edit:
    """Put a value into a vertex; None: the other one of 0 and 1."""

    def change(data: bytearray) -> bytearray:
        begin = data.index(b"end_header\n") + len(b"end_header\n")
        vertices = np.frombuffer(data, VERTEX, offset=begin)
        vertices[name][place] = 1 - vertices[name][place] if value is None else value
        return data

    return raw(ONE, change)


PLY: dict[str, Case] = {
    "start": (text(ONE, "200000000\ncomment end", "200000007\ncomment end"), "grid", "start_ns"),
    "end": (text(ONE, "00\ncomment index", "01\ncomment index"), "grid", "000001.ply end_ns"),
    "index": (text(ONE, "index 1", "index 2"), "index", "000001.ply index"),
    "slice": (text(ONE, "slice 0", "slice 1"), "index", "000001.ply index"),
    "name": (renamed(ONE, "000007.ply"), "names", "000007.ply"),
    "incomplete": (text(ONE, "complete true", "complete false"), "table", "line 4 complete"),
    "no word for complete": (text(ONE, "complete true", "complete yes"), "container", ONE),
    "rate": (text(ONE, "rate_hz 10", "rate_hz 20"), "metadata", "000001.ply rate"),
    "timescale": (text(ONE, "timescale utc", "timescale tai"), "metadata", "timescale"),
    "frame": (text(ONE, "frame_id base_link", "frame_id map"), "metadata", "frame_id"),
    "sensors": (text(ONE, "from 0: left right", "from 0: a b"), "metadata", "sensors"),
    "vertices": (text(ONE, "element vertex ", "element vertex 1"), "container", ONE),
    "more vertices than Python counts": (
        text(ONE, "element vertex ", "element vertex " + "1" * 5000),
        "container",
        ONE,
    ),
    "start beyond all counting": (text(ONE, "start_ns 1", f"start_ns {10**20}1"), "grid", ONE),
    "index beyond all counting": (text(ONE, "index 1", "index " + "1" * 5000), "container", ONE),
    "property": (text(ONE, "property int ring", "property uint ring"), "container", ONE),
    "big endian": (text(ONE, "binary_little", "binary_big"), "container", ONE),
    "cut off": (raw(ONE, lambda data: data[:-7]), "container", ONE),
    "empty": (raw(ONE, lambda data: b""), "container", ONE),
    "no number": (vertex("x", 8, np.nan), "finite", "000001.ply point 8"),
    "time that is none": (vertex("time", 8, np.nan), "times", "000001.ply point 8"),
    "time before the scan": (vertex("time", 8, -1e-9), "times", "000001.ply point 8"),
    "time past the scan": (vertex("time", 8, 0.1011), "times", "000001.ply point 8"),
    "time that steps back": (vertex("time", -1, 0.05), "order", "000001.ply point"),
    "ring of the other": (vertex("ring", -1, -1), "rings", "000001.ply point"),
    "ring that is none": (vertex("ring", 8, 90), "rings", "000001.ply point"),
    "return type": (vertex("return_type", 8, 99), "returns", "000001.ply point 8"),
    "sensor": (vertex("lidar_id", 8, 5), "sensors", "000001.ply point 8"),
    "sensor of others": (vertex("lidar_id", 8, None), "rings", "000001.ply point 8"),
    "scan missing": (removed(ONE), "table", "line 4 scan"),
    "points of a line": (row(2, "points", 1), "table", "line 4 points"),
    "first stamp": (row(2, "first_stamp_ns", lambda n: n + 30_000), "table", "first_stamp_ns"),
    "ledger": (report("capture", "frames", to=0), "ledger", "capture.frames"),
}


FLOATS = np.dtype([(name, "<f4") for name in ("x", "y", "z", "time")])


def number(name: str, place: int, value: float) -> Edit:
    """Put a value into a vertex of the style `float`."""

    def change(data: bytearray) -> bytearray:
        begin = data.index(b"end_header\n") + len(b"end_header\n")
        np.frombuffer(data, FLOATS, offset=begin)[name][place] = value
        return data

    return raw(ONE, change)


FLOAT: dict[str, Case] = {
    "no number": (number("y", 8, np.inf), "finite", "000001.ply point 8"),
    "time that is none": (number("time", 8, np.nan), "times", "000001.ply point 8"),
    "time past the scan": (number("time", 8, 3e38), "times", "000001.ply point 8"),
    "property": (text(ONE, "float time", "float tame"), "container", ONE),
}
CLOUDCOMPARE: dict[str, Case] = {
    "cut off": PLY["cut off"],
    "property": (text(ONE, "int scalar_ring", "int ring"), "container", ONE),
}


@pytest.mark.parametrize(
    ("kind", "case"),
    cases({"ply": PLY, "ply-float": FLOAT, "ply-cloudcompare": CLOUDCOMPARE}),
)
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)
