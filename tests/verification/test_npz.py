"""Folders of npz files: every damage is found, and named with its place."""

from __future__ import annotations

import io
import shutil
import struct
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.builders.verify_outputs import (
    PERIOD_NS,
    Arrays,
    Case,
    Edit,
    arrays,
    at,
    both,
    cases,
    check_case,
    flipped,
    npz,
    plus,
    raw,
    removed,
    renamed,
    swapped,
)

ONE = "000001.npz"


POINTS = (
    "xyz",
    "intensity",
    "reflectivity",
    "range_m",
    "time_ns",
    "ring",
    "return_type",
    "lidar_id",
)
COLUMNS = ("column_stamp_ns", "column_lidar_id")


def drop_column(found: Arrays) -> None:
    """Remove the last column and its points."""
    last = len(found["column_stamp_ns"]) - 1
    keep = found["column"] < last
    for key in (*POINTS, "column"):
        found[key] = found[key][keep]
    for key in COLUMNS:
        found[key] = found[key][:last]


def repeat_column(found: Arrays) -> None:
    """Insert a copy of a column with points after it."""
    column = int(found["column"][len(found["column"]) // 2])
    rows = np.flatnonzero(found["column"] == column)
    end = rows[-1] + 1
    for key in POINTS:
        found[key] = np.insert(found[key], end, found[key][rows], axis=0)
    old = found["column"].copy()
    old[old > column] += 1
    found["column"] = np.insert(old, end, np.full(len(rows), column + 1, old.dtype))
    for key in COLUMNS:
        found[key] = np.insert(found[key], column, found[key][column])


def shifted(by_ns: int) -> Edit:
    """A scan of another time, all of it."""

    def change(found: Arrays) -> None:
        for key in ("column_stamp_ns", "start_ns", "end_ns"):
            found[key] = found[key] + np.int64(by_ns)

    return arrays(ONE, change)


def without(key: str) -> Edit:
    """Remove a key."""

    def change(found: Arrays) -> None:
        del found[key]

    return arrays(ONE, change)


def as_type(kind: str) -> Edit:
    """Another type of intensities."""
    return npz(ONE, "intensity", lambda values: values.astype(kind))


def member(name: str, data: bytes, method: int = zipfile.ZIP_STORED, size: int = 0) -> Edit:
    """Add a member to the zip; size: declared size, if not the true one."""

    def change(old: bytearray) -> bytearray:
        file = io.BytesIO(old)
        with zipfile.ZipFile(file, "a") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive.writestr(name, data, method)
        new = bytearray(file.getvalue())
        if size:
            struct.pack_into("<I", new, new.rindex(b"PK\x01\x02") + 24, size)
        return new

    return raw(ONE, change)


def npy(head: str) -> bytes:
    """An npy with this header and 8 bytes of data."""
    data = head.encode()
    return b"\x93NUMPY\x01\x00" + len(data).to_bytes(2, "little") + data + bytes(8)


HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,), }"
TWISTED = "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -1), }"
FORTRAN = "{'descr': '<f8', 'fortran_order': True, 'shape': (1,), }"
OBJECTS = "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"
NO_HEAD = "{'descr': '<f8', " + "(" * 200

# The first by name: its constants are those of the run.
HEAD = "head.npz"
NPZ: dict[str, Case] = {
    "start off the grid": (npz(ONE, "start_ns", plus((), -5)), "grid", "000001.npz start_ns"),
    "end off the grid": (npz(ONE, "end_ns", plus((), 1)), "grid", "000001.npz end_ns"),
    "period too long": (npz(ONE, "end_ns", plus((), PERIOD_NS)), "grid", "000001.npz end_ns"),
    "scan of another window": (shifted(PERIOD_NS), "index", "000001.npz index, slice"),
    "another index": (npz(ONE, "index", at((), 2)), "index", "000001.npz index, slice"),
    "another slice": (npz(ONE, "slice", at((), 1)), "index", "000001.npz index, slice"),
    "index below the head": (npz("head.npz", "index", at((), -2)), "index", "head.npz"),
    "another rate": (npz(ONE, "rate_hz", lambda v: np.array("20")), "metadata", "rate_hz"),
    "another frame": (npz(ONE, "frame_id", lambda v: np.array("map")), "metadata", "frame_id"),
    "another schema": (npz(ONE, "schema", lambda v: np.array("x/1")), "metadata", "schema"),
    "another timescale": (npz(ONE, "timescale", lambda v: np.array("tai")), "metadata", "timesc"),
    "sensors swapped": (npz(ONE, "sensors", swapped(0, 1)), "metadata", "sensors"),
    "other slices": (npz(ONE, "slices", at((), 2)), "metadata", "slices"),
    "column before the window": (
        npz(ONE, "column_stamp_ns", plus(0, -PERIOD_NS)),
        "columns",
        "000001.npz column 0",
    ),
    "column past the window": (
        npz(ONE, "column_stamp_ns", plus(-1, PERIOD_NS)),
        "columns",
        "000001.npz column 1023",
    ),
    "columns out of order": (
        npz(ONE, "column_stamp_ns", swapped(500, 503)),
        "order",
        "000001.npz column after 5",
    ),
    "stamp moved by 5 ns": (npz(ONE, "column_stamp_ns", plus(0, 5)), "table", "first_stamp_ns"),
    "column index steps back": (npz(ONE, "column", at(3000, 0)), "order", "point after 2999"),
    "column index past the end": (npz(ONE, "column", at(-1, 9999)), "order", "000001.npz column"),
    "column of another sensor": (
        npz(ONE, "column_lidar_id", plus(7, 1)),
        "sensors",
        "000001.npz point",
    ),
    "point before its column": (npz(ONE, "time_ns", plus(-1, -9000)), "times", "000001.npz point"),
    "point long after its column": (npz(ONE, "time_ns", plus(5, 2_000_000)), "times", "point 5"),
    "point far past the window": (npz(ONE, "time_ns", plus(9, PERIOD_NS)), "times", "point 9"),
    "points of a column out of order": (npz(ONE, "ring", swapped(40, 41)), "order", "point after"),
    "no number": (npz(ONE, "xyz", at((17, 1), np.nan)), "finite", "000001.npz point 17"),
    "infinity": (npz(ONE, "xyz", at((18, 2), np.inf)), "finite", "000001.npz point 18"),
    "point 5 m away": (npz(ONE, "xyz", plus((19, 0), 50)), "geometry", "000001.npz point 19"),
    "range in mm": (npz(ONE, "range_m", at(20, 4000)), "geometry", "000001.npz point 20"),
    "no range": (npz(ONE, "range_m", at(21, np.nan)), "geometry", "000001.npz point 21"),
    "sensor that is none": (npz(ONE, "lidar_id", at(4, 2)), "sensors", "000001.npz point 4"),
    "point of another sensor": (npz(ONE, "lidar_id", lambda v: 1 - v), "sensors", "point 0"),
    "column of no sensor": (npz(ONE, "column_lidar_id", at(3, 9)), "sensors", "column 3"),
    "ring of the other sensor": (npz(ONE, "ring", at(-1, 63)), "rings", "000001.npz point"),
    "ring that is none": (npz(ONE, "ring", at(-1, 500)), "rings", "000001.npz point"),
    "return type that is none": (npz(ONE, "return_type", at(6, 8)), "returns", "point 6"),
    "column twice": (arrays(ONE, repeat_column), "duplicates", "000001.npz column"),
    "column left out": (arrays(ONE, drop_column), "table", "scans.csv line 4 columns_"),
    "incomplete": (npz(ONE, "complete", at((), False)), "table", "scans.csv line 4 complete"),
    "key left out": (without("ring"), "container", "000001.npz"),
    "key of others left out": (without("reflectivity"), "layout", "000001.npz"),
    "another type": (as_type("<f8"), "layout", "000001.npz intensity"),
    "truth for slices": (
        npz(HEAD, "slices", lambda v: np.array(True)),
        "layout",
        "head.npz slices",
    ),
    "no number of slices": (
        npz(HEAD, "slices", lambda v: np.array(np.nan)),
        "layout",
        "head.npz slices",
    ),
    "slices in words": (
        npz(HEAD, "slices", lambda v: np.array("one")),
        "layout",
        "head.npz slices",
    ),
    "number for a rate": (
        npz(HEAD, "rate_hz", lambda v: np.array(10.0)),
        "layout",
        "head.npz rate",
    ),
    "text for sensors": (npz(HEAD, "sensors", lambda v: v[0]), "layout", "head.npz sensors"),
    "fewer values": (npz(ONE, "ring", lambda v: v[1:]), "layout", "000001.npz ring"),
    "two axes": (npz(ONE, "ring", lambda v: v[None]), "layout", "000001.npz ring"),
    "more values than bytes": (member("x.npy", npy(HUGE)), "container", "000001.npz"),
    "negative shape": (member("x.npy", npy(TWISTED)), "container", "000001.npz"),
    "order of Fortran": (member("x.npy", npy(FORTRAN)), "container", "000001.npz"),
    "pickled objects": (member("x.npy", npy(OBJECTS)), "container", "000001.npz"),
    "header that is none": (member("x.npy", npy(NO_HEAD)), "container", "000001.npz"),
    "no npy": (member("x.npy", b"no npy"), "container", "000001.npz"),
    "member twice": (member("ring.npy", b""), "container", "000001.npz"),
    "other compression": (member("x.npy", b"", zipfile.ZIP_LZMA), "container", "000001.npz"),
    "bomb": (member("x.npy", npy(HUGE), size=1 << 30), "container", "000001.npz"),
    "smaller than declared": (member("x.npy", npy(HUGE), size=400), "container", "000001.npz"),
    "a byte of an array": (raw(ONE, flipped(4000)), "container", "000001.npz"),
    "file cut off": (raw(ONE, lambda data: data[:9000]), "container", "000001.npz"),
    "empty file": (raw(ONE, lambda data: b""), "container", "000001.npz"),
    "scan missing": (removed(ONE), "table", "scans.csv line 4 scan"),
    "scan renamed": (renamed(ONE, "000009.npz"), "names", "000009.npz"),
    "name of five digits": (renamed(ONE, "00001.npz"), "names", "00001.npz"),
    "name with a slice": (renamed(ONE, "000001-0.npz"), "names", "000001-0.npz"),
    "left by a run": (renamed(ONE, f"{ONE}.partial"), "names", "000001.npz.partial"),
}


def empty_slot(key: str, value: float) -> Edit:
    """A value where an organized scan has no point."""

    def change(scan: Arrays) -> None:
        empty = np.isnan(scan["xyz"]).all(axis=2)
        place = tuple(np.argwhere(empty)[5])
        scan[key][place] = value

    return arrays(ONE, change)


def valid_slot(key: str, value: float) -> Edit:
    """A value where an organized scan has a point."""

    def change(scan: Arrays) -> None:
        place = tuple(np.argwhere(np.isfinite(scan["range_m"]))[5])
        scan[key][place] = value

    return arrays(ONE, change)


def half_a_place(scan: Arrays) -> None:
    """One coordinate of three is missing."""
    place = tuple(np.argwhere(np.isfinite(scan["range_m"]))[5])
    scan["xyz"][place][1] = np.nan


ORGANIZED: dict[str, Case] = {
    "range in an empty slot": (empty_slot("range_m", 1.0), "finite", "slot"),
    "intensity in an empty slot": (empty_slot("intensity", 1.0), "finite", "slot"),
    "time in an empty slot": (empty_slot("time_ns", 1), "finite", "slot"),
    "ring in an empty slot": (empty_slot("ring", 1), "finite", "slot"),
    "return in an empty slot": (empty_slot("return_type", 1), "finite", "slot"),
    "no place": (valid_slot("xyz", np.nan), "finite", "slot"),
    "half a place": (arrays(ONE, half_a_place), "finite", "slot"),
    "no range": (valid_slot("range_m", np.nan), "finite", "slot"),
    "sensor of a slot": (empty_slot("lidar_id", 1), "sensors", "slot"),
    "time of a slot": (valid_slot("time_ns", 50_000_000), "times", "slot"),
    "rows missing": (npz(ONE, "ring", lambda v: v[:-1]), "layout", "ring"),
    "column past the window": (
        npz(ONE, "column_stamp_ns", plus(-1, PERIOD_NS)),
        "columns",
        "column 1023",
    ),
}


def of_other_sensor(folder: Path) -> None:
    shutil.copy(folder / "right" / ONE, folder / "left" / ONE)


SPLIT: dict[str, Case] = {
    "scan of the other sensor": (of_other_sensor, "sensors", "left/000001.npz"),
    "folder of no sensor": (renamed("left", "middle"), "names", "middle/"),
    "scan missing": (removed(f"left/{ONE}"), "table", "line 4 points"),
    "scan outside the folders": (renamed(f"left/{ONE}", ONE), "names", "left/"),
}

# Times at the limits of int64, in the first scan: without a report nothing says where it begins.
EXTREME: dict[str, Case] = {
    f"start {ns}": (
        both(removed("report.json"), npz(HEAD, "start_ns", at((), ns))),
        "grid",
        "head.npz start_ns",
    )
    for ns in (2**63 - 1, -(2**63))
}

SLICES: dict[str, Case] = {
    "slice missing": (removed("000001-1.npz"), "table", "scan"),
    "slices swapped": (
        both(
            renamed("000001-1.npz", "x"),
            renamed("000001-2.npz", "000001-1.npz"),
            renamed("x", "000001-2.npz"),
        ),
        "names",
        "000001-",
    ),
    "slice past the window": (npz("000001-2.npz", "slice", at((), 3)), "index", "000001-2.npz"),
    "bound of a slice": (npz("000001-1.npz", "start_ns", plus((), 1)), "grid", "000001-1.npz"),
}

TABLES = {
    "npz": NPZ | EXTREME,
    "npz-organized": ORGANIZED,
    "npz-split": SPLIT,
    "npz-slices": SLICES,
}


@pytest.mark.parametrize(("kind", "case"), cases(TABLES))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)
