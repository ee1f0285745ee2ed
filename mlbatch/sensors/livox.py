"""Livox lidars of SDK2 (Mid-360, Mid-360s, HAP, Avia2): points that know where they are.

Source: facts/others.md (Livox SDK2). There is no rotor and no calibration: every point carries its
coordinates, and its time follows from its place in the packet. So a point is a column of one
channel; which of its lasers made it (point number modulo 4 or 6) is not kept, since points of one
column would share a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array, median
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, Projection
from mlbatch.lidar.interface import Calibration, Evidence, Records, SensorModel
from mlbatch.sensors._livox_packets import (
    IMU_SIZE,
    faults,
    headers,
    read_imu,
    read_points,
    stamps_ns,
)
from mlbatch.sensors._options import check_options
from mlbatch.sensors._recognise_bytes import usual
from mlbatch.sensors._recognise_livox import HEADER_SIZE, PointKind, identify, livox
from mlbatch.sensors._turning_lidar import TurningLidar, content_keys
from mlbatch.types import Heads, ImuSamples, Pixels

__all__ = ["BUILT_IN", "MAKER", "MODELS", "LivoxCalibration", "LivoxLidar", "describe"]

MAKER = "Livox"
SDK2 = "Livox SDK2"
MODELS: tuple[SensorModel, ...] = (
    SensorModel(
        name=SDK2,
        maker=MAKER,
        channels=1,
        returns=(1, 2),
        clock="power-on, gPTP, PTP, GPS or NTP; ns in every packet",
        calibration="none: Mid-360, Mid-360s, HAP and Avia2 send coordinates",
        verified="two sources",
    ),
)
_FITS_BYTES = 100
_CLOCKS = {0: "time since power-on", 1: "gPTP or PTP", 2: "GPS", 5: "NTP"}
# Where points go, and IMU samples with them: Mid-360 and HAP, unless set otherwise.
_IMU_PORTS = {56301: 56401, 57000: 58000}
_COUNTER_MODULUS = 1 << 16
# How far counter and time may differ: a share of the packets since the first, and so many.
_COUNTER_SHARE, _COUNTER_SLACK = 0.1, 2
_SHARED_STAMP = (
    "many of its packets share one time, as those of a frame of the Avia2 do: the times of their "
    "points are no finer than that"
)


class LivoxCalibration:
    """What there is to know beforehand: nothing; `Calibration` of lidar.py."""

    __slots__ = ()

    path: Path | None = None
    model = SDK2
    serial = ""
    is_shared = True

    def fit(self, evidence: Evidence) -> int:
        """Whether these are packets of points."""
        kind = identify(evidence.size, evidence.sample)
        return _FITS_BYTES if kind is not None and kind.returns else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> LivoxLidar:
        """The sensor."""
        check_options(options)
        kind = None if evidence is None else identify(evidence.size, evidence.sample)
        if evidence is None or kind is None or not kind.returns:
            raise RigError(
                f"{SDK2}: wanted packets of points in the first 10 seconds, to tell their kind, "
                "got none; check the sensor's stream in the rig file, or leave it out"
            )
        return LivoxLidar(kind, evidence, check_crc="crc" in options)


BUILT_IN: tuple[Calibration, ...] = (LivoxCalibration(),)


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """There are no such files."""
    return None


def describe(size: int, sample: U8Array) -> str | None:
    """What payloads (k, size) are; SDK1 (Mid-40, Horizon, Avia, ...) is only known by name."""
    packets = np.atleast_2d(sample)
    if not packets.size or packets.shape[1] < size:
        return None
    return livox(size, packets[:, :size])


class LivoxLidar(TurningLidar):
    """One sensor; `Lidar` of lidar.py.

    Beyond the protocol: `last_xyz_m`, the coordinates (n, 3) of the points that were read last.
    """

    def __init__(self, kind: PointKind, evidence: Evidence, *, check_crc: bool) -> None:
        packets = evidence.sample[faults(evidence.sample, kind, check_crc=False) == 0]
        self.maker = MAKER
        self.model = SDK2
        self.mode = kind.what
        self.channels = 1
        self.returns = kind.returns
        self.packet_size = evidence.size
        self.columns_per_packet = (evidence.size - HEADER_SIZE) // kind.size
        self.records = Records(HEADER_SIZE, kind.size, kind.size)
        self.pixel_layout = (MAKER, kind.data_type)
        self.return_types = (0,) * kind.returns
        self.sends_twice = False
        self.channel = np.zeros(1, np.int64)
        self.firing_ns = np.zeros((1, 1), np.int64)
        self.beams = BeamTable(np.zeros((3, 1, 3)), np.zeros((3, 1, 3)), np.zeros(1))
        self.calibration = ""
        self.imu_port = _IMU_PORTS.get(evidence.stream.port, 0)
        self.timestamp_mode = _CLOCKS.get(usual(headers(packets)["time_type"]), "")
        self.sequence_modulus = _COUNTER_MODULUS if _counts_on(packets) else 0
        self.notes = (_SHARED_STAMP,) if _share_stamps(packets) else ()
        self.last_xyz_m: F64Array = np.empty((0, 3))
        self._kind = kind
        self._check_crc = check_crc

    def faults(self, packets: U8Array) -> U8Array:
        """Index into FAULTS for each packet."""
        return faults(packets, self._kind, check_crc=self._check_crc)

    def sequence(self, packets: U8Array) -> I64Array:
        """The packet counter, where it is one."""
        if self.sequence_modulus:
            return headers(packets)["counter"].astype(np.int64)
        return content_keys(packets)

    def heads(self, packets: U8Array, host_ns: I64Array) -> Heads:
        """Stamps of all points."""
        stamp_ns = stamps_ns(packets, self.columns_per_packet)
        return Heads(stamp_ns, np.zeros_like(stamp_ns), np.ones(stamp_ns.shape, np.bool_))

    def read(self, records: U8Array, which: int, out: Pixels) -> None:
        """Decode return `which` of n points, and keep their coordinates for the projection."""
        self.last_xyz_m, out.range_m[:, 0], out.intensity[:, 0] = read_points(
            records, which, self._kind
        )

    def is_imu(self, size: int) -> bool:
        """Whether a payload of this size is an IMU packet."""
        return size == IMU_SIZE

    def imu(self, payloads: U8Array, sensor: int) -> ImuSamples:
        """Samples of IMU packets (P, size)."""
        return read_imu(payloads, sensor)

    def projection(self, body_from_sensor: F64Array, columns: int) -> Projection:
        """Moves the points that were read last into the body frame."""
        return Carried(self, body_from_sensor)


class Carried:
    """Points whose coordinates come with their ranges; `Projection` of geometry.py."""

    def __init__(self, lidar: LivoxLidar, body_from_sensor: F64Array) -> None:
        self._lidar = lidar
        self._body_from_sensor = body_from_sensor

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Nothing turns."""

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """The points that the lidar has just read, summed in a fixed order (see geometry.py)."""
        x, y, z = self._lidar.last_xyz_m.T
        for axis, (by_x, by_y, by_z, shift) in enumerate(self._body_from_sensor[:3]):
            out[:, 0, axis] = x * by_x + y * by_y + z * by_z + shift


def _counts_on(packets: U8Array) -> bool:
    """Whether the packet counter counts all packets, or starts over with every frame.

    One that goes on grows like the time does, lost packets or not; a frame's numbers come back
    soon, and would be taken for packets that came twice.
    """
    head = headers(packets)
    counter, stamp_ns = head["counter"].astype(np.int64), head["stamp_ns"].astype(np.int64)
    steps, steps_ns = np.diff(counter) % _COUNTER_MODULUS, np.diff(stamp_ns)
    next_ns = steps_ns[(steps == 1) & (steps_ns > 0)]
    if not len(next_ns):
        return False
    wanted = np.cumsum(steps_ns) / median(next_ns)
    away = np.abs(np.cumsum(steps) - wanted)
    return bool((away <= _COUNTER_SHARE * np.abs(wanted) + _COUNTER_SLACK).all())


def _share_stamps(packets: U8Array) -> bool:
    """Whether most packets that follow each other have one time."""
    head = headers(packets)
    is_next = np.diff(head["counter"].astype(np.int64)) == 1
    is_same = head["stamp_ns"][1:] == head["stamp_ns"][:-1]
    return 2 * int((is_next & is_same).sum()) > int(is_next.sum())
