"""Headers by compiled loops: all that packets literally say, of every model, whatever they are."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.lidar.headers import EvenColumns
from mlbatch.lidar.interface import Lidar
from mlbatch.sensors.ouster.profiles import FUSA, PROFILES, STANDARD
from mlbatch.simulate.ouster.encode import OusterSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from tests.builders.spinning import check_headers, ouster_packets, stream_of
from tests.contract.test_models import cases

SERIAL = 122201000998
OUSTER = tuple(
    OusterSpec(name, 16, 512, header=header, serial=SERIAL)
    for name in PROFILES
    if name != "OFF"
    for header in (STANDARD, FUSA)
)


def damaged(lidar: Lidar, packets: U8Array, seed: int) -> U8Array:
    """Packets with some bytes replaced, most of them in headers; some repeated or left out."""
    rng = np.random.default_rng(seed)
    changed = packets[np.sort(rng.integers(0, len(packets), len(packets)))]
    size = packets.shape[1]
    at = lidar.records
    column = rng.integers(0, lidar.columns_per_packet)
    start = at.start + column // at.per_row * at.stride + column % at.per_row * at.step
    # The head of the packet, that of a column or block, or the tail.
    first, count = [(0, 48), (start - 4, 16), (start, at.size), (size - 64, 64)][seed % 4]
    byte = first + rng.integers(0, count, rng.integers(1, 4))
    row = rng.integers(0, len(changed))
    changed[row, np.clip(byte, 0, size - 1)] = rng.integers(0, 256, len(byte))
    return changed


@pytest.mark.parametrize("name", cases())
def test_of_every_model_all_packets_are_read(name: str) -> None:
    stand = cases()[name]()
    packets = stand.packets[:6]
    host_ns = stand.host_ns[: len(packets)]
    found = check_headers(stand.lidar, packets, host_ns)
    assert not found.faults.any()
    for seed in range(24):
        changed = damaged(stand.lidar, packets, zlib.crc32(name.encode()) + seed)
        check_headers(stand.lidar, changed, host_ns + seed * 10**11)


@pytest.mark.parametrize("spec", OUSTER, ids=lambda spec: f"{spec.profile} {spec.header}")
def test_of_ouster_packets_all_are_read(spec: OusterSpec) -> None:
    lidar, packets = ouster_packets(spec)
    host_ns = np.zeros(len(packets), np.int64)
    found = check_headers(lidar, packets, host_ns)
    assert found.is_mine.all()
    assert not found.faults.any()
    assert found.columns.valid.all()
    for seed in range(24):
        check_headers(lidar, damaged(lidar, packets, seed), host_ns)


@pytest.mark.parametrize("change", ["swapped", "unmeasured", "serial", "type", "position"])
def test_unusual_ouster_packets(change: str) -> None:
    lidar, packets = ouster_packets(OusterSpec("RNG15_RFL8_NIR8", 16, 512, serial=SERIAL))
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
    found = check_headers(lidar, packets, np.zeros(len(packets), np.int64))
    assert found.is_mine.tolist() == [True, change != "serial", True]
    assert found.faults.tolist() == [0, 2 * (change == "type"), 0]
    assert found.columns.valid[1, 0] == (change not in ("unmeasured", "position"))


def test_velodyne_packets_in_another_order_and_with_a_gap() -> None:
    """Damage: `tests/sensors/test_damage.py`."""
    stream = stream_of(VelodyneSpec("VLP-16", "strongest"))
    gap = stream.packets.copy()
    first = int(gap[1, 2:4].view("<u2")[0])
    gap[1, 102:104] = np.array([(first + 3000) % 36000], "<u2").view(np.uint8)
    for packets in (stream.packets[[0, 2, 1]], gap):
        found = check_headers(stream.lidar(), packets, stream.host_ns[: len(packets)])
        assert not found.faults.any()


def test_packets_beyond_their_array_are_an_error() -> None:
    lidar, packets = ouster_packets(OUSTER[0])
    assert lidar.reader is not None
    for start in (-1, packets.size - lidar.packet_size + 1):
        with pytest.raises(IndexError):
            lidar.reader.read(packets.reshape(-1), np.array([start]), np.zeros(1, np.int64))


def test_of_no_packets_there_are_no_headers() -> None:
    lidar, packets = ouster_packets(OUSTER[0])
    found = lidar.column_headers(packets[:0], np.zeros(0, np.int64))
    assert found.stamp_ns.shape == (0, 16)


def test_a_table_has_all_members_of_its_struct_and_no_others() -> None:
    with pytest.raises(TypeError, match=r"EvenColumns: .*'checks'.*'no_member'"):
        EvenColumns(packet_bytes=8, columns=1, no_member=1)
