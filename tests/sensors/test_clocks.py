"""Times in packets: dates, hours, and what is measured of a clock, by docs/sources.

Seconds of dates: `date -u -d ... +%s`.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.arrays import I64Array
from mlbatch.lidar.interface import NeighbourStream
from mlbatch.sensors.robosense.models import BPEARL_V3, BPEARL_V4
from mlbatch.sensors.robosense.packets import times_ns as robosense_ns
from mlbatch.sensors.velodyne.clock import (
    HOUR_NS,
    absolute_ns,
    clock_offset_ns,
    pulse,
    rmc_ns,
    rotor_speed,
)
from mlbatch.simulate.hesai.encode import HesaiSpec, date_field
from mlbatch.simulate.hesai.models import EPOCH, SINCE_1900
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.types import Stream
from tests.builders.others import filled, rows
from tests.builders.spinning import STREAM, Encoded, stream_of

VLP16 = VelodyneSpec("VLP-16")
POSITIONS = Stream("192.168.1.201", 8308)
SECOND_NS, HALF_NS = 1_000_000_000, HOUR_NS // 2
# 21 January 2016, 08:18:02 UTC: the sentence of the sheet's recording, section 8.
RMC_NS = 1_453_364_282 * SECOND_NS


def rmc(body: bytes, checksum: int | None = None) -> bytes:
    if checksum is None:
        checksum = 0
        for byte in body:
            checksum ^= byte
    return b"$" + body + b"*%02X\r\n\0\0" % checksum


BODY = b"GPRMC,081802,A,3650.1,N,00224.4,W,000.0,123.2,210116,000.5,W"


@pytest.mark.parametrize(
    ("old", "new", "after_ns"),
    [
        (b"", b"", 0),
        (b"081802", b"081802.25", SECOND_NS // 4),
        (b"GPRMC", b"GNRMC", 0),
        (b",A,", b",V,", None),
        (b"081802", b"251802", None),
        (b"210116", b"211316", None),
        (b",123.2,210116,000.5,W", b"", None),
        (b"GPRMC", b"GPGGA", None),
    ],
)
def test_sentences(old: bytes, new: bytes, after_ns: int | None) -> None:
    assert old in BODY
    found_ns = rmc_ns(rmc(BODY.replace(old, new, 1)))
    assert found_ns == (None if after_ns is None else RMC_NS + after_ns)


def test_a_wrong_checksum_and_no_sentence() -> None:
    assert [rmc_ns(text) for text in (rmc(BODY, 0), b"\0" * 128, b"$" + BODY)] == [None] * 3


def test_the_nearest_hour_of_random_cases() -> None:
    rng = np.random.default_rng(3)
    true_ns = rng.integers(10**18, 2 * 10**18, 20_000) // 1000 * 1000
    error_ns = rng.integers(-1700, 1700, 20_000) * SECOND_NS
    assert (absolute_ns(true_ns % HOUR_NS, true_ns + error_ns) == true_ns).all()


def test_around_half_an_hour_all_packets_get_one_hour() -> None:
    """The capture host is half an hour ahead, give or take its jitter."""
    stream = stream_of(VelodyneSpec("VLP-16"), 200)
    jitter_ns = np.random.default_rng(1).integers(-(10**9), 10**9, 200)
    moved = replace(stream, host_ns=stream.host_ns + HALF_NS + jitter_ns)
    stamp_ns = moved.headers(moved.lidar()).stamp_ns.reshape(-1)
    assert (np.diff(stamp_ns) > 0).all()
    away_ns = stamp_ns - stream.truth.time_ns[:, 0]
    assert set(np.rint(away_ns / HOUR_NS).tolist()) < {0.0, 1.0}


def test_a_stream_across_the_full_hour() -> None:
    stream = stream_of(VelodyneSpec("VLP-32C", start_us=3_599_990_000.0), 60)
    stream = replace(stream, host_ns=stream.host_ns - 900 * SECOND_NS)
    stamp_ns = stream.headers(stream.lidar()).stamp_ns.reshape(-1)
    assert np.abs(stamp_ns - stream.truth.time_ns[:, 0]).max() <= 500


def test_no_clock_at_all_gives_no_stamps_before_1970() -> None:
    for start_us in (10.0, 1_800_000_000.0, 3_599_000_000.0):
        stream = stream_of(VelodyneSpec("VLP-16", start_us=start_us), 30)
        unknown = replace(stream, host_ns=np.zeros(30, np.int64))
        assert (unknown.headers(unknown.lidar()).stamp_ns >= 0).all()


def test_position_packets_override_receive_times() -> None:
    behind_ns = 7 * HOUR_NS + 1234
    sent = stream_of(VLP16, 16)
    for valid, hours in ((True, 0), (False, -7)):
        payloads = [VLP16.device_packet(at * SECOND_NS, valid=valid) for at in range(4)]
        host_ns = VLP16.begin_ns + np.arange(4) * SECOND_NS - behind_ns
        neighbour = beside_of(payloads, host_ns)
        offset_ns = clock_offset_ns(sent.packets, sent.host_ns - behind_ns, [neighbour])
        away_ns = behind_ns + hours * HOUR_NS
        assert offset_ns == pytest.approx(away_ns, abs=3_000_000)


def test_nothing_is_no_offset() -> None:
    assert clock_offset_ns(np.zeros((0, 1206), np.uint8), np.zeros(0, np.int64), []) == 0


def test_the_speed_of_one_packet_is_that_within_it() -> None:
    one = np.zeros(1, np.int64)
    assert [rotor_speed(one, one, rough) for rough in (3.5e-4, None, 0.0)] == [3.5e-4, None, None]


def test_what_positions_say_of_the_pulse() -> None:
    sent = [[VLP16.device_packet(0, pps=state)] * 3 for state in range(4)]
    words = [pulse([beside_of(one, np.zeros(3, np.int64))]) for one in sent]
    assert words == ["no PPS", "PPS synchronising", "PPS locked", "PPS error"]
    assert pulse([]) == ""
    # Packets of another size, and of the same size but of another kind.
    noise = np.random.default_rng(2).integers(0, 256, (3, 512), np.uint8)
    other = NeighbourStream(STREAM, 1206, np.zeros((3, 1206), np.uint8), np.zeros(3, np.int64))
    assert pulse([other, NeighbourStream(POSITIONS, 512, noise, np.zeros(3, np.int64))]) == ""


def beside_of(payloads: list[bytes], host_ns: I64Array) -> NeighbourStream:
    return NeighbourStream(POSITIONS, 512, rows(payloads), host_ns)


# -- dates ----------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _jt16() -> Encoded:
    """A HESAI whose packets begin with their date, and whose columns are stamped with it."""
    return stream_of(HesaiSpec("JT16"), 2)


def hesai_ns(date: bytes, us: int) -> int | None:
    """The stamp of a packet; None where its date is damage."""
    packets = _jt16().damaged((6, date + struct.pack("<I", us)))
    lidar = _jt16().lidar()
    if lidar.faults(packets)[0]:
        return None
    return int(lidar.column_headers(packets, np.zeros(2, np.int64)).stamp_ns[0, 0])


@pytest.mark.parametrize(
    ("date", "us", "time_ns"),
    [
        # The first packets of the recordings of a Pandar40P and a Pandar64, docs/sources/hesai.md
        # 0.
        (bytes([17, 9, 6, 16, 19, 46]), 881567, 1504714786881567000),
        (bytes([120, 6, 25, 12, 2, 9]), 977341, 1593086529977341000),
        (bytes([69, 12, 31, 23, 59, 59]), 0, 3155759999 * 10**9),  # 2069
        (bytes([124, 2, 29, 0, 0, 0]), 1, 1709164800000001000),
        # A full second of microseconds carries, here into another year.
        (bytes([123, 12, 31, 23, 59, 59]), 1_000_000, 1704067200 * 10**9),
        # Seconds since 1970, big endian, all five bytes.
        (b"\0" + (1_700_000_000).to_bytes(5, "big"), 5, 1_700_000_000_000_005_000),
        (b"\0\1" + bytes(4), 0, 2**32 * 10**9),
        (bytes([123, 13, 1, 0, 0, 0]), 0, None),
        (bytes([123, 2, 29, 0, 0, 0]), 0, None),  # 2023 is no leap year
        (bytes([123, 1, 1, 24, 0, 0]), 0, None),
        (bytes([123, 1, 1, 0, 0, 60]), 0, None),
        (bytes([123, 1, 1, 0, 0, 0]), 1_000_001, None),
        (b"\0" + bytes([255] * 5), 0, None),  # beyond int64 ns
    ],
)
def test_dates_of_hesai(date: bytes, us: int, time_ns: int | None) -> None:
    assert hesai_ns(date, us) == time_ns


@given(st.integers(10**9, 4 * 10**9), st.sampled_from([SINCE_1900, EPOCH]))
def test_dates_of_the_encoder(second: int, form: str) -> None:
    expected_ns = second * 10**9 + 999_999_000
    assert hesai_ns(date_field(second * 10**9, form), 999_999) == expected_ns


def seconds(second: int, micro: int) -> bytes:
    return second.to_bytes(6, "big") + struct.pack(">I", micro)


@pytest.mark.parametrize(
    ("date", "time_s"),
    [
        ((0, 1, 1, 0, 0, 0), 946_684_800),
        ((24, 2, 29, 23, 59, 59), 1_709_251_199),
        ((38, 1, 19, 3, 14, 7), 2**31 - 1),
        ((24, 12, 31, 23, 59, 60), 1_735_689_600),  # a leap second
    ],
)
def test_dates_of_robosense(date: tuple[int, ...], time_s: int) -> None:
    time = bytes(date) + struct.pack(">HH", 999, 999)
    found_ns, good = robosense_ns(rows([filled(1248, {20: time})]), BPEARL_V3)
    assert good.all()
    assert found_ns.tolist() == [time_s * 10**9 + 999_999_000]


@pytest.mark.parametrize(
    ("place", "value"),
    [(1, 0), (1, 13), (2, 0), (2, 32), (3, 24), (4, 60), (5, 61), (6, 4), (8, 4)],
)
def test_dates_of_robosense_that_do_not_exist(place: int, value: int) -> None:
    time = bytearray(bytes((24, 6, 15, 12, 30, 30)) + bytes(4))
    time[place] = value
    assert not robosense_ns(rows([filled(1248, {20: bytes(time)})]), BPEARL_V3)[1].any()


@pytest.mark.parametrize(
    ("time", "is_good"),
    [
        (seconds(1, 1_000_000), False),
        (seconds(1 << 33, 0), False),
        (seconds((1 << 48) - 1, 0), False),
        (seconds((1 << 33) - 1, 999_999), True),
    ],
)
def test_seconds_of_robosense(time: bytes, is_good: bool) -> None:
    found_ns, good = robosense_ns(rows([filled(1248, {20: time})]), BPEARL_V4)
    assert good.all() == is_good
    if is_good:
        assert found_ns.tolist() == [((1 << 33) - 1) * 10**9 + 999_999_000]
