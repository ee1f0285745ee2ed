"""Real Ouster recordings: calibration and formula of the vendor's decoder, checksums, counts."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest

from mlbatch.arrays import F64Array, U8Array
from mlbatch.sensors import read_calibration
from mlbatch.sensors.crc import crc64
from mlbatch.sensors.ouster.sensor import OusterCalibration, OusterLidar
from tests.recordings.ouster import CASES, ONLY_IMU, OUSTER, Case, Reference

MAX_TABLE_ERROR_M = 1e-9


def calibration_of(case: Case) -> OusterCalibration:
    found = read_calibration(case.metadata_path)
    assert isinstance(found, OusterCalibration)
    return found


@lru_cache(maxsize=1)
def loaded(case: Case) -> tuple[OusterCalibration, OusterLidar, U8Array, Reference]:
    calibration = calibration_of(case)
    lidar = calibration.lidar({"crc": "check"}, None)
    return calibration, lidar, case.payloads(lidar.packet_size), case.arrays()


@pytest.mark.parametrize("case", CASES, ids=str)
class TestEveryRecording:
    def test_the_table_equals_the_formula(self, case: Case) -> None:
        _, lidar, _, reference = loaded(case)
        range_m = np.full((len(angles_rad(lidar)), lidar.channels), 17.25)
        expected = formula_m(reference, range_m)
        assert np.abs(projected(lidar, range_m) - expected).max() < MAX_TABLE_ERROR_M

    def test_calibration_as_the_reference_fills_it_in(self, case: Case) -> None:
        calibration, lidar, _, reference = loaded(case)
        described = calibration.metadata
        degrees = np.degrees
        for ours, theirs in (
            (degrees(described.altitude_rad), reference["beam_altitude_angles_deg"]),
            (degrees(described.azimuth_rad), reference["beam_azimuth_angles_deg"]),
            (described.beam_offset_m[0] * 1e3, reference["lidar_origin_to_beam_origin_mm"]),
            (in_mm(described.lidar_to_sensor), reference["lidar_to_sensor_transform"]),
            (in_mm(lidar.sensor_from_imu()), reference["imu_to_sensor_transform"]),
        ):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)

    def test_no_packet_is_faulty_or_foreign(self, case: Case) -> None:
        _, lidar, packets, _ = loaded(case)
        assert not lidar.faults(packets).any()
        assert lidar.sent_by_me(packets).all()


def in_mm(pose: F64Array) -> F64Array:
    scaled: F64Array = pose.copy()
    scaled[:3, 3] *= 1000
    return scaled


def angles_rad(lidar: OusterLidar) -> F64Array:
    """Angle of every measurement id."""
    assert lidar.beams.angle_rad is not None
    return lidar.beams.angle_rad


def projected(lidar: OusterLidar, range_m: F64Array) -> F64Array:
    """Ranges (W, H) through the beam table in float64: (W, H, 3)."""
    table = lidar.beams
    angle_rad = angles_rad(lidar)[:, None, None]
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    direction = cosine * table.direction[0] + sine * table.direction[1] + table.direction[2]
    origin = cosine * table.origin[0] + sine * table.origin[1] + table.origin[2]
    xyz: F64Array = (range_m + table.reach_m)[:, :, None] * direction + origin
    return xyz


def formula_m(reference: Reference, range_m: F64Array) -> F64Array:
    """Section 6 of the fact sheet as it is printed, column by column, in mm."""
    columns, beams = range_m.shape
    n = float(reference["lidar_origin_to_beam_origin_mm"])
    transform = reference["lidar_to_sensor_transform"]
    a = np.array([-math.radians(v) for v in reference["beam_azimuth_angles_deg"]])
    p = np.array([math.radians(v) for v in reference["beam_altitude_angles_deg"]])
    xyz = np.empty((columns, beams, 3))
    for mid in range(columns):
        theta = 2 * math.pi * (1 - mid / columns)
        r = range_m[mid] * 1000
        x = (r - n) * np.cos(theta + a) * np.cos(p) + n * math.cos(theta)
        y = (r - n) * np.sin(theta + a) * np.cos(p) + n * math.sin(theta)
        z = (r - n) * np.sin(p)
        xyz[mid] = (np.stack([x, y, z], 1) @ transform[:3, :3].T + transform[:3, 3]) / 1000
    return xyz


@pytest.mark.parametrize(("folder", "count"), [(CASES[0].folder, 34), (CASES[-1].folder, 1)])
def test_checksums_of_recent_firmware(folder: str, count: int) -> None:
    case = next(case for case in reversed(CASES) if case.folder == folder)
    packets = case.payloads(calibration_of(case).metadata.layout.packet_size)
    result = np.ascontiguousarray(packets[:, -8:]).view("<u8")[:, 0]
    assert len(packets) == count
    assert (crc64(packets[:, :-8]) == result).all()


def test_checksum_of_an_imu_and_a_zone_packet() -> None:
    case = ONLY_IMU
    for size, count in ((452, 8), (680, 1)):
        packets = case.payloads(size)
        result = np.ascontiguousarray(packets[:, -8:]).view("<u8")[:, 0]
        assert len(packets) == count
        assert (crc64(packets[:, :-8]) == result).all()


def test_a_changed_packet_is_found_by_its_checksum_only_if_asked() -> None:
    calibration = calibration_of(CASES[0])
    packets = CASES[0].payloads(calibration.metadata.layout.packet_size)
    packets[3, 777] ^= 4
    assert (
        calibration.lidar({"crc": "check"}, None).faults(packets).tolist()
        == [0] * 3 + [3] + [0] * 30
    )
    assert not calibration.lidar({}, None).faults(packets).any()


def test_foreign_json_of_the_recordings_is_no_calibration() -> None:
    paths = [*OUSTER.glob("*/*digest.json"), *OUSTER.glob("*/extrinsic_parameters.json")]
    assert len(paths) == 4
    assert [read_calibration(path) for path in paths] == [None] * 4
