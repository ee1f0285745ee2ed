"""All vendors together: models, calibration files, names of packets, whom packets may come from.

Packets and files of all kinds, damaged ones too: the targets of `tests/fuzz/packets.py`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch import sensors
from mlbatch.arrays import U8Array
from mlbatch.errors import RigError
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors.ouster.profiles import PROFILES, PacketLayout
from mlbatch.simulate.ouster.encode import OusterSpec, encode_frame, imu_packet, metadata_json
from mlbatch.types import Stream
from tests.builders.others import filled, livox2_packets, rows, velodyne_packets
from tests.builders.vendors import named, vendors, wrongly_excluded
from tests.fuzz.decoding import sampled
from tests.fuzz.framing import parts_of
from tests.fuzz.packets import CALIBRATION, seeds_of


def test_the_models_of_ouster() -> None:
    rows = {model.name: model for model in sensors.models() if model.vendor == "Ouster"}
    real = {name for name, model in rows.items() if model.verified == "real recording"}
    assert real == {"OS0-32", "OS0-128", "OS1-32", "OS1-64", "OS1-128", "OS2-32", "OS2-128"}
    assert rows["OS1-16"].channels == 16
    assert rows["OSDome-128"].returns == (1, 2)


def test_a_metadata_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "front.json"
    path.write_text(json.dumps(metadata_json(OusterSpec(serial=77))))
    found = sensors.read_calibration(path)
    assert found is not None
    assert (found.path, found.model, found.serial) == (path, "OS-1-128", "77")


def test_files_that_cannot_be_read_are_reported(tmp_path: Path) -> None:
    with pytest.raises(
        RigError, match=r"none\.json: expected a calibration file, found no such file"
    ):
        sensors.read_calibration(tmp_path / "none.json")
    with pytest.raises(RigError, match="expected a calibration file, found a folder"):
        sensors.read_calibration(tmp_path)


def test_a_file_too_large_for_a_calibration_is_none(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    content = json.dumps(metadata_json(OusterSpec())).encode()
    path.write_bytes(content + b" " * (sensors.MAX_CALIBRATION_BYTES - len(content)))
    assert sensors.read_calibration(path) is not None
    with path.open("ab") as file:
        file.write(b" ")
    assert sensors.read_calibration(path) is None


def test_a_damaged_packet_does_not_hide_a_stream() -> None:
    xt16 = filled(568, {0: bytes.fromhex("eeff06010000100801040201"), 550: b"\x37"})
    streams = [velodyne_packets(b"\x37\x22", "VLP-16"), rows([xt16] * 2), livox2_packets(1, 14, 96)]
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


@settings(max_examples=100)
@given(st.binary(min_size=1, max_size=1500), st.integers(1, 3))
def test_any_bytes_give_a_name_or_none(payload: bytes, count: int) -> None:
    assert "\n" not in (named(rows([payload] * count)) or "")


@pytest.mark.parametrize("fill", [0, 1, 2, 0x55, 0xEE, 0xFE, 0xFF, "counting"])
def test_bytes_that_are_all_the_same_or_count_are_unknown(fill: int | str) -> None:
    for size in (*range(1, 1500), 2304, 3328, 3392, 4352, 8448, 12608, 16640, 24896):
        payload = np.arange(size) % 256 if fill == "counting" else np.full(size, fill)
        packets = np.stack([payload.astype(np.uint8)] * 2)
        assert [one.describe(size, packets) for one in sensors.plugins()] == [None] * 6


def test_nothing_is_unknown() -> None:
    for plugin in sensors.plugins():
        assert plugin.describe(0, np.zeros((0, 0), np.uint8)) is None
        assert plugin.describe(1206, np.zeros((0, 1206), np.uint8)) is None
        assert plugin.describe(1206, np.zeros((1, 100), np.uint8)) is None


# -- folders of vendors, without the plug-ins ------------------------------------------------------

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


def test_every_vendor_has_both_conditions() -> None:
    assert {name for name, _, _ in vendors()} == {*VENDORS, "pointcloud"}
    for _, folder, _ in vendors():
        assert folder.may_send(0, np.zeros((0, 0), np.uint8)) is False
        assert folder.may_calibrate(b"") is False
