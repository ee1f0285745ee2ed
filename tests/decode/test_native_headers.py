"""Compiled loops on headers: what they read is what numpy reads, and they leave all else to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch.arrays import I64Array, U8Array
from mlbatch.batching.intake import rises
from mlbatch.lidar.interface import Lidar
from mlbatch.sensors.ouster.profiles import FUSA, PROFILES, STANDARD
from tests.builders.engines import needs_native
from tests.builders.headers import ouster_packets, read_by_loops, same_as_numpy
from tests.builders.ouster import OusterSpec
from tests.builders.velodyne import VelodyneSpec
from tests.builders.velodyne_streams import MODES, PLAIN, made_of

pytestmark = needs_native

OUSTER = tuple(
    OusterSpec(name, 16, 512, header=header, serial=122201000998)
    for name in PROFILES
    if name != "OFF"
    for header in (STANDARD, FUSA)
)
# Blind sectors are gaps; at 3599.997 s the hour ends.
VELODYNE = tuple(
    VelodyneSpec(model, mode, start_azimuth_deg=357.2, start_us=3_599_997_000.0)
    for model in (*PLAIN, "HDL-64E S3")
    for mode in MODES
)


def test_of_usual_ouster_packets_all_are_read() -> None:
    for spec in OUSTER:
        lidar, packets = ouster_packets(spec)
        host_ns = np.zeros(len(packets), np.int64)
        assert same_as_numpy(lidar, packets, host_ns), spec


def test_of_usual_velodyne_packets_all_are_read() -> None:
    for spec in VELODYNE:
        made = made_of(spec)
        assert same_as_numpy(made.lidar, made.sent.payloads, made.sent.host_ns), spec


@pytest.mark.parametrize("change", ["swapped", "unmeasured", "serial", "type", "position"])
def test_unusual_ouster_packets_are_left_to_numpy(change: str) -> None:
    lidar, packets = ouster_packets(OusterSpec("RNG15_RFL8_NIR8", 16, 512, serial=122201000998))
    column = lidar.records.start
    if change == "swapped":
        packets = packets[[0, 2, 1]]
    elif change == "unmeasured":
        packets[1, column + 10] = 0
    elif change == "serial":
        packets[1, 7] ^= 1
    elif change == "type":
        packets[1, 0] = 3
    else:
        packets[1, column + 8 : column + 10] = (0, 2)
    assert read_by_loops(lidar, packets, np.zeros(len(packets), np.int64)) is None


@pytest.mark.parametrize("change", ["swapped", "flag", "azimuth", "hour", "mode", "gap"])
def test_unusual_velodyne_packets_are_left_to_numpy(change: str) -> None:
    made = made_of(VelodyneSpec("VLP-16", "strongest"))
    packets = made.sent.payloads.copy()
    if change == "swapped":
        packets = packets[[0, 2, 1]]
    elif change == "flag":
        packets[1, 100] = 0
    elif change == "azimuth":
        packets[1, 102:104] = np.array([36001], "<u2").view(np.uint8)
    elif change == "hour":
        packets[1, 1200:1204] = np.array([3_600_000_000], "<u4").view(np.uint8)
    elif change == "mode":
        packets[1, 1204] = 0x39
    else:
        first = int(packets[1, 2:4].view("<u2")[0])
        packets[1, 102:104] = np.array([(first + 3000) % 36000], "<u2").view(np.uint8)
    assert read_by_loops(made.lidar, packets, made.sent.host_ns[: len(packets)]) is None


def damaged(packets: U8Array, seed: int, flips: int) -> tuple[U8Array, I64Array]:
    """Packets with some bytes replaced, one of them repeated or left out; receive times."""
    rng = np.random.default_rng(seed)
    changed = packets[np.sort(rng.integers(0, len(packets), len(packets)))]
    row = rng.integers(0, len(changed), flips)
    # Most bytes are pixels: aim at the header and at the first columns or blocks.
    byte = rng.integers(0, rng.choice((40, 120, 700, packets.shape[1])), flips)
    changed[row, np.minimum(byte, packets.shape[1] - 1)] = rng.integers(0, 256, flips)
    host_ns = 10**18 + rng.integers(0, 10**13, len(changed))
    return changed, host_ns


LIDARS: list[tuple[Lidar, U8Array]] = []


def lidars() -> list[tuple[Lidar, U8Array]]:
    """Lidars of both kinds of headers, and packets of them."""
    if not LIDARS:
        specs = (*OUSTER[:4], replace(OUSTER[0], serial=0))
        LIDARS.extend(ouster_packets(spec) for spec in specs)
        made = [made_of(spec) for spec in VELODYNE[::2]]
        LIDARS.extend((one.lidar, one.sent.payloads) for one in made)
    return LIDARS


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 3))
def test_of_damaged_packets_all_that_is_read_is_right(seed: int, flips: int) -> None:
    for lidar, packets in lidars():
        changed, host_ns = damaged(packets, seed, flips)
        same_as_numpy(lidar, changed, host_ns)


def test_rising_columns() -> None:
    lidar, packets = ouster_packets(OUSTER[0])
    host_ns = np.zeros(len(packets), np.int64)
    assert rises(lidar.column_headers(packets, host_ns))
    assert not rises(lidar.column_headers(packets[::-1], host_ns))
    assert not rises(lidar.column_headers(packets[:0], host_ns[:0]))
