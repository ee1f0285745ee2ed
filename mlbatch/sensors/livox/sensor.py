"""Livox lidars of SDK2 (Mid-360, Mid-360s, HAP, Avia2): points with coordinates.

Source: docs/sources/others.md (Livox SDK2). There is no rotor and no calibration: every point has
coordinates, and its time follows from its number in the packet. So a point is a column of one
channel; its laser (point number modulo 4 or 6) is dropped, since the points of a column share one
timestamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array, median
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, Coordinates
from mlbatch.lidar.headers import HeaderReader
from mlbatch.lidar.interface import Calibration, Evidence, Lidar, Records, SensorModel
from mlbatch.sensors.livox.identify import describe, identify
from mlbatch.sensors.livox.packets import (
    HEADER_SIZE,
    IMU_SIZE,
    PointKind,
    coordinates,
    has_points,
    header_table,
    headers,
    read_imu,
    wrong_crc,
)
from mlbatch.sensors.options import check_options
from mlbatch.sensors.packet_bytes import most_common
from mlbatch.types import ImuSamples
from mlbatch.units import NS_PER_S

__all__ = ["BUILT_IN", "MODELS", "VENDOR", "LivoxCalibration", "LivoxLidar", "describe"]

VENDOR = "Livox"
SDK2 = "Livox SDK2"
MODELS: tuple[SensorModel, ...] = (
    SensorModel(
        name=SDK2,
        vendor=VENDOR,
        channels=1,
        returns=(1, 2),
        clock="power-on, gPTP, PTP, GPS or NTP; ns in every packet",
        calibration="none: Mid-360, Mid-360s, HAP and Avia2 send coordinates",
        verified="two sources",
    ),
)
_FITS_BYTES = 100
_CLOCKS = {0: "time since power-on", 1: "gPTP or PTP", 2: "GPS", 5: "NTP"}
# Default IMU port by point port: Mid-360 and HAP.
_IMU_PORTS = {56301: 56401, 57000: 58000}
_COUNTER_MODULUS = 1 << 16
# Tolerance between counter and time: a share of the packets since the first, plus so many.
_COUNTER_SHARE = 0.1
_COUNTER_SLACK = 2
_SHARED_STAMP = (
    "most packets repeat the timestamp of the one before, as within a frame of the Avia2; the "
    "times of their points are no more precise than that"
)


class LivoxCalibration(Calibration):
    """Livox needs no calibration."""

    model = SDK2
    is_shared = True

    def match_score(self, evidence: Evidence) -> int:
        """Match packets of points."""
        kind = identify(evidence.size, evidence.sample)
        return _FITS_BYTES if kind is not None and kind.returns else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> LivoxLidar:
        """Decoder of the sensor; its packets define the kind of points."""
        check_options(options)
        kind = None if evidence is None else identify(evidence.size, evidence.sample)
        if evidence is None or kind is None or not kind.returns:
            raise RigError(
                f"{SDK2}: expected packets of points in the first 10 seconds, which define the "
                "kind, found none; check the sensor's stream in the rig file, or leave it out"
            )
        return LivoxLidar(kind, evidence, check_crc="crc" in options)


BUILT_IN: tuple[Calibration, ...] = (LivoxCalibration(),)


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """None: there are no calibration files."""
    return None


class LivoxLidar(Lidar):
    """Decoder of one sensor."""

    def __init__(self, kind: PointKind, evidence: Evidence, *, check_crc: bool) -> None:
        packets = evidence.sample[has_points(evidence.sample, kind)]
        self.vendor = VENDOR
        self.model = SDK2
        self.mode = kind.what
        self.channels = 1
        self.returns = kind.returns
        self.packet_size = evidence.size
        self.columns_per_packet = (evidence.size - HEADER_SIZE) // kind.size
        self.records = Records(HEADER_SIZE, kind.size, kind.size)
        self.return_types = (0,) * kind.returns
        self.sends_twice = False
        self.channel = np.zeros(1, np.int64)
        self.firing_ns = np.zeros((1, 1), np.int64)
        self.beams = BeamTable(np.zeros((3, 1, 3)), np.zeros((3, 1, 3)), np.zeros(1))
        self.calibration = ""
        self.imu_port = _IMU_PORTS.get(evidence.stream.port, 0)
        self.timestamp_mode = _CLOCKS.get(most_common(headers(packets)["time_type"]), "")
        self.sequence_modulus = _COUNTER_MODULUS if _is_continuous(packets) else 0
        self.notes = (_SHARED_STAMP,) if _share_stamps(packets) else ()
        # No rotor, hence no dark sectors.
        self.lit_share = 1.0
        self.reader = HeaderReader(
            header_table(kind, evidence.size, self.columns_per_packet, bool(self.sequence_modulus)),
            has_number=bool(self.sequence_modulus),
            wrong_crc=wrong_crc if check_crc else None,
        )
        self._packets_per_s = 0.0 if self.notes else _packets_per_s(packets)
        self._kind = kind

    @property
    def columns_per_s(self) -> float:
        """Points sent per second, by the first packets."""
        return self.columns_per_packet * self._packets_per_s

    def is_imu(self, size: int) -> bool:
        """Whether a payload of this size is an IMU packet."""
        return size == IMU_SIZE

    def imu(self, payloads: U8Array, sensor: int) -> ImuSamples:
        """Samples of IMU packets (P, size)."""
        return read_imu(payloads, sensor)

    def sensor_from_imu(self) -> F64Array:
        """Identity: livox_ros_driver2 publishes points and IMU data in one frame."""
        return np.eye(4)

    def projection(self, body_from_sensor: F64Array) -> Coordinates:
        """Transform of the recorded coordinates."""
        return coordinates(self._kind, body_from_sensor)


def _is_continuous(packets: U8Array) -> bool:
    """Whether the packet counter counts all packets, not packets of each frame.

    A continuous counter grows in proportion to time, even if packets are lost. A counter that
    restarts with every frame would make later packets look like duplicates.
    """
    head = headers(packets)
    counter = head["counter"].astype(np.int64)
    stamp_ns = head["stamp_ns"].astype(np.int64)
    steps = np.diff(counter) % _COUNTER_MODULUS
    steps_ns = np.diff(stamp_ns)
    next_ns = steps_ns[(steps == 1) & (steps_ns > 0)]
    if not len(next_ns):
        return False
    expected = np.cumsum(steps_ns) / median(next_ns)
    away = np.abs(np.cumsum(steps) - expected)
    return bool((away <= _COUNTER_SHARE * np.abs(expected) + _COUNTER_SLACK).all())


def _packets_per_s(packets: U8Array) -> float:
    """Packets in a second by the timestamps of consecutive ones; 0: unknown."""
    head = headers(packets)
    steps_ns = np.diff(head["stamp_ns"].astype(np.int64))
    counter: I64Array = head["counter"].astype(np.int64)
    is_next = (counter[1:] - counter[:-1]) % _COUNTER_MODULUS == 1
    next_ns = steps_ns[is_next & (steps_ns > 0)]
    return NS_PER_S / median(next_ns) if len(next_ns) else 0.0


def _share_stamps(packets: U8Array) -> bool:
    """Whether most consecutive packets have equal timestamps."""
    head = headers(packets)
    is_next = np.diff(head["counter"].astype(np.int64)) == 1
    is_same = head["stamp_ns"][1:] == head["stamp_ns"][:-1]
    return 2 * int((is_next & is_same).sum()) > int(is_next.sum())
