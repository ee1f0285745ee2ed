"""Names of packets: those of real recordings, and none for bytes that are no lidar's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mlbatch import sensors
from mlbatch.discovery.sampler import Sampler
from mlbatch.readers import open_recording
from mlbatch.sensors._ouster_profiles import PROFILES
from mlbatch.types import StreamTable
from tests.builders.others import (
    filled,
    livox2_packets,
    rows,
    velodyne_packets,
)
from tests.builders.ouster import OusterSpec, encode_frame, imu_packet
from tests.unit.sensors.naming import named

RECORDINGS = Path(__file__).resolve().parents[3] / ".." / "shared" / "recordings"
# By recordings/MANIFEST.md: path, {payload size: description}.
POSITION = {512: "Velodyne position packet"}
REAL: dict[str, dict[int, str]] = {
    "hesai/pandar40p/1673400149412331409": {
        1262: "HESAI lidar Pandar40P or Pandar40M, dual return, last and strongest"
    },
    "hesai/pandar64/1673403880599376836": {
        1198: "HESAI lidar Pandar64, dual return, last and strongest"
    },
    "hesai/pandar64_all-points/all_points": {
        1198: "HESAI lidar Pandar64, dual return, last and strongest"
    },
    "hesai/pandarqt64/1673401195788312575": {
        1072: "HESAI lidar PandarQT64, dual return, first and last"
    },
    "hesai/pandarxt16/1732848127890747768": {
        568: "HESAI lidar PandarXT-16, dual return, last and strongest"
    },
    "hesai/pandarxt32/1673400677802009732": {
        1080: "HESAI lidar PandarXT-32, dual return, last and strongest"
    },
    "velodyne/vlp16_ros2_dual/1673400471837873222": {1206: "Velodyne lidar VLP-16, dual return"},
    "velodyne/vlp32c_ros2/1713492677464078412": {1206: "Velodyne lidar VLP-32C, strongest return"},
    "velodyne/vlp16_gps/sample_velodyne_vlp16_gps.pcap": {
        1206: "Velodyne lidar VLP-16, strongest return",
        **POSITION,
    },
    "velodyne/vlp16_wrong-product-byte/velodyne_vlp16.pcap": {
        1206: "Velodyne lidar VLP-16 (its product byte says HDL-32E), strongest return",
        **POSITION,
    },
    "velodyne/hdl32e_named-vlp32/velodyne_vlp32.pcap": {
        1206: "Velodyne lidar HDL-32E, strongest return",
        **POSITION,
    },
    "other/lslidar-1212-byte-lookalike/VLI-16-one-packet.pcap": {
        1212: "LSLIDAR-like, 1212 bytes: not supported"
    },
}


def _sampled(path: Path) -> Sampler:
    table = StreamTable()
    sampler = Sampler(table)
    for batch in open_recording(path, table).packets():
        sampler.add(batch)
    return sampler


@pytest.mark.parametrize("name", REAL)
def test_real_recordings(name: str) -> None:
    if not (RECORDINGS / name).exists():
        pytest.skip("the recordings are not beside the repository")
    sampler = _sampled(RECORDINGS / name)
    found = {
        kind.size: sensors.describe(kind.size, sampler.evidence(kind).sample)
        for kind in sampler.kinds
    }
    assert found == REAL[name]


def test_every_real_recording_is_tested() -> None:
    if not RECORDINGS.is_dir():
        pytest.skip("the recordings are not beside the repository")
    folders = {
        path.name for maker in ("hesai", "velodyne") for path in (RECORDINGS / maker).iterdir()
    }
    assert folders - {"calibration-without-recording"} == {
        name.split("/")[1] for name in REAL if not name.startswith("other")
    }


def test_real_packets_of_ouster_are_not_theirs() -> None:
    if not RECORDINGS.is_dir():
        pytest.skip("the recordings are not beside the repository")
    checked = 0
    for path in sorted((RECORDINGS / "ouster").rglob("*.pcap")):
        sampler = _sampled(path)
        for kind in sampler.kinds:
            sample = sampler.evidence(kind).sample
            assert named(sample) is None
            assert all(named(packet[None]) is None for packet in sample)
            checked += len(sample)
    assert checked > 100


def test_a_damaged_packet_does_not_hide_a_stream() -> None:
    xt16 = filled(568, {0: bytes.fromhex("eeff06010000100801040201"), 550: b"\x37"})
    streams = [
        velodyne_packets(b"\x37\x22", 110.592),
        rows([xt16] * 2),
        livox2_packets(1, 14, 96),
    ]
    for packets in streams:
        whole = np.concatenate([packets, packets[-1:]])
        wanted = named(whole)
        assert wanted is not None
        whole[1] = np.random.default_rng(5).integers(0, 256, packets.shape[1], np.uint8)
        assert named(whole) == wanted


@pytest.mark.parametrize("profile", [name for name, one in PROFILES.items() if one.fields])
def test_packets_of_ouster_are_not_theirs(profile: str) -> None:
    for beams in (16, 32, 64, 128):
        spec = OusterSpec(profile=profile, beams=beams, columns_per_frame=512)
        ranges = np.full((512, beams, 1), 4000)
        packets = encode_frame(spec, 1_700_000_000_000_000_000, 5, ranges)[:4]
        sample = rows(packets)
        assert named(sample) is None
        assert all(named(packet[None]) is None for packet in sample)


def test_imu_packets_of_ouster_are_not_theirs() -> None:
    spec = OusterSpec(imu_profile="ACCEL32_GYRO32_NMEA")
    data = imu_packet(spec, np.arange(1, 9), np.ones((8, 3)), np.ones((8, 3)))
    assert named(rows([data])) is None


SIZES = [34, 42, 51, 80, 99, 512, 568, 678, 786, 812, 861, 918, 978, 1072, 1080, 1127, 1194, 1200]
SIZES += [1206, 1210, 1212, 1248, 1256, 1262, 1268, 1278, 1318, 1362, 1380, 1388]


@settings(max_examples=150)
@given(st.sampled_from(SIZES) | st.integers(1, 1500), st.integers(0, 2**32), st.integers(1, 4))
def test_random_bytes_are_nobodys(size: int, seed: int, count: int) -> None:
    noise = np.random.default_rng(seed).integers(0, 256, (count, size), np.uint8)
    assert named(noise) is None


@settings(max_examples=100)
@given(st.binary(min_size=1, max_size=1500), st.integers(1, 3))
def test_any_bytes_give_a_name_or_none(payload: bytes, count: int) -> None:
    assert "\n" not in (named(rows([payload] * count)) or "")


@pytest.mark.parametrize("fill", [0, 1, 2, 0x55, 0xEE, 0xFF])
def test_bytes_that_are_all_the_same_are_nobodys(fill: int) -> None:
    for size in range(1, 1500):
        assert named(np.full((2, size), fill, np.uint8)) is None


def test_nothing_is_nobodys() -> None:
    for plugin in sensors.plugins():
        assert plugin.describe(0, np.zeros((0, 0), np.uint8)) is None
        assert plugin.describe(1206, np.zeros((0, 1206), np.uint8)) is None
        assert plugin.describe(1206, np.zeros((1, 100), np.uint8)) is None
