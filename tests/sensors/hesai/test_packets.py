"""Dates of HESAI packets, docs/sources/hesai.md section 4; seconds by `date -u -d ... +%s`."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.lidar.headers import DatedGroups, HeaderReader, checks
from mlbatch.simulate.hesai.encode import date_field
from mlbatch.simulate.hesai.models import EPOCH, SINCE_1900

# One block of two bytes, then date and microseconds.
_READER = HeaderReader(
    DatedGroups(
        packet_bytes=12,
        columns=1,
        returns=1,
        first_block=0,
        block_bytes=2,
        azimuth_at=0,
        azimuth_bytes=2,
        circle=1 << 16,
        check_count=0,
        checks=checks(),
        has_flags=False,
        mode_at=-1,
        modes=None,
        date_at=2,
        us_at=8,
        sequence_at=-1,
        sequence_bytes=0,
        operation_at=-1,
        operations=1,
        loop_at=-1,
        states_at=-1,
        state_count=1,
        tables=np.zeros((1, 1), np.int64),
        first_ns=np.zeros(1, np.int64),
        base_ns=0,
        step_ns=np.zeros(1, np.int64),
        divisor=1,
        counts_back=False,
        azimuth_ns=0,
        rpm_at=-1,
        rpm_is_signed=False,
        turns_per_s=0.0,
    ),
    has_number=False,
)


def _read(date: bytes, us: int = 0) -> tuple[int, bool]:
    packet = np.frombuffer(b"\xff\xff" + date + struct.pack("<I", us), np.uint8)
    found = _READER.read_rows(np.stack([packet] * 2))
    return int(found.columns.stamp_ns[1, 0]), not found.faults[1]


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
