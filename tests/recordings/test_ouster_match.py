"""Real Ouster packets: IMU samples, which metadata fit, names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mlbatch.sensors import describe, read_calibration
from mlbatch.sensors.crc import crc64
from mlbatch.sensors.ouster.sensor import OusterCalibration
from mlbatch.types import Stream
from tests.builders.vendors import beside
from tests.recordings.ouster import CASES, ONLY_IMU, OUSTER, Case, evidence


def test_real_packets_equal_the_reference() -> None:
    case = ONLY_IMU
    reference = case.arrays()
    calibration = read_calibration(case.metadata_path)
    assert calibration is not None
    lidar = calibration.lidar({}, None)
    assert lidar.notes == ("lidar output is off according to the metadata",)
    assert not lidar.is_imu(680)
    assert lidar.is_imu(452)
    packets = [lidar.imu(payload[None], 0) for payload in case.payloads(452)]
    kept = (reference["imu_status"] & 1) != 0
    stamps = np.concatenate([samples.stamp_ns for samples in packets])
    acceleration = np.concatenate([samples.acceleration for samples in packets])
    angular_velocity = np.concatenate([samples.angular_velocity for samples in packets])
    assert kept.sum() == len(stamps) > 0
    assert np.array_equal(stamps, reference["imu_timestamp"][kept])
    assert np.array_equal(acceleration, reference["imu_acc"][kept].astype(np.float64))
    assert np.array_equal(angular_velocity, reference["imu_gyro"][kept].astype(np.float64))


@pytest.mark.parametrize("number", [0, 1, 2, 3, 5])
def test_real_legacy_packets_feel_gravity_at_the_time_of_the_lidar(number: int) -> None:
    case = CASES[number]
    calibration = read_calibration(case.metadata_path)
    assert calibration is not None
    lidar = calibration.lidar({}, None)
    assert lidar.is_imu(48)
    samples = [lidar.imu(payload[None], 0) for payload in case.payloads(48)]
    stamps = np.concatenate([sample.stamp_ns for sample in samples])
    packets = case.payloads(lidar.packet_size)
    stamp_ns = lidar.column_headers(packets, np.zeros(len(packets), np.int64)).stamp_ns
    first, last = np.sort(stamp_ns.ravel())[[0, -1]]
    assert len(stamps) >= 10
    assert (np.diff(stamps) > 0).all()
    # A revolution to either side, since one lidar measures half of each only.
    assert ((stamps > first - 100_000_000) & (stamps < last + 100_000_000)).all()
    for sample in samples:
        assert np.linalg.norm(sample.acceleration) == pytest.approx(9.8, abs=1.5)
        assert np.abs(sample.angular_velocity).max() < 2.0


SAME = OUSTER / "two-sensors_same-ports_nonlegacy"


SOURCES = {1: "169.254.92.158", 2: "169.254.238.111"}


def calibration_at(path: Path) -> OusterCalibration:
    found = read_calibration(path)
    assert isinstance(found, OusterCalibration)
    return found


def test_of_two_configurations_of_one_unit_the_one_whose_imu_was_seen_wins() -> None:
    found = evidence(SAME / "same_ports_nonlegacy.pcap", 16640, SOURCES[2])
    assert (7502, 48) in {(one.stream.port, one.size) for one in found.neighbours}
    shared = calibration_at(SAME / "same_ports_nonlegacy.2.json")
    apart = calibration_at(SAME / "same_ports_nonlegacy.2.non_colliding_imu.json")
    assert shared.match_score(found) > apart.match_score(found) > 0
    moved = found._replace(neighbours=(beside(Stream(SOURCES[2], 7503), bytes(48)),))
    assert apart.match_score(moved) > shared.match_score(moved) > 0


def test_no_metadata_take_packets_of_another_unit() -> None:
    calibrations = [calibration_at(case.metadata_path) for case in CASES]
    for case in CASES:
        own = calibration_at(case.metadata_path)
        size = own.metadata.layout.packet_size
        found = evidence(case.path, size, case.source)
        for other in calibrations:
            # Without serial numbers any unit with packets of this size may be the one.
            might = own.serial in ("", other.serial) or own.metadata.layout.legacy
            same = might and other.metadata.layout.packet_size == size
            assert (other.match_score(found) > 0) == same, (case, other.path)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_real_packets_are_named(case: Case) -> None:
    calibration = calibration_at(case.metadata_path)
    layout = calibration.metadata.layout
    packets = case.payloads(layout.packet_size)[:4]
    text = describe(layout.packet_size, packets)
    if layout.legacy:
        assert text == f"Ouster lidar, LEGACY, {layout.beams} beams"
    else:
        assert text == (
            f"Ouster lidar, serial {calibration.serial}, {layout.packet_size} bytes: "
            "needs its metadata"
        )
    longer = np.hstack([packets, packets[:, :1]])
    assert describe(layout.packet_size + 1, longer) == text


def test_real_imu_and_zone_packets_are_named() -> None:
    case = ONLY_IMU
    serial = "serial 122247000785"
    assert describe(452, case.payloads(452)) == f"Ouster IMU, {serial}, 452 bytes"
    assert describe(680, case.payloads(680)) == f"Ouster zone monitor, {serial}, 680 bytes"
    assert describe(48, CASES[0].payloads(48)[:4]) == "Ouster IMU"


@pytest.mark.parametrize(
    ("case", "size", "count"),
    [(CASES[0], 8448, 34), (CASES[-1], 16640, 1), (ONLY_IMU, 452, 8), (ONLY_IMU, 680, 1)],
    ids=str,
)
def test_checksums_of_recent_firmware(case: Case, size: int, count: int) -> None:
    packets = case.payloads(size)
    stated = np.ascontiguousarray(packets[:, -8:]).view("<u8")[:, 0]
    assert len(packets) == count
    assert (crc64(packets[:, :-8]) == stated).all()
