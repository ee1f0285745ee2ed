"""Real Ouster recordings: calibration and formula of the vendor's decoder, checksums, counts."""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.sensors import read_calibration
from mlbatch.sensors.crc import crc64
from mlbatch.sensors.ouster.sensor import OusterCalibration
from tests.recordings.ouster import CASES, ONLY_IMU, OUSTER, Case


def calibration_of(case: Case) -> OusterCalibration:
    found = read_calibration(case.metadata_path)
    assert isinstance(found, OusterCalibration)
    return found


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


def test_foreign_json_of_the_recordings_is_no_calibration() -> None:
    paths = [*OUSTER.glob("*/*digest.json"), *OUSTER.glob("*/extrinsic_parameters.json")]
    assert len(paths) == 4
    assert [read_calibration(path) for path in paths] == [None] * 4
