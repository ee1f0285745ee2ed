"""Real Velodyne packets: the hour by NMEA, files of angles and the models that they fit."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mlbatch.arrays import I64Array, U8Array
from mlbatch.discovery.sampler import Sampler
from mlbatch.lidar.interface import Evidence
from mlbatch.readers import open_recording
from mlbatch.sensors.velodyne import sensor as velodyne
from mlbatch.sensors.velodyne.packets import VelodyneLidar
from mlbatch.types import StreamTable
from tests.recordings import RECORDINGS

FOLDER = RECORDINGS / "velodyne"
US_NS = 1_000
GPS, DUAL = "vlp16_gps/sample_velodyne_vlp16_gps.pcap", "vlp16_ros2_dual/1673400471837873222"
GAPS = "vlp32c_ros2/1713492677464078412"
OLD = "hdl32e_named-vlp32/velodyne_vlp32.pcap"


@dataclass(frozen=True)
class Recorded:
    """Content of a recording, as the readers and the sampler give it; read with the best table."""

    evidence: Evidence
    payloads: U8Array
    host_ns: I64Array
    lidar: VelodyneLidar


@functools.cache
def recorded(name: str) -> Recorded:
    table = StreamTable()
    sampler, payloads, host_ns = Sampler(table), list[U8Array](), list[int]()
    for batch in open_recording(FOLDER / name, table).packets():
        sampler.add(batch)
        rows = (batch.size == 1206).nonzero()[0]
        payloads += [batch.data[at : at + 1206].copy() for at in batch.start[rows].tolist()]
        host_ns += batch.host_ns[rows].tolist()
    (kind,) = (one for one in sampler.kinds if one[1] == 1206)
    evidence = sampler.evidence(kind)
    return Recorded(evidence, np.stack(payloads), np.array(host_ns), lidar_for(evidence))


def lidar_for(evidence: Evidence, options: dict[str, str] | None = None) -> VelodyneLidar:
    best = max(velodyne.BUILT_IN, key=lambda one: one.match_score(evidence))
    assert isinstance(best, velodyne.VelodyneCalibration)
    assert best.match_score(evidence) == 100
    return best.lidar(options or {}, evidence)


def reference(name: str) -> dict[str, npt.NDArray[Any]]:
    with np.load(FOLDER / name.split("/")[0] / "reference.npz") as archive:
        return {key: archive[key] for key in archive.files}


@pytest.mark.parametrize(("name", "pulse"), [(GPS, "PPS locked"), (OLD, "no PPS")])
@pytest.mark.parametrize("wrong_s", [-86_400 * 400, -7_200, 5_000, 86_400])
def test_nmea_gives_the_hour_if_receive_times_do_not(name: str, pulse: str, wrong_s: int) -> None:
    """Both recordings have valid sentences: wrong receive times have no effect."""
    one, result = recorded(name), reference(name)
    shift_ns = wrong_s * 1_000_000_000
    neighbours = tuple(
        other._replace(host_ns=other.host_ns + shift_ns) for other in one.evidence.neighbours
    )
    moved = one.evidence._replace(host_ns=one.evidence.host_ns + shift_ns, neighbours=neighbours)
    lidar = lidar_for(moved)
    assert lidar.timestamp_mode == pulse
    headers = lidar.column_headers(one.payloads, one.host_ns + shift_ns)
    assert (headers.stamp_ns == one.lidar.column_headers(one.payloads, one.host_ns).stamp_ns).all()
    assert abs(headers.stamp_ns[-1, 0] - float(result["device_time_s"]) * 1e9) < US_NS


def test_files_of_the_vendors_angles_change_nothing() -> None:
    """Nebula's files have the manual's angles and no heights: the built-in ones are kept."""
    for name, file in ((DUAL, "VLP16.yaml"), (GAPS, "VLP32.yaml")):
        path = FOLDER / name.split("/")[0] / file
        read = velodyne.read_calibration(path, path.read_bytes())
        one = recorded(name)
        assert read is not None
        assert read.match_score(one.evidence) == 200
        lidar, table = read.lidar({}, one.evidence), one.lidar
        assert lidar.model == table.model
        assert np.abs(lidar.beams.direction - table.beams.direction).max() < 1e-5
        assert np.array_equal(lidar.beams.origin, table.beams.origin)
        (note,) = lidar.notes
        assert note.startswith(f"{path}: the vertical offsets of all lasers are 0; those of a ")
        assert (lidar.channel == table.channel).all()
        assert lidar.calibration == str(path)
