"""Names of the packets of all real recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch import sensors
from mlbatch.discovery.sampler import Sampler
from mlbatch.readers import open_recording
from mlbatch.types import StreamTable
from tests.builders.streams import named
from tests.recordings import RECORDINGS

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
    "velodyne/vlp16_azimuth-36000/vlp-16-test-90deg-1-50-frames.pcap": {
        1206: "Velodyne lidar VLP-16 (its product byte says HDL-32E), strongest return",
        **POSITION,
    },
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
    sampler = _sampled(RECORDINGS / name)
    found = {
        kind[1]: sensors.describe(kind[1], sampler.evidence(kind).sample) for kind in sampler.kinds
    }
    assert found == REAL[name]


def test_every_real_recording_is_tested() -> None:
    folders = {
        path.name for vendor in ("hesai", "velodyne") for path in (RECORDINGS / vendor).iterdir()
    }
    assert folders - {"calibration-without-recording"} == {
        name.split("/")[1] for name in REAL if not name.startswith("other")
    }


def test_real_packets_of_ouster_are_unknown_to_others() -> None:
    checked = 0
    for path in sorted((RECORDINGS / "ouster").rglob("*.pcap")):
        sampler = _sampled(path)
        for kind in sampler.kinds:
            sample = sampler.evidence(kind).sample
            assert named(sample) is None
            assert all(named(packet[None]) is None for packet in sample)
            checked += len(sample)
    assert checked > 100
