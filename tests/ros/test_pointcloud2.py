"""Decoded clouds: fields, times and mistakes."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from mlbatch.ros.point_packets import CloudError
from mlbatch.ros.pointcloud2 import Cloud, read_cloud
from mlbatch.types import Message, Topic
from tests.builders.points import (
    AUTOWARE,
    CLOUD,
    CUSTOM,
    CUSTOM2,
    HESAI,
    LIVOX,
    OUSTER,
    STAMP_NS,
    VELODYNE,
    XYZ,
    Form,
    Point,
    cloud_message,
    custom_message,
)

ENCODINGS = ("cdr", "ros1")
HEADER = "the header's stamp"
# Values of two points by the fields of a driver, their stamps, and the verdict.
DRIVERS: dict[str, tuple[Sequence[tuple[str, str]], list[Point], list[int], str]] = {
    "ouster": (
        OUSTER,
        [(1, 2, 3, 9, 0, 4), (4, 5, 6, 9, 99_902_343, 5)],
        [STAMP_NS, STAMP_NS + 99_902_343],
        f"t (uint32), ns after {HEADER}",
    ),
    # Halves, quarters and eighths are exact in every float; the driver counts back from the end.
    "velodyne": (
        VELODYNE,
        [(1, 2, 3, 9, 4, -0.0625), (4, 5, 6, 9, 5, -0.03125)],
        [STAMP_NS - 62_500_000, STAMP_NS - 31_250_000],
        f"time (float32), s up to {HEADER}",
    ),
    "velodyne, from the first packet on": (
        VELODYNE,
        [(1, 2, 3, 9, 4, 0.0), (4, 5, 6, 9, 5, 0.0625)],
        [STAMP_NS, STAMP_NS + 62_500_000],
        f"time (float32), s after {HEADER}",
    ),
    "hesai": (
        HESAI,
        [(1, 2, 3, 9, 4, 1_650_000_000.25), (4, 5, 6, 9, 5, 1_650_000_000.3125)],
        [1_650_000_000_250_000_000, 1_650_000_000_312_500_000],
        "timestamp (float64), s since 1970",
    ),
    # A float64 resolves multiples of 256 ns there.
    "livox": (
        LIVOX,
        [(1, 2, 3, 9, 16, 4, 1.7e18), (4, 5, 6, 9, 0, 5, 1.7e18 + 25_600)],
        [1_700_000_000_000_000_000, 1_700_000_000_000_025_600],
        "timestamp (float64), ns since 1970",
    ),
    "autoware": (
        AUTOWARE,
        [(1, 2, 3, 9, 1, 4, 7), (4, 5, 6, 9, 1, 5, 70_000_000)],
        [STAMP_NS + 7, STAMP_NS + 70_000_000],
        f"time_stamp (uint32), ns after {HEADER}",
    ),
}


def _read(data: bytes, kind: str = CLOUD, encoding: str = "cdr") -> Cloud:
    return read_cloud(Message(Topic("/points", kind, encoding), STAMP_NS, data))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("driver", DRIVERS)
def test_times_of_drivers(driver: str, encoding: str) -> None:
    fields, points, stamps_ns, verdict = DRIVERS[driver]
    cloud = _read(cloud_message(fields, points, form=Form(encoding)), encoding=encoding)
    assert cloud.points.stamp_ns.tolist() == stamps_ns
    assert (cloud.time_meaning, cloud.frame) == (verdict, "lidar")
    assert cloud.points.reals.tolist() == [[1, 4], [2, 5], [3, 6], [9, 9]]
    ring = cloud.points.ring
    assert ring is not None
    assert ring.tolist() == [4, 5]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_fields_are_those_of_each_message(encoding: str) -> None:
    """Lists of equal length that differ by order or place, at any byte of a message."""
    swapped = [OUSTER[1], OUSTER[0], *OUSTER[2:]]
    for frame in ("lidar", "l", "lid", "li", "lidar_1"):
        for fields, first in ((OUSTER, [1, 2]), (swapped, [2, 1]), (OUSTER, [1, 2])):
            form = Form(encoding, frame=frame)
            points = [(1, 2, 3, 9, 0, 4), (1, 2, 3, 9, 1000, 5)]
            cloud = _read(cloud_message(fields, points, form=form), encoding=encoding)
            assert cloud.points.reals[:2, 0].tolist() == first
            assert cloud.frame == frame


def test_more_lists_of_fields_than_are_kept_are_read() -> None:
    for _ in range(2):
        for spare in range(40):
            fields = [*OUSTER, (f"spare_{spare}", OUSTER[0][1])]
            cloud = _read(cloud_message(fields, [(1, 2, 3, 9, 0, 4, 7), (1, 2, 3, 9, 9, 5, 7)]))
            assert cloud.points.stamp_ns.tolist() == [STAMP_NS, STAMP_NS + 9]


def test_return_types_and_tags_are_kept() -> None:
    autoware = _read(cloud_message(AUTOWARE, DRIVERS["autoware"][1]))
    assert autoware.points.return_type.tolist() == [1, 1]
    livox = _read(cloud_message(LIVOX, DRIVERS["livox"][1]))
    assert livox.points.tag.tolist() == [16, 0]


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        (("ts", "time"), "time"),
        (("time", "t"), "t"),
        (("offset_time", "timestamps"), "timestamps"),
        (("time_stamp", "timestamp"), "timestamp"),
    ],
)
def test_of_several_times_the_first_of_the_list_counts(names: tuple[str, ...], chosen: str) -> None:
    fields = (*XYZ, *((name, "uint32") for name in names))
    point = (1, 0, 0, *(5 if name == chosen else 6 for name in names))
    assert _read(cloud_message(fields, [point])).points.stamp_ns.tolist() == [STAMP_NS + 5]


@pytest.mark.parametrize("kind", [CUSTOM, CUSTOM2])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_custom_messages_count_from_their_timebase(kind: str, encoding: str) -> None:
    points = [(0, 1, 2, 3, 7, 16, 0), (4167, 4, 5, 6, 8, 0, 3), (8334, 0, 0, 0, 0, 0, 1)]
    data = custom_message(points, timebase_ns=STAMP_NS, encoding=encoding)
    cloud = _read(data, kind, encoding)
    assert cloud.points.stamp_ns.tolist() == [STAMP_NS, STAMP_NS + 4167]
    assert cloud.points.reals.tolist() == [[1, 4], [2, 5], [3, 6], [7, 8]]
    assert cloud.points.ring is not None
    assert cloud.points.ring.tolist() == [0, 3]
    assert cloud.points.tag.tolist() == [16, 0]
    assert (cloud.time_meaning, cloud.without_place) == (
        "offset_time (uint32), ns after timebase",
        1,
    )


def test_a_custom_message_without_timebase_counts_from_its_header() -> None:
    cloud = _read(custom_message([(5, 1, 2, 3, 7, 16, 0)], 0, STAMP_NS), CUSTOM)
    assert cloud.points.stamp_ns.tolist() == [STAMP_NS + 5]
    assert cloud.time_meaning.endswith(HEADER)


def test_points_without_place_or_time_are_counted() -> None:
    nan, inf = float("nan"), float("inf")
    points: list[Point] = [(1, 2, 3, 9, 4, 0.5), (0, 0, 0, 9, 4, 0.5), (nan, 2, 3, 9, 4, 0.5)]
    points += [(1, inf, 3, 9, 4, 0.5), (1, 2, 3, 9, 4, nan), (1e30, 2, 3, 9, 4, 0.5)]
    cloud = _read(cloud_message(VELODYNE, points))
    assert (len(cloud.points), cloud.without_place, cloud.without_time) == (1, 4, 1)


def test_rows_and_points_may_have_gaps() -> None:
    form = Form(height=2, gap=5, row_gap=3)
    points = [(row, column, 1, 9, column, row) for row in range(2) for column in range(3)]
    cloud = _read(cloud_message(OUSTER, points, form=form))
    assert cloud.points.reals[:2].tolist() == [[0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2]]
    assert (cloud.points.stamp_ns - STAMP_NS).tolist() == [0, 1, 2, 0, 1, 2]


def test_places_may_be_float64_and_levels_whole_numbers() -> None:
    fields = (*((axis, "float64") for axis in "xyz"), ("reflectivity", "uint16"), ("t", "int32"))
    cloud = _read(cloud_message(fields, [(0.5, -1, 2, 60_000, -5)]))
    assert cloud.points.reals[:, 0].tolist() == [0.5, -1, 2, 60_000]
    assert cloud.points.stamp_ns.tolist() == [STAMP_NS - 5]
    assert cloud.points.ring is None


@pytest.mark.parametrize(("kind", "ring"), [("int8", -1), ("float32", 3), ("int32", 1 << 16)])
def test_a_ring_is_a_small_whole_number_or_none(kind: str, ring: float) -> None:
    fields = (*XYZ, ("t", "uint32"), ("ring", kind), ("tag", kind))
    cloud = _read(cloud_message(fields, [(1, 2, 3, 5, ring, ring), (1, 2, 3, 6, 2, 2)]))
    assert cloud.points.ring is None
    assert cloud.points.tag.tolist() == [0, 0]


def test_a_message_of_the_reference_library_is_read_alike() -> None:
    """rosbags serialises by the definitions of ROS itself."""
    for encoding, store in (("cdr", Stores.ROS2_HUMBLE), ("ros1", Stores.ROS1_NOETIC)):
        points = DRIVERS["ouster"][1]
        types = get_typestore(store)
        data = bytes(_by_rosbags(types, encoding, points))
        assert data == cloud_message(OUSTER, points, form=Form(encoding))


def _by_rosbags(types: Any, encoding: str, points: Sequence[Point]) -> memoryview:
    kinds = types.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=STAMP_NS // 10**9, nanosec=0)
    words = {"seq": 7} if encoding == "ros1" else {}
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar", **words)
    field = kinds["sensor_msgs/msg/PointField"]
    named = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("t", 16, 6)]
    fields = [field(name=n, offset=o, datatype=t, count=1) for n, o, t in [*named, ("ring", 20, 4)]]
    data = b"".join(struct.pack("<ffffIH", *point) for point in points)
    cloud = kinds["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=22,
        row_step=22 * len(points),
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )
    serialize = types.serialize_ros1 if encoding == "ros1" else types.serialize_cdr
    serialized: memoryview = serialize(cloud, "sensor_msgs/msg/PointCloud2")
    return serialized


ONE = [(1, 2, 3, 9, 5, 4)]
TIMES = (*XYZ, ("time", "float32"))
SECONDS = (*XYZ, ("time", "float64"))
MISTAKES: dict[str, tuple[bytes, str]] = {
    "no z": (
        cloud_message((*XYZ[:2], ("t", "uint32")), [(1, 2, 3)]),
        "expected fields x, y, z, found x, y, t; choose a topic of points",
    ),
    "no fields": (
        cloud_message((), []),
        "expected fields x, y, z, found none; choose a topic of points",
    ),
    "big endian": (
        cloud_message(OUSTER, ONE, form=Form(bigendian=True)),
        "expected a cloud in little endian, found is_bigendian; convert the recording",
    ),
    "count": (
        cloud_message(OUSTER, ONE, form=Form(count=3)),
        "field x: expected count 1, found 3; convert the recording",
    ),
    "whole places": (
        cloud_message((("x", "int32"), *XYZ[1:], ("t", "uint32")), [(1, 2, 3, 4)]),
        "field x: expected datatype 7 or 8 (float), found 5; convert the recording",
    ),
    "width": (
        cloud_message(OUSTER, ONE, form=Form(width=2_000_000_000)),
        "expected 1 x 2000000000 points of 22 bytes in rows of 22, found 22 bytes of data; the "
        "cloud was cut off, or written wrongly",
    ),
    "step": (
        cloud_message(OUSTER, ONE, form=Form(point_step=20)),
        "field ring: expected it within the 20 bytes of a point, found its end at byte 22; the "
        "cloud was written wrongly",
    ),
    "no step": (
        cloud_message(OUSTER, ONE, form=Form(width=4_000_000_000, point_step=0)),
        "field x: expected it within the 0 bytes of a point, found its end at byte 4; the "
        "cloud was written wrongly",
    ),
    "rows": (
        cloud_message(OUSTER, ONE * 4, form=Form(height=2, row_step=21)),
        "expected 2 x 2 points of 22 bytes in rows of 21, found 88 bytes of data; the cloud "
        "was cut off, or written wrongly",
    ),
    "header": (
        cloud_message(OUSTER, ONE, stamp_ns=0),
        "field t (uint32): expected times after the header's stamp, found 0 ns there; set the "
        "clock of its driver and record again",
    ),
    "unit": (
        cloud_message(TIMES, [(1, 2, 3, 1e5)]),
        "field time (float32): expected s after the header's stamp (below 1000), or float64 s "
        "or ns since 1970, found 100000; give its unit in the rig (points: {unit: us})",
    ),
    "float32 since 1970": (
        cloud_message(TIMES, [(1, 2, 3, 1.7e9)]),
        "field time (float32): expected s after the header's stamp (below 1000), or float64 s "
        "or ns since 1970, found 1.7e+09; give its unit in the rig",
    ),
    "far too late": (
        cloud_message(SECONDS, [(1, 2, 3, 1e300)]),
        "field time (float64): expected s after the header's stamp (below 1000), or float64 s "
        "or ns since 1970, found 1e+300; give its unit in the rig",
    ),
    "milliseconds": (
        cloud_message(TIMES, [(1, 2, 3, 0), (1, 2, 3, 100)]),
        "field time (float32): expected times of one cloud within 10 s, found 100 s; give "
        "its unit in the rig (points: {unit: us}), or record the raw packets",
    ),
    "far too early": (
        cloud_message(SECONDS, [(1, 2, 3, -1e300), (1, 2, 3, 0.5)]),
        "field time (float64): expected times of one cloud within 10 s, found 1e+300 s; "
        "give its unit in the rig",
    ),
    "other CDR": (
        b"\0\0" + cloud_message(OUSTER, ONE)[2:],
        "expected a message of little-endian CDR (00 01 00 00), found 00 00 00 00; convert the "
        "recording to that encoding",
    ),
    "empty": (b"", "expected 4 bytes at byte 0 of a message, found its end; it was cut off"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_one_line_for_every_mistake(mistake: str) -> None:
    data, line = MISTAKES[mistake]
    with pytest.raises(CloudError) as caught:
        _read(data)
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


def _outcome(data: bytes, kind: str, encoding: str) -> str | int:
    """Points of a message, or the line that refuses it."""
    try:
        return len(_read(data, kind, encoding).points)
    except CloudError as err:
        return str(err)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
@pytest.mark.parametrize("kind", [CLOUD, CUSTOM])
def test_no_cut_and_no_wrong_byte_is_more_than_a_line(kind: str, encoding: str) -> None:
    whole = cloud_message(OUSTER, ONE * 3, form=Form(encoding, height=3))
    if kind == CUSTOM:
        whole = custom_message([(5, 1, 2, 3, 7, 16, 0)] * 3, encoding=encoding)
    damaged = [whole[:size] for size in range(len(whole) - 1)]
    damaged += [
        whole[:at] + bytes([value]) + whole[at + 1 :]
        for at in range(len(whole))
        for value in (0, 0x7F, 0xFF)
    ]
    for data in damaged:
        outcome = _outcome(data, kind, encoding)
        assert outcome in range(4) if isinstance(outcome, int) else "\n" not in outcome


def test_one_time_for_more_points_than_a_column_has_is_refused() -> None:
    points = [(1, 2, 3, 9, 5, 4)] * 1025
    with pytest.raises(CloudError, match="expected times of the points, found one for all 1025"):
        _read(cloud_message(OUSTER, points))
    assert len(_read(cloud_message(OUSTER, points[:1024])).points) == 1024
