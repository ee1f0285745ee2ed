"""Messages in MCAP files and bags: every damage is found, and named with its place.

Files are rewritten by `mcap` and `rosbags`: only the change is wrong, not indexes or checksums.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.verification import verify
from tests.builders.rewritten_outputs import (
    Change,
    Notes,
    Records,
    Sent,
    bag,
    gone,
    later,
    mcap,
    on,
    only,
    patched,
    points,
    put,
    twice,
)
from tests.builders.verify_outputs import (
    PERIOD_NS,
    Case,
    Edit,
    cases,
    check_case,
    copied,
    damaged,
    flipped,
    raw,
    report,
    row,
    text,
    with_cell,
    with_value,
)

# Of a PointCloud2 on `base_link`: seconds and nanoseconds; height and width.
STAMP, HEIGHT, WIDTH = 4, 28, 32


def scan(number: int, change: Change) -> Edit:
    """Change one scan of an MCAP file."""
    return mcap(only("/points", number, change))


def table(line: int, column: str, value: object) -> Notes:
    """Change the attached table."""

    def change(metadata: dict[str, dict[str, str]], files: dict[str, bytes]) -> None:
        old = files["scans.csv"].decode()
        files["scans.csv"] = with_cell(old, line, column, value).encode()

    return change


def inner(*path: str | int, to: object) -> Notes:
    """Change the report inside."""

    def change(metadata: dict[str, dict[str, str]], files: dict[str, bytes]) -> None:
        notes = metadata["mlbatch.report"]
        notes["json"] = with_value(notes["json"], path, to)

    return change


def grid(key: str, value: str) -> Notes:
    """Change what the file says of its grid."""

    def change(metadata: dict[str, dict[str, str]], files: dict[str, bytes]) -> None:
        metadata["mlbatch.grid"][key] = value

    return change


def without(name: str) -> Notes:
    """Leave out a metadata record or an attachment."""

    def change(metadata: dict[str, dict[str, str]], files: dict[str, bytes]) -> None:
        metadata.pop(name, None)
        files.pop(name, None)

    return change


def moved(by_ns: int) -> Change:
    """Another time, the same in the log and in the header."""

    def change(sent: Sent) -> list[Sent]:
        data, log_ns = bytearray(sent.data), sent.log_ns + by_ns
        struct.pack_into("<iI", data, STAMP, *divmod(log_ns, 10**9))
        return [replace(sent, data=bytes(data), log_ns=log_ns, publish_ns=log_ns)]

    return change


def words(old: bytes, new: bytes) -> Change:
    """Other words of the same length."""
    return lambda sent: [replace(sent, data=sent.data.replace(old, new, 1))]


def cut(count: int) -> Change:
    return lambda sent: [replace(sent, data=sent.data[:-count])]


def as_imu(sent: Sent) -> list[Sent]:
    return [replace(sent, kind="sensor_msgs/msg/Imu")]


MCAP: dict[str, Case] = {
    "log time": (scan(1, later(1)), "stamps", "/points message 1 log time"),
    "publish time": (
        scan(1, lambda s: [replace(s, publish_ns=1)]),
        "stamps",
        "/points message 1 publish time",
    ),
    "off the grid": (scan(1, moved(-1000)), "grid", "/points message 1 start_ns"),
    "of another window": (scan(1, moved(PERIOD_NS)), "index", "/points message 2 start_ns"),
    "scan twice": (scan(2, twice), "index", "/points message 3 start_ns"),
    "scan left out": (scan(2, gone), "table", "line 4 scan"),
    "frame": (scan(0, words(b"base", b"cars")), "metadata", "message 0 frame_id"),
    "width": (scan(0, patched(WIDTH, "<I", 7)), "layout", "/points message 0"),
    "height": (scan(0, patched(HEIGHT, "<I", 2)), "layout", "/points message 0"),
    "cut off": (scan(0, cut(3)), "layout", "/points message 0"),
    "not CDR": (scan(0, patched(1, "<B", 0)), "layout", "/points message 0"),
    "not dense": (scan(1, lambda s: [replace(s, data=s.data[:-1] + b"\0")]), "layout", "is_dense"),
    "name of a field": (
        scan(0, words(b"intensity", b"intensitz")),
        "layout",
        "/points message 0",
    ),
    "of another type": (scan(1, as_imu), "layout", "/points message 0 type"),
    "on another topic": (mcap(only("/points", 1, on("/left/points"))), "layout", "/left/points"),
    "no number": (scan(1, put("standard", "y", 5, np.nan)), "finite", "message 1 point 5"),
    "time before the scan": (scan(1, put("standard", "time", 5, -0.1)), "times", "point 5"),
    "time past the scan": (scan(1, put("standard", "time", 6, 0.2)), "times", "point 6"),
    "time that is none": (scan(1, put("standard", "time", 6, np.nan)), "layout", "message 1"),
    "time that steps back": (scan(1, put("standard", "time", 900, 0)), "order", "point 900"),
    "time before all columns": (
        scan(0, put("standard", "time", 0, 0)),
        "table",
        "first_stamp_ns",
    ),
    "sensor": (scan(1, put("standard", "lidar_id", 3, 2)), "sensors", "message 1 point 3"),
    "ring": (scan(1, put("standard", "ring", 3, 900)), "rings", "message 1 point 3"),
    "return type": (scan(1, put("standard", "return_type", 3, 9)), "returns", "point 3"),
    "no transforms": (mcap(only("/tf_static", 0, gone)), "tf_static", "messages"),
    "transforms twice": (mcap(only("/tf_static", 0, twice)), "tf_static", "messages"),
    "frame of transforms": (
        mcap(only("/tf_static", 0, words(b"base", b"cars"))),
        "tf_static",
        "message 0 frames",
    ),
    "name of a sensor": (
        mcap(only("/tf_static", 0, words(b"right", b"wrong"))),
        "tf_static",
        "child frames",
    ),
    "pose of a sensor": (
        mcap(only("/tf_static", 0, patched(44, "<d", 9.0))),
        "tf_static",
        "message 0 left",
    ),
    "IMU left out": (mcap(only("/left/imu", 4, gone)), "imu", "sensors.0.imu_samples.written"),
    "IMU log time": (mcap(only("/left/imu", 4, later(5))), "imu", "/left/imu message 4 log time"),
    "IMU that steps back": (
        mcap(only("/left/imu", 4, moved(-PERIOD_NS))),
        "imu",
        "/left/imu message 4",
    ),
    "IMU frame": (
        mcap(only("/left/imu", 4, words(b"_imu", b"_umi"))),
        "imu",
        "message 4 frame_id",
    ),
    "IMU value": (
        mcap(only("/left/imu", 4, lambda s: [replace(s, data=s.data[:-8] + b"\xff" * 8)])),
        "imu",
        "/left/imu message 4",
    ),
    "message of an unknown topic": (mcap(only("/left/imu", 4, on("/odd"))), "messages", "/odd"),
    "rate of the grid": (mcap(notes=grid("rate_hz", "20")), "metadata", "rate"),
    "t_init of the grid": (mcap(notes=grid("t_init_ns", "5")), "metadata", "t_init_ns"),
    "t_init that is none": (mcap(notes=grid("t_init_ns", "")), "metadata", "t_init_ns"),
    "slices of the grid": (mcap(notes=grid("slices", "2")), "metadata", "slices"),
    "sensors of the grid": (mcap(notes=grid("sensors", '["a"]')), "metadata", "sensors"),
    "frame of the grid": (mcap(notes=grid("frame_id", "map")), "metadata", "frame_id"),
    "no report inside": (mcap(notes=without("mlbatch.report")), "metadata", "scans.mcap"),
    "no table inside": (mcap(notes=without("scans.csv")), "table", "scans.mcap"),
    "report inside": (
        mcap(notes=inner("scans", "points", to=1)),
        "report",
        "mlbatch.report scans.points",
    ),
    "ledger inside": (
        mcap(notes=inner("capture", "frames", to=1)),
        "ledger",
        "mlbatch.report capture.frames",
    ),
    "copy of the report": (
        report("capture", "frames", to=1),
        "report",
        "report.json capture.frames",
    ),
    "table inside": (mcap(notes=table(1, "points", 1)), "table", "scans.csv line 3 points"),
    "copy of the table": (row(1, "points", 1), "table", "scans.mcap.scans.csv"),
    "profile": (mcap(profile="ros1"), "metadata", "profile"),
    "a byte of a chunk": (raw("", flipped(300_000)), "container", "chunk at byte"),
    "a byte of the summary": (raw("", flipped(-200)), "container", "CRC of the summary"),
    "last bytes": (raw("", flipped(-1)), "container", "last bytes"),
    "a byte of the table": (text("", "index,slice", "Index,slice"), "container", "scans.csv CRC"),
}


def of_sensor(layout: str, name: str, value: float) -> Edit:
    """Another value in point 3 of a scan of the left sensor."""
    return mcap(only("/left/points", 1, put(layout, name, 3, value)))


SPLIT: dict[str, Case] = {
    "point of another sensor": (
        of_sensor("standard", "lidar_id", 1),
        "sensors",
        "/left/points message 1 point 3",
    ),
    "scan of another sensor": (
        mcap(only("/left/points", 1, on("/right/points"))),
        "sensors",
        "/right/points",
    ),
}
AUTOWARE: dict[str, Case] = {
    "azimuth": (
        of_sensor("autoware", "azimuth", 9.0),
        "geometry",
        "/left/points message 1 point 3",
    ),
    "elevation": (of_sensor("autoware", "elevation", 1.5), "geometry", "point 3"),
    "distance": (of_sensor("autoware", "distance", 1.5), "geometry", "point 3"),
    "return type": (of_sensor("autoware", "return_type", 88), "returns", "point 3"),
    "ns": (of_sensor("autoware", "time_stamp", 4e9), "times", "point 3"),
}
OUSTER: dict[str, Case] = {
    "range in mm": (of_sensor("ouster", "range", 60_000), "geometry", "point 3"),
}
MINIMAL: dict[str, Case] = {
    "place": (scan(1, put("minimal", "x", 3, np.inf)), "finite", "point 3"),
}
ROSBAG2: dict[str, Case] = {
    "count of metadata.yaml": (
        text("metadata.yaml", "message_count: ", "message_count: 1"),
        "metadata",
        "metadata.yaml",
    ),
    "file of metadata.yaml": (
        text("metadata.yaml", "bag2_0.mcap", "other.mcap"),
        "names",
        "relative_file_paths",
    ),
    "start of metadata.yaml": (
        text("metadata.yaml", "since_epoch: 1", "since_epoch: 2"),
        "metadata",
        "starting_time",
    ),
    "duration of metadata.yaml": (
        text("metadata.yaml", "    nanoseconds: ", "    nanoseconds: 1"),
        "metadata",
        "duration",
    ),
    "scan left out": (scan(1, gone), "metadata", "metadata.yaml"),
}
ROSBAG1: dict[str, Case] = {
    "log time": (bag(only("/points", 1, later(7))), "stamps", "message 1"),
    "scan left out": (bag(only("/points", 1, gone)), "table", "scan"),
    "value": (
        bag(only("/points", 1, put("standard", "x", 3, np.nan))),
        "finite",
        "/points message 1 point 3",
    ),
    "IMU left out": (bag(only("/left/imu", 3, gone)), "imu", "sensors.0"),
    "table": (row(1, "points", 1), "table", "line 3 points"),
    "sensors of the report": (report("sensors", to=[]), "metadata", "scans.csv sensors"),
    "report": (report("scans", "points", to=1), "report", "points"),
}


def half(records: Records) -> None:
    records["y"][np.flatnonzero(np.isfinite(records["x"]))[7]] = np.nan


def owner(records: Records) -> None:
    records["lidar_id"][np.flatnonzero(np.isnan(records["x"]))[7]] ^= 1


def moment(records: Records) -> None:
    records["time"][np.flatnonzero(np.isfinite(records["x"]))[7]] += 0.05


def ring(records: Records) -> None:
    records["ring"][np.flatnonzero(np.isnan(records["x"]))[7]] = 3


ORGANIZED: dict[str, Case] = {
    change.__name__: (scan(1, points("standard", change)), check, "/points message 1")
    for change, check in ((half, "finite"), (owner, "sensors"), (moment, "times"), (ring, "finite"))
}
TABLES = {
    "scans.mcap": MCAP,
    "split.mcap": SPLIT,
    "organized.mcap": ORGANIZED,
    "autoware.mcap": AUTOWARE,
    "ouster.mcap": OUSTER,
    "minimal.mcap": MINIMAL,
    "bag2": ROSBAG2,
    "scans.bag": ROSBAG1,
}


@pytest.mark.parametrize(("kind", "case"), cases(TABLES))
def test_damage_is_found(kind: str, case: Case, tmp_path: Path) -> None:
    check_case(kind, case, tmp_path)


def test_frames_are_named_in_order(tmp_path: Path) -> None:
    """The order in a set depends on the process."""
    edit, _, _ = MCAP["frame of transforms"]
    found = {one.where: one for one in damaged("scans.mcap", tmp_path, edit).violations}
    root = found["scans.mcap /tf_static message 0 root"]
    assert (root.expected, root.found) == ("['base_link']", "['base_link', 'cars_link']")


@pytest.mark.parametrize(
    "kind", ["scans.mcap", "split.mcap", "organized.mcap", "bag2", "scans.bag"]
)
def test_rewritten_files_are_clean(kind: str, tmp_path: Path) -> None:
    path = copied(kind, tmp_path)
    edit = bag(lambda sent: [sent]) if kind == "scans.bag" else mcap()
    edit(path)
    verdict = verify(path)
    assert verdict.ok, verdict.violations
