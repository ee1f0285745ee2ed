"""Folders of PCD files: every damage is found, and named with its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.builders.verify_outputs import Case, Edit, cases, check_case, raw, renamed, text

ONE = "000001.pcd"
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "intensity", "time")]
    + [("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")]
)


def point(name: str, place: int, value: float) -> Edit:
    """Put a value into a point."""

    def change(data: bytearray) -> bytearray:
        begin = data.index(b"DATA binary\n") + len(b"DATA binary\n")
        np.frombuffer(data, POINT, offset=begin)[name][place] = value
        return data

    return raw(ONE, change)


PCD: dict[str, Case] = {
    "start": (text(ONE, "200000000\n# end", "200000007\n# end"), "grid", "start_ns"),
    "index": (text(ONE, "index 1", "index 2"), "index", "000001.pcd index"),
    "name": (renamed(ONE, "000007.pcd"), "names", "000007.pcd"),
    "incomplete": (text(ONE, "complete true", "complete false"), "table", "line 4 complete"),
    "no word for complete": (text(ONE, "complete true", "complete yes"), "container", ONE),
    "rate": (text(ONE, "rate_hz 10", "rate_hz 20"), "metadata", "000001.pcd rate"),
    "fields": (text(ONE, "ring", "rong"), "container", ONE),
    "type": (text(ONE, "U U U", "U U I"), "container", ONE),
    "ascii": (text(ONE, "DATA binary", "DATA ascii "), "container", ONE),
    "points": (text(ONE, "POINTS ", "POINTS 1"), "container", ONE),
    "no number of points": (text(ONE, "POINTS ", "POINTS x"), "container", ONE),
    "height": (text(ONE, "HEIGHT 1", "HEIGHT 2"), "container", ONE),
    "cut off": (raw(ONE, lambda data: data[:-7]), "container", ONE),
    "empty": (raw(ONE, lambda data: b""), "container", ONE),
    "no number": (point("x", 8, np.nan), "finite", "000001.pcd point 8"),
    "time that is none": (point("time", 8, np.nan), "times", "000001.pcd point 8"),
    "time before the scan": (point("time", 8, -1e-6), "times", "000001.pcd point 8"),
    "time past the scan": (point("time", 8, 0.1011), "times", "000001.pcd point 8"),
    "time that steps back": (point("time", -1, 0.05), "order", "000001.pcd point"),
    "ring that is none": (point("ring", 8, 90), "rings", "000001.pcd point"),
    "return type": (point("return_type", 8, 99), "returns", "000001.pcd point 8"),
    "sensor": (point("lidar_id", 8, 5), "sensors", "000001.pcd point 8"),
}


@pytest.mark.parametrize(("kind", "case"), cases({"pcd": PCD}))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)
