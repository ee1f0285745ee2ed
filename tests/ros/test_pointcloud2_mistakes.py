"""Clouds that lie, are cut off, or say nothing of time: one clear line each."""

from __future__ import annotations

import pytest

from mlbatch.ros.point_packets import CloudError
from mlbatch.ros.pointcloud2 import Cloud, read_cloud
from mlbatch.types import Message, Topic
from tests.builders.points import (
    CLOUD,
    CUSTOM,
    OUSTER,
    STAMP_NS,
    XYZ,
    Form,
    cloud_message,
    custom_message,
)


def _read(data: bytes, kind: str = CLOUD, encoding: str = "cdr") -> Cloud:
    return read_cloud(Message(Topic("/points", kind, encoding), STAMP_NS, data))


ONE = [(1, 2, 3, 9, 5, 4)]
TIMES = (*XYZ, ("time", "float32"))
SECONDS = (*XYZ, ("time", "float64"))
MISTAKES: dict[str, tuple[bytes, str]] = {
    "no time": (
        cloud_message(OUSTER[:4], [(1, 2, 3, 9)]),
        "expected the time of each point in a field t, time, timestamp, time_stamp, timestamps, "
        "offset_time or ts, found x, y, z, intensity; record the raw packets, or clouds with times",
    ),
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
        "or ns since 1970, found 100000; its unit is not known, record the raw packets",
    ),
    "float32 since 1970": (
        cloud_message(TIMES, [(1, 2, 3, 1.7e9)]),
        "field time (float32): expected s after the header's stamp (below 1000), or float64 s "
        "or ns since 1970, found 1.7e+09; its unit is not known, record the raw packets",
    ),
    "far too late": (
        cloud_message(SECONDS, [(1, 2, 3, 1e300)]),
        "field time (float64): expected s after the header's stamp (below 1000), or float64 s "
        "or ns since 1970, found 1e+300; its unit is not known, record the raw packets",
    ),
    "milliseconds": (
        cloud_message(TIMES, [(1, 2, 3, 0), (1, 2, 3, 100)]),
        "field time (float32): expected times of one cloud within 10 s, found 100 s; its unit "
        "is not known, record the raw packets",
    ),
    "far too early": (
        cloud_message(SECONDS, [(1, 2, 3, -1e300), (1, 2, 3, 0.5)]),
        "field time (float64): expected times of one cloud within 10 s, found 1e+300 s; its "
        "unit is not known, record the raw packets",
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
