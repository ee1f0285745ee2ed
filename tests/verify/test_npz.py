"""Every edit of a folder of scans that breaks a rule is found, and named with its place."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.builders.outputs import (
    Edit,
    Values,
    arrays,
    at,
    both,
    flipped,
    forget,
    found,
    npz,
    plus,
    raw,
    removed,
    renamed,
    report,
    row,
    spoiled_places,
    swapped,
    text,
)

ONE = "000001.npz"
PERIOD_NS = 100_000_000


@pytest.fixture(scope="module", autouse=True)
def _clean() -> Iterator[None]:
    yield
    forget()


def drop_columns(found: dict[str, Values]) -> None:
    """The last column and its points are gone."""
    last = len(found["column_stamp_ns"]) - 1
    keep = found["column"] < last
    for key in ("xyz", "intensity", "reflectivity", "range_m", "time_ns", "ring", "return_type"):
        found[key] = found[key][keep]
    found["lidar_id"], found["column"] = found["lidar_id"][keep], found["column"][keep]
    found["column_stamp_ns"] = found["column_stamp_ns"][:last]
    found["column_lidar_id"] = found["column_lidar_id"][:last]


def repeat_column(found: dict[str, Values]) -> None:
    """A column with points is there twice in a row."""
    column = int(found["column"][len(found["column"]) // 2])
    rows = np.flatnonzero(found["column"] == column)
    end = rows[-1] + 1
    for key in ("xyz", "intensity", "reflectivity", "range_m", "time_ns", "ring", "return_type"):
        found[key] = np.insert(found[key], end, found[key][rows], axis=0)
    found["lidar_id"] = np.insert(found["lidar_id"], end, found["lidar_id"][rows])
    old = found["column"].copy()
    old[old > column] += 1
    found["column"] = np.insert(old, end, np.full(len(rows), column + 1, old.dtype))
    for key in ("column_stamp_ns", "column_lidar_id"):
        found[key] = np.insert(found[key], column, found[key][column])


def shifted(by_ns: int) -> Edit:
    """A scan of another time, all of it."""

    def change(found: dict[str, Values]) -> None:
        for key in ("column_stamp_ns", "start_ns", "end_ns"):
            found[key] = found[key] + np.int64(by_ns)

    return arrays(ONE, change)


def without(key: str) -> Edit:
    def change(found: dict[str, Values]) -> None:
        del found[key]

    return arrays(ONE, change)


def as_type(kind: str) -> Edit:
    return npz(ONE, "intensity", lambda values: values.astype(kind))


# The first by name: it tells the constants that others are held against.
HEAD = "head.npz"
NPZ: dict[str, tuple[Edit, str, str]] = {
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
    "column left out": (arrays(ONE, drop_columns), "table", "scans.csv line 4 columns_"),
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
    "a byte of an array": (raw(ONE, flipped(4000)), "container", "000001.npz"),
    "file cut off": (raw(ONE, lambda data: data[:9000]), "container", "000001.npz"),
    "empty file": (raw(ONE, lambda data: b""), "container", "000001.npz"),
    "scan missing": (removed(ONE), "table", "scans.csv line 4 scan"),
    "scan renamed": (renamed(ONE, "000009.npz"), "names", "000009.npz"),
    "name of five digits": (renamed(ONE, "00001.npz"), "names", "00001.npz"),
    "name with a slice": (renamed(ONE, "000001-0.npz"), "names", "000001-0.npz"),
    "left by a run": (renamed(ONE, f"{ONE}.partial"), "names", "000001.npz.partial"),
    "no table": (removed("scans.csv"), "table", "scans.csv"),
    "points of a line": (row(1, "points", lambda n: n + 1), "table", "line 3 points"),
    "stamp of a line": (row(1, "last_stamp_ns", lambda n: n - 1), "table", "last_stamp_ns"),
    "stamp past its line": (row(1, "last_stamp_ns", lambda n: n + PERIOD_NS), "columns", "line 3"),
    "start of a line": (row(1, "start_ns", lambda n: n + 1), "grid", "line 3 start_ns"),
    "end of a line": (row(2, "end_ns", lambda n: n + 1), "grid", "line 4 end_ns"),
    "columns of a line": (row(1, "columns", lambda n: n + 1), "table", "line 3 columns"),
    "columns of a sensor": (row(1, "columns_left", lambda n: n - 1), "table", "columns_left"),
    "gap of a line": (row(1, "max_gap_ns_right", lambda n: n + 1), "table", "max_gap_ns_right"),
    "line out of order": (row(1, "index", 7), "table", "line 4 index and slice"),
    "no number in a line": (row(1, "points", "many"), "table", "line 3 points"),
    "word in a line": (row(1, "complete", "yes"), "table", "line 3 complete"),
    "header of the table": (text("scans.csv", "index,", "no,"), "table", "scans.csv line 1"),
    "line cut off": (text("scans.csv", ",true", ""), "table", "scans.csv"),
    "frames of the report": (report("capture", "frames", to=1), "ledger", "capture.frames"),
    "packets of the report": (
        report("sensors", 0, "packets", "accepted", to=1),
        "ledger",
        "sensors.0.packets.read",
    ),
    "columns of the report": (
        report("sensors", 1, "columns", "dropped", "head", to=1),
        "ledger",
        "sensors.1.columns.decoded",
    ),
    "slots of the report": (
        report("sensors", 0, "points", "no_return", to=1),
        "ledger",
        "sensors.0.points.slots",
    ),
    "balanced, but not so in the file": (
        both(
            report("sensors", 0, "points", "written", to=lambda n: n + 5),
            report("sensors", 0, "points", "no_return", to=lambda n: n - 5),
        ),
        "report",
        "sensors.0.points.written",
    ),
    "columns that are not there": (
        both(
            report("sensors", 0, "columns", "written", to=lambda n: n + 5),
            report("sensors", 0, "columns", "decoded", to=lambda n: n + 5),
        ),
        "report",
        "sensors.0.columns.written",
    ),
    "scans of the report": (report("scans", "written", to=9), "report", "scans.written"),
    "points of the report": (report("scans", "points", to=9), "report", "scans.points"),
    "incomplete of the report": (report("scans", "incomplete", to=3), "report", "incomplete"),
    "span of the report": (report("scans", "span_ms", "max", to=101.0), "report", "span_ms.max"),
    "period of the report": (report("scans", "period_ms", "p50", to=99.0), "report", "p50"),
    "start of the report": (report("grid", "t_init_ns", to=7), "t_init", "t_init_ns"),
    "start by a period": (
        report("grid", "t_init_ns", to=lambda n: n + PERIOD_NS),
        "index",
        "head.npz index, slice",
    ),
    "rate of the report": (report("grid", "rate_hz", to="20"), "metadata", "report.json rate"),
    "period of the grid": (report("grid", "period_ns", to="1"), "grid", "grid.period_ns"),
    "slices of the report": (report("grid", "slices", to=2), "metadata", "report.json slices"),
    "sensor of the report": (report("sensors", 0, "name", to="x"), "metadata", "sensors"),
    "number of a sensor": (report("sensors", 1, "lidar_id", to=0), "ledger", "1.lidar_id"),
    "report of others": (report("schema", to="x"), "ledger", "report.json schema"),
    "count that is none": (report("capture", "frames", to="many"), "ledger", "capture.frames"),
    "sensor far away": (
        report("sensors", 0, "extrinsics", "body_from_sensor", 0, 3, to=40.0),
        "geometry",
        "000000.npz point",
    ),
    "extrinsics that are none": (
        report("sensors", 0, "extrinsics", "body_from_sensor", to=[[1, 0], [0, 1]]),
        "report",
        "body_from_sensor",
    ),
}


@pytest.mark.parametrize("name", NPZ)
def test_npz(name: str, tmp_path: Path) -> None:
    edit, check, where = NPZ[name]
    found(spoiled_places("npz", tmp_path, edit), check, where)
