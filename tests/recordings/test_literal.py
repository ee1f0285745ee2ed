"""Real recordings against the literal decoder."""

from __future__ import annotations

import pytest

from mlbatch.discovery.discover import SensorSelection
from mlbatch.pipeline.job import Job
from tests.builders.engines import check_conversion
from tests.recordings import RECORDINGS

REAL = (
    "velodyne/vlp16_gps/sample_velodyne_vlp16_gps.pcap",
    "velodyne/vlp16_ros2_dual/1673400471837873222",
    "velodyne/vlp32c_ros2/1713492677464078412",
    "ouster/os0-128_v2.3.0_rng15/OS-0-128-U1_v2.3.0_1024x10.pcap",
    "ouster/os0-32_v2.2.0_rng19-dual/OS-0-32-U1_v2.2.0_1024x10.pcap",
    "ouster/os1-32-g_v2.1.1_legacy/OS-1-32-G_v2.1.1_1024x10.pcap",
    "ouster/os0-128_windowed",
    "hesai/pandar40p",
    "hesai/pandar64",
    "hesai/pandarqt64",
    "hesai/pandarxt16",
    "hesai/pandarxt32",
)


@pytest.mark.parametrize("name", REAL)
def test_real_recordings(name: str) -> None:
    path = RECORDINGS / name
    if path.is_dir() and not (path / "metadata.yaml").exists():
        found = [*path.glob("*.pcap"), *(one.parent for one in path.glob("*/metadata.yaml"))]
        (path,) = found
    check_conversion(Job((path,), SensorSelection(identity_extrinsics=True), keep_partial=True))
