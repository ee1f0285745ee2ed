"""Which metadata belong to which packets; and what unknown packets are called."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors import describe
from mlbatch.sensors.ouster.sensor import read_calibration as read_content
from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets, imu_packet, metadata_json
from mlbatch.types import Stream
from tests.builders.others import rows
from tests.builders.spinning import ouster_calibration
from tests.builders.vendors import beside


def packets_of(spec: OusterSpec, columns: int = 32) -> U8Array:
    mids = np.arange(columns)
    packets = encode_packets(spec, 10**9 + mids, mids, np.full(columns, 7), {})
    return rows(packets)


def seen(packets: U8Array, port: int = 7502, *sizes: tuple[int, int]) -> Evidence:
    size = packets.shape[1]
    others = tuple(beside(Stream("192.0.2.7", at), bytes(length)) for at, length in sizes)
    host_ns = np.zeros(len(packets), np.int64)
    return Evidence(Stream("192.0.2.7", port), size, packets, host_ns, others)


def test_serial_numbers_decide_then_configuration_then_ports() -> None:
    spec = OusterSpec(beams=16, serial=111, init_id=5)
    packets = seen(packets_of(spec), 7502, (7503, 48))
    order = [
        spec,
        replace(spec, imu_port=7999),
        replace(spec, lidar_port=7999),
        replace(spec, init_id=6),
        replace(spec, init_id=6, lidar_port=7999, imu_port=7999),
        replace(spec, serial=0),
        replace(spec, serial=0, init_id=6, lidar_port=7999, imu_port=7999),
    ]
    fits = [ouster_calibration(candidate).match_score(packets) for candidate in order]
    assert fits == sorted(set(fits), reverse=True)
    assert fits[-1] > 0
    assert ouster_calibration(replace(spec, serial=112)).match_score(packets) == 0


def test_packets_without_serial_number_fit_any_unit() -> None:
    spec = OusterSpec(beams=16, serial=0, init_id=0)
    assert ouster_calibration(replace(spec, serial=111)).match_score(seen(packets_of(spec))) > 0


def test_size_and_size_plus_one_fit() -> None:
    spec = OusterSpec(beams=16)
    packets = packets_of(spec)
    longer = np.hstack([packets, np.zeros((2, 1), np.uint8)])
    calibration = ouster_calibration(spec)
    assert calibration.match_score(seen(packets)) == calibration.match_score(seen(longer)) > 0
    assert calibration.match_score(seen(np.hstack([longer, longer[:, :1]]))) == 0
    assert calibration.match_score(seen(packets[:, :-1])) == 0
    assert calibration.match_score(seen(packets[:0])) == 0


@pytest.mark.parametrize("profile", ["LEGACY", "RNG15_RFL8_NIR8"])
def test_other_bytes_of_the_right_size_do_not_fit(profile: str) -> None:
    spec = OusterSpec(profile=profile, beams=16)
    shape = packets_of(spec).shape
    noise = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    assert ouster_calibration(spec).match_score(seen(noise)) == 0


def test_metadata_of_a_lidar_that_is_off_fit_nothing() -> None:
    document = metadata_json(OusterSpec(beams=16))
    document["lidar_data_format"]["udp_profile_lidar"] = "OFF"
    found = read_content(Path("a.json"), json.dumps(document).encode())
    assert found is not None
    assert found.match_score(seen(np.ones((2, 256), np.uint8))) == 0


def test_encoded_imu_packets_are_named() -> None:
    spec = OusterSpec(beams=16, imu_profile="ACCEL32_GYRO32_NMEA", serial=5)
    data = imu_packet(spec, np.arange(1, 5), np.ones((4, 3)), np.ones((4, 3)))
    sample = np.frombuffer(data, np.uint8)
    assert describe(len(data), sample) == f"Ouster IMU, serial 5, {len(data)} bytes"


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        (OusterSpec(profile="LEGACY", beams=64), "Ouster lidar, LEGACY, 64 beams"),
        (OusterSpec(beams=16, serial=7), "Ouster lidar, serial 7, 1280 bytes: needs its metadata"),
        (OusterSpec(beams=16, serial=0), "Ouster lidar, 1280 bytes: needs its metadata"),
    ],
)
def test_encoded_lidar_packets_are_named(spec: OusterSpec, text: str) -> None:
    packets = packets_of(spec)
    assert describe(packets.shape[1], packets) == text
    longer = np.hstack([packets, packets[:, :1]])
    assert describe(longer.shape[1], longer) == text


def test_other_ouster_packets_are_named() -> None:
    zones = np.zeros((2, 680), np.uint8)
    zones[:, 0] = 3
    assert describe(680, zones) == "Ouster zone monitor, 680 bytes"
    sample = struct.pack("<QQQffffff", 1, 2, 3, 0, 0, 1, 0, 0, 0)
    assert describe(48, np.frombuffer(sample, np.uint8)) == "Ouster IMU"
