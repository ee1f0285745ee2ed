"""Names of packets: those of real recordings, and none for bytes that are no lidar's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch import sensors
from mlbatch.sensors.ouster.profiles import PROFILES
from tests.builders.naming import named
from tests.builders.others import (
    filled,
    livox2_packets,
    rows,
    velodyne_packets,
)
from tests.builders.ouster import OusterSpec, encode_frame, imu_packet


def test_a_damaged_packet_does_not_hide_a_stream() -> None:
    xt16 = filled(568, {0: bytes.fromhex("eeff06010000100801040201"), 550: b"\x37"})
    streams = [
        velodyne_packets(b"\x37\x22", 110.592),
        rows([xt16] * 2),
        livox2_packets(1, 14, 96),
    ]
    for packets in streams:
        whole = np.concatenate([packets, packets[-1:]])
        expected = named(whole)
        assert expected is not None
        whole[1] = np.random.default_rng(5).integers(0, 256, packets.shape[1], np.uint8)
        assert named(whole) == expected


@pytest.mark.parametrize("profile", [name for name, one in PROFILES.items() if one.fields])
def test_packets_of_ouster_are_unknown_to_others(profile: str) -> None:
    for beams in (16, 32, 64, 128):
        spec = OusterSpec(profile=profile, beams=beams, columns_per_frame=512)
        ranges = np.full((512, beams, 1), 4000)
        packets = encode_frame(spec, 1_700_000_000_000_000_000, 5, ranges)[:4]
        sample = rows(packets)
        assert named(sample) is None
        assert all(named(packet[None]) is None for packet in sample)


def test_imu_packets_of_ouster_are_unknown_to_others() -> None:
    spec = OusterSpec(imu_profile="ACCEL32_GYRO32_NMEA")
    data = imu_packet(spec, np.arange(1, 9), np.ones((8, 3)), np.ones((8, 3)))
    assert named(rows([data])) is None


SIZES = [34, 42, 51, 80, 99, 512, 568, 678, 786, 812, 861, 918, 978, 1072, 1080, 1127, 1194, 1200]
SIZES += [1206, 1210, 1212, 1248, 1256, 1262, 1268, 1278, 1318, 1362, 1380, 1388]


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(SIZES) | st.integers(1, 1500), st.integers(0, 2**32), st.integers(1, 4))
def test_random_bytes_are_unknown(size: int, seed: int, count: int) -> None:
    noise = np.random.default_rng(seed).integers(0, 256, (count, size), np.uint8)
    assert named(noise) is None


@settings(max_examples=100, deadline=None)
@given(st.binary(min_size=1, max_size=1500), st.integers(1, 3))
def test_any_bytes_give_a_name_or_none(payload: bytes, count: int) -> None:
    assert "\n" not in (named(rows([payload] * count)) or "")


@pytest.mark.parametrize("fill", [0, 1, 2, 0x55, 0xEE, 0xFF])
def test_bytes_that_are_all_the_same_are_unknown(fill: int) -> None:
    for size in range(1, 1500):
        assert named(np.full((2, size), fill, np.uint8)) is None


def test_nothing_is_unknown() -> None:
    for plugin in sensors.plugins():
        assert plugin.describe(0, np.zeros((0, 0), np.uint8)) is None
        assert plugin.describe(1206, np.zeros((0, 1206), np.uint8)) is None
        assert plugin.describe(1206, np.zeros((1, 100), np.uint8)) is None
