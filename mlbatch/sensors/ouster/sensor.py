"""Ouster lidars: OS0, OS1, OS2, OSDome, all firmware since 1.12, described by their metadata JSON.

Source: docs/sources/ouster.md (ouster-sdk 1.0.1; Firmware User Manual, "Lidar Data"). A packet has
C columns with one timestamp each; the pixels of a column fire together, without firing offsets.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, I64Array, U8Array, rows_of
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable
from mlbatch.lidar.headers import HeaderReader
from mlbatch.lidar.interface import Calibration, Evidence, Lidar, Recorded, Records, SensorModel
from mlbatch.sensors.options import check_options
from mlbatch.sensors.ouster.identify import describe
from mlbatch.sensors.ouster.imu import (
    ACCEL32,
    LEGACY_SIZE,
    imu_size,
    read_accel32,
    read_legacy,
    sample_count,
)
from mlbatch.sensors.ouster.metadata import REMEDY, Metadata, parse_metadata, read_document
from mlbatch.sensors.ouster.mode import Seen, as_sent, seen_in
from mlbatch.sensors.ouster.packets import Headers, pixel_table, wrong_crc
from mlbatch.sensors.ouster.profiles import FUSA, LEGACY, STANDARD
from mlbatch.types import ImuSamples
from mlbatch.units import NS_PER_S

__all__ = [
    "BUILT_IN",
    "MODELS",
    "VENDOR",
    "OusterCalibration",
    "OusterLidar",
    "describe",
    "read_calibration",
]

VENDOR = "Ouster"
# Default ports: docs/sources/messages.md, section 7; topics and messages: section 1.
RECORDED = Recorded(
    port=7502,
    topic="lidar_packets",
    message="ouster_sensor_msgs/PacketMsg",
    message_ros1="ouster_ros/PacketMsg",
    imu_port=7503,
    imu_topic="imu_packets",
    device_port=7502,
)
_REAL = frozenset({"OS0-32", "OS0-128", "OS1-32", "OS1-64", "OS1-128", "OS2-32", "OS2-128"})
_BEAMS = {
    "OS0": (32, 64, 128),
    "OS1": (16, 32, 64, 128),
    "OS2": (32, 64, 128),
    "OSDome": (32, 64, 128),
}
MODELS: tuple[SensorModel, ...] = tuple(
    SensorModel(
        name=f"{line}-{beams}",
        vendor=VENDOR,
        channels=beams,
        returns=(1, 2),
        clock="internal oscillator, sync pulse or PTP; ns in every column",
        calibration="metadata JSON of the sensor, required",
        verified="real recording" if f"{line}-{beams}" in _REAL else "one source",
    )
    for line, counts in _BEAMS.items()
    for beams in counts
)

BUILT_IN: tuple[Calibration, ...] = ()

# Match scores: the serial number decides, then mode and configuration, then the ports.
_FITS_SERIAL = 1000
_FITS_MODE = 200
_FITS_INIT_ID = 100
_FITS_LIDAR_PORT = 10
_FITS_IMU_PORT = 2
_FITS_SIZE = 1
_UNPROVEN = (
    "metadata not confirmed: packets and metadata have no serial number in common, only packet "
    "size and mode were compared"
)
# Measurement ids of any mode.
_ANY_IDS = 1 << 16
_FRAME_IDS = {FUSA: 1 << 32}
_DEFAULT_FRAME_IDS = 1 << 16


def read_calibration(path: Path, content: bytes) -> OusterCalibration | None:
    """Parse a metadata file; None if it is something else."""
    document = read_document(path, content)
    return None if document is None else OusterCalibration(parse_metadata(document))


class OusterCalibration(Calibration):
    """A metadata file."""

    def __init__(self, described: Metadata) -> None:
        self.metadata = described
        self.path = described.path
        self.model = described.product or f"Ouster {described.layout.beams}-beam"
        self.serial = str(described.serial) if described.serial else ""
        # Metadata of another mode are refused by an error that says so.
        self._headers = _headers(described._replace(columns_per_frame=_ANY_IDS))
        table = self._headers.table(_DEFAULT_FRAME_IDS, np.zeros(0, np.int64), 0)
        self._reader = HeaderReader(table, has_number=True)

    def match_score(self, evidence: Evidence) -> int:
        """Match score of packets; old ROS drivers append one byte to payloads."""
        size = self.metadata.layout.packet_size
        is_off = self.metadata.layout.profile.returns == 0
        if is_off or evidence.size not in (size, size + 1) or not len(evidence.sample):
            return 0
        good = self._good(evidence)
        if 2 * len(good) <= len(evidence.sample):
            return 0
        try:
            as_sent(self.metadata, self._seen(good))
            mode = _FITS_MODE
        except RigError:
            mode = 0
        return _FITS_SIZE + mode + self._ids_fit(good) + self._ports_fit(evidence)

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> OusterLidar:
        """Decoder of the sensor; RigError if its profile has no pixels, or for another mode."""
        check_options(options)
        if self.metadata.layout.profile.returns == 0:
            raise RigError(
                f"{self.path}: Ouster metadata, udp_profile_lidar: expected a profile with pixels, "
                f"found {self.metadata.layout.profile.name}; leave the sensor out of the rig"
            )
        described = self.metadata
        good = None if evidence is None else self._good(evidence)
        if good is not None and len(good):
            described = as_sent(described, self._seen(good))
            described = described._replace(notes=(*described.notes, *self._other_init_id(good)))
        return OusterLidar(described, self.model, self.serial, "crc" in options)

    def _seen(self, packets: U8Array) -> Seen:
        """Mode of the unit by its intact packets."""
        columns = self._reader.read_rows(packets).columns
        return seen_in(self.metadata, self._headers, packets, columns)

    def _good(self, evidence: Evidence) -> U8Array:
        """Intact packets of the unit."""
        packets = evidence.sample[:, : self.metadata.layout.packet_size]
        headers = self._reader.read_rows(packets)
        return rows_of(packets, (headers.faults == 0) & headers.is_mine)

    def _other_init_id(self, packets: U8Array) -> Iterator[str]:
        """A note if packets carry another initialization id than the metadata."""
        expected = self.metadata.init_id
        seen = set(self._headers.read(packets, "init_id").tolist()) - {0}
        if expected and seen and expected not in seen:
            yield (
                f"{self.path}: Ouster metadata: expected packets of initialization_id {expected}, "
                f"found {min(seen)}: the sensor was started or set again after the metadata were "
                f"saved; {REMEDY}, or check that no setting changed"
            )

    def _ids_fit(self, packets: U8Array) -> int:
        serial = self.metadata.serial
        init_id = self.metadata.init_id
        same_unit = serial != 0 and bool((self._headers.read(packets, "serial") == serial).any())
        same_init = init_id != 0 and bool((self._headers.read(packets, "init_id") == init_id).any())
        return _FITS_SERIAL * same_unit + _FITS_INIT_ID * same_init

    def _ports_fit(self, evidence: Evidence) -> int:
        on_port = evidence.stream.port != 0 and evidence.stream.port == self.metadata.lidar_port
        imu_seen = any(
            port == self.metadata.imu_port and _is_imu(self.metadata, size)
            for port, size in ((one.stream.port, one.size) for one in evidence.neighbours)
        )
        return _FITS_LIDAR_PORT * on_port + _FITS_IMU_PORT * imu_seen


class OusterLidar(Lidar):
    """Decoder of one sensor.

    Beyond the protocol: `lidar_port`, `init_id`. The sequence counts the packets within the column
    window of the metadata, modulo frames x packets per frame; it is negative for packets outside
    the window.
    """

    def __init__(self, described: Metadata, model: str, serial: str, check_crc: bool) -> None:
        layout = described.layout
        self.vendor = VENDOR
        self.model = model
        self.serial = serial
        # LEGACY packets have no header, hence no serial number.
        self.carries_serial = layout.profile.name != LEGACY and bool(serial)
        self.mode = f"{described.lidar_mode or described.columns_per_frame} {layout.profile.name}"
        self.channels = layout.beams
        self.returns = layout.profile.returns
        self.has_reflectivity = True
        self.packet_size = layout.packet_size
        self.columns_per_packet = layout.columns
        self.column_period_ns = _column_period_ns(described)
        self.lit_share: float | None = _lit_share(described)
        self.records = Records(layout.record_start, layout.record_size, layout.record_size)
        # The type of dual returns follows from their order, see `typed_by`.
        self.return_types: tuple[int, ...] = (1,) if self.returns == 1 else (0, 0)
        self.typed_by = "order" if self.returns == 2 and described.strongest_first else ""
        self.sends_twice = False
        self.channel = np.arange(self.channels)
        # The pixels of a column fire together.
        self.firing_ns = np.zeros((1, self.channels), np.int64)
        self.beams = beam_table(described)
        self.extrinsics = described.extrinsics
        self.sensor_from_lidar: F64Array | None = described.lidar_to_sensor
        self.timestamp_mode = described.timestamp_mode
        self.clock_period_ns = 0
        self.calibration = str(described.path)
        self.notes = described.notes
        self.unproven = "" if self.carries_serial else _UNPROVEN
        self.lidar_port = described.lidar_port
        self.imu_port = described.imu_port
        self.init_id = described.init_id
        self._metadata = described
        self.pixels = pixel_table(layout)
        rank, in_window = _packet_ranks(described)
        frame_ids = _FRAME_IDS.get(described.header, _DEFAULT_FRAME_IDS)
        self.sequence_modulus = frame_ids * in_window
        # Only packets with STANDARD headers have a checksum.
        checks = check_crc and not layout.legacy and described.header == STANDARD
        headers = _headers(described)
        self.reader = HeaderReader(
            headers.table(frame_ids, rank, in_window),
            has_number=True,
            wrong_crc=wrong_crc if checks else None,
        )

    def is_imu(self, size: int) -> bool:
        """Whether a payload of this size is an IMU packet; old ROS drivers append one byte."""
        return size != self.packet_size and _is_imu(self._metadata, size)

    def imu(self, payloads: U8Array, sensor: int) -> ImuSamples:
        """Samples of IMU packets (P, size)."""
        read = read_accel32 if self._metadata.imu_profile == ACCEL32 else read_legacy
        return read(payloads, sensor)

    def sensor_from_imu(self) -> F64Array:
        """Pose of the IMU in the sensor frame, metres."""
        pose: F64Array = self._metadata.imu_to_sensor.copy()
        return pose


def beam_table(described: Metadata) -> BeamTable:
    """Beam vectors in the sensor frame, metres (section 6).

    The angle of a column decreases with its measurement id: the sensor rotates clockwise.
    """
    azimuth = -described.azimuth_rad
    altitude = described.altitude_rad
    forward = np.cos(azimuth) * np.cos(altitude)
    side = np.sin(azimuth) * np.cos(altitude)
    zero = np.zeros_like(forward)
    direction = np.stack(
        [
            np.stack([forward, side, zero], axis=1),
            np.stack([-side, forward, zero], axis=1),
            np.stack([zero, zero, np.sin(altitude)], axis=1),
        ]
    )
    offset_x, offset_z = described.beam_offset_m
    origin = np.array([[[offset_x, 0.0, 0.0]], [[0.0, offset_x, 0.0]], [[0.0, 0.0, offset_z]]])
    # Ranges are measured from the front of the rotor, at this distance from its axis.
    reach_m = -(math.hypot(offset_x, offset_z) if offset_z else offset_x)
    column = np.arange(described.columns_per_frame)
    angle_rad = 2 * math.pi * (1 - column / described.columns_per_frame)
    return BeamTable(direction, origin, np.array([reach_m]), angle_rad).moved(
        described.lidar_to_sensor
    )


def _headers(described: Metadata) -> Headers:
    return Headers(
        described.layout, described.columns_per_frame, described.header, described.serial
    )


def _column_period_ns(described: Metadata) -> float:
    """Column period by the mode; 0 if the metadata have no mode."""
    columns_per_s = described.columns_per_frame * described.revolutions_per_s
    return NS_PER_S / columns_per_s if columns_per_s else 0.0


def _lit_share(described: Metadata) -> float:
    """Share of the columns of a revolution that the azimuth window contains."""
    first, last = described.column_window
    columns = described.columns_per_frame
    return ((last - first) % columns + 1) / columns


def _packet_ranks(described: Metadata) -> tuple[I64Array, int]:
    """Rank of every packet of a full frame among those sent (-1: not sent), and their number.

    If the window spans encoder zero, a frame begins at column 0 with the second part of the window.
    """
    size = described.layout.columns
    blocks = np.arange(described.columns_per_frame // size)
    first, last = (column // size for column in described.column_window)
    wraps = described.column_window[0] > described.column_window[1]
    sent = (blocks >= first) | (blocks <= last) if wraps else (blocks >= first) & (blocks <= last)
    rank = np.where(sent, np.cumsum(sent) - 1, -1)
    return rank.astype(np.int64), int(sent.sum())


def _is_imu(described: Metadata, size: int) -> bool:
    if described.imu_profile == LEGACY:
        return size in (LEGACY_SIZE, LEGACY_SIZE + 1)
    if described.imu_profile != ACCEL32:
        return False
    if described.imu_samples:
        return size in (imu_size(described.imu_samples), imu_size(described.imu_samples) + 1)
    return sample_count(size) > 0
