"""The folders of vendors: whom a packet may come from, without the plug-ins.

Packets and files of all kinds, damaged ones too: the targets of `tests/fuzz/packets.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch import sensors
from mlbatch.arrays import U8Array
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors.ouster.profiles import PROFILES, PacketLayout
from mlbatch.types import Stream
from tests.builders.others import livox1_packets, rows
from tests.builders.vendors import named, vendors, wrongly_excluded
from tests.fuzz.decoding import sampled
from tests.fuzz.framing import parts_of
from tests.fuzz.packets import CALIBRATION, seeds_of

VENDORS = ("hesai", "livox", "ouster", "robosense", "velodyne")


def _evidence(packets: U8Array, topic: str = "") -> Evidence:
    host_ns = np.arange(len(packets), dtype=np.int64)
    return Evidence(Stream(topic=topic), packets.shape[1], packets, host_ns)


def _sampled(data: bytes) -> Sequence[Evidence]:
    parts = [part for part in parts_of(data) if part.kind != CALIBRATION]
    sampler = sampled(parts)
    return [sampler.evidence(kind) for kind in sampler.kinds]


SIZES = [34, 42, 48, 49, 51, 80, 99, 512, 680, 1206, 1210, 1212, 1248, 1256, 1262, 1266, 1318, 3392]
HEADS = [
    b"",
    b"\xff\xee",
    b"\xee\xff",
    b"\xcd\xdc",
    b"\1",
    b"\2\0",
    b"\x55\xaa\5",
    b"\xa5\xff",
    b"MLPC",
]


@settings(max_examples=150)
@given(
    st.sampled_from(SIZES) | st.integers(1, 1500),
    st.sampled_from(HEADS),
    st.integers(0, 2**32),
    st.integers(1, 4),
    st.booleans(),
)
def test_no_bytes_are_excluded_wrongly(
    size: int, head: bytes, seed: int, count: int, is_flat: bool
) -> None:
    noise = np.random.default_rng(seed).integers(0, 256, (count, size), np.uint8)
    noise[:, : len(head)] = np.frombuffer(head, np.uint8)[:size]
    packets = noise[:1].repeat(count, axis=0) if is_flat else noise
    assert wrongly_excluded(_evidence(packets)) == []
    assert wrongly_excluded(_evidence(packets, "/points")) == []


@pytest.mark.parametrize("vendor", VENDORS)
def test_no_other_vendor_is_asked_before_the_right_one(vendor: str) -> None:
    """They are asked in this order until one knows the packets: the others are not loaded."""
    found = [
        sensors.senders(evidence.size, evidence.sample)
        for data in seeds_of(vendor)
        for evidence in _sampled(data)
    ]
    assert {names[0] for names in found} == {vendor}


def test_small_packets_of_other_programs_are_of_no_vendor() -> None:
    """Multicast DNS, NTP, ARP-like noise: no vendor is loaded for them."""
    for payload in (bytes(12), b"\x23" + bytes(46), b"M-SEARCH * HTTP/1.1", bytes(900)):
        assert sensors.senders(len(payload), rows([payload] * 3)) == []


@pytest.mark.parametrize("beams", [16, 32, 64, 128, 256])
def test_legacy_sizes_of_ouster(beams: int) -> None:
    size = PacketLayout(PROFILES["LEGACY"], beams, 16).packet_size
    for length in (size, size + 1):
        assert "ouster" in sensors.senders(length, np.zeros((1, length), np.uint8))
    assert sensors.senders(size - 1, np.zeros((1, size - 1), np.uint8)) == []


def test_a_single_payload_is_a_sample() -> None:
    packet = livox1_packets(1, 1362)[0]
    assert sensors.senders(len(packet), packet) == ["livox"]
    assert named(packet[None]) is None


def test_every_vendor_has_both_conditions() -> None:
    assert {name for name, _, _ in vendors()} == {*VENDORS, "pointcloud"}
    for _, folder, _ in vendors():
        assert folder.may_send(0, np.zeros((0, 0), np.uint8)) is False
        assert folder.may_calibrate(b"") is False
