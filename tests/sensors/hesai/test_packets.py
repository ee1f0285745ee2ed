"""Dates of HESAI packets, docs/sources/hesai.md section 4; seconds by `date -u -d ... +%s`."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.sensors.hesai.packets import packet_times
from tests.builders.hesai import date_field
from tests.builders.hesai_models import EPOCH, SINCE_1900


def _read(date: bytes, us: int = 0) -> tuple[int, bool]:
    packet = np.frombuffer(b"\xff\xff" + date + struct.pack("<I", us), np.uint8)
    times_ns, valid = packet_times(np.stack([packet] * 2), 2, 8)
    return int(times_ns[1]), bool(valid[1])


@pytest.mark.parametrize(
    ("date", "us", "time_ns"),
    [
        # The first packets of the recordings of a Pandar40P and a Pandar64, docs/sources/hesai.md
        # 0.
        (bytes([17, 9, 6, 16, 19, 46]), 881567, 1504714786881567000),
        (bytes([120, 6, 25, 12, 2, 9]), 977341, 1593086529977341000),
        (bytes([70, 1, 1, 0, 0, 0]), 0, 0),
        (bytes([69, 12, 31, 23, 59, 59]), 0, 3155759999 * 10**9),  # 2069
        (bytes([124, 2, 29, 0, 0, 0]), 1, 1709164800000001000),
        # A full second of microseconds carries, here into another year.
        (bytes([123, 12, 31, 23, 59, 59]), 1_000_000, 1704067200 * 10**9),
        # Seconds since 1970, big endian, all five bytes.
        (b"\0" + (1_700_000_000).to_bytes(5, "big"), 5, 1_700_000_000_000_005_000),
        (b"\0\1" + bytes(4), 0, 2**32 * 10**9),
    ],
)
def test_dates(date: bytes, us: int, time_ns: int) -> None:
    assert _read(date, us) == (time_ns, True)


@pytest.mark.parametrize(
    ("date", "us"),
    [
        (bytes([123, 0, 1, 0, 0, 0]), 0),
        (bytes([123, 13, 1, 0, 0, 0]), 0),
        (bytes([123, 1, 0, 0, 0, 0]), 0),
        (bytes([123, 4, 31, 0, 0, 0]), 0),
        (bytes([123, 2, 29, 0, 0, 0]), 0),  # 2023 is no leap year
        (bytes([123, 1, 1, 24, 0, 0]), 0),
        (bytes([123, 1, 1, 0, 60, 0]), 0),
        (bytes([123, 1, 1, 0, 0, 60]), 0),
        (bytes([123, 1, 1, 0, 0, 0]), 1_000_001),
        (b"\0" + bytes([255] * 5), 0),  # beyond int64 ns
        (bytes([255] * 6), 0),
    ],
)
def test_what_is_no_date(date: bytes, us: int) -> None:
    assert not _read(date, us)[1]


@given(st.integers(10**9, 4 * 10**9), st.sampled_from([SINCE_1900, EPOCH]))
def test_dates_of_the_encoder(second: int, form: str) -> None:
    assert _read(date_field(second * 10**9, form), 999_999) == (second * 10**9 + 999_999_000, True)
