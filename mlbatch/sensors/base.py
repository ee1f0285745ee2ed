"""Defaults of the protocol `Lidar` for lidars without serial number, IMU or known extrinsics."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.content_keys import content_keys
from mlbatch.lidar.geometry import BeamTable
from mlbatch.lidar.header_table import HeaderTable
from mlbatch.lidar.interface import Records
from mlbatch.lidar.pixel_table import PixelTable
from mlbatch.lidar.projections import Projection
from mlbatch.types import ImuSamples
from mlbatch.units import NS_PER_S


class BaseLidar:
    """Base class of the vendors' lidars.

    A subclass assigns the attributes that are only declared here and implements `faults`
    and `column_headers`.
    """

    vendor: str
    model: str
    mode: str
    channels: int
    returns: int
    packet_size: int
    columns_per_packet: int
    records: Records
    return_types: tuple[int, ...]
    channel: I64Array
    firing_ns: I64Array
    beams: BeamTable
    calibration: str

    pixels: PixelTable | None = None
    headers: HeaderTable | None = None
    serial: str = ""
    carries_serial: bool = False
    has_reflectivity: bool = False
    sequence_modulus: int = 0
    column_period_ns: float = 0.0
    lit_share: float | None = None
    imu_port: int = 0
    typed_by: str = "level"
    sends_twice: bool = True
    extrinsics: F64Array | None = None
    sensor_from_lidar: F64Array | None = None
    timestamp_mode: str = ""
    clock_period_ns: int = 0
    notes: tuple[str, ...] = ()
    unproven: str = ""

    @property
    def header_bytes(self) -> I64Array:
        """The whole packet, where a lidar does not say what it reads."""
        return np.array([[0, self.packet_size]])

    @property
    def columns_per_s(self) -> float:
        """Columns sent in a second: one a period."""
        return NS_PER_S / self.column_period_ns if self.column_period_ns else 0.0

    def sent_by_me(self, packets: U8Array) -> BoolArray:
        """All packets: they carry no serial number."""
        return np.ones(len(packets), np.bool_)

    def sequence(self, packets: U8Array) -> I64Array:
        """(P,) hash of the content, equal for equal packets."""
        return content_keys(packets)

    def is_imu(self, size: int) -> bool:
        """No IMU packets."""
        return False

    def imu(self, payloads: U8Array, sensor: int) -> ImuSamples:
        """No samples."""
        nothing = np.empty((0, 3))
        return ImuSamples(sensor, np.empty(0, np.int64), nothing, nothing)

    def sensor_from_imu(self) -> F64Array | None:
        """None: no IMU packets."""
        return None

    def projection(self, body_from_sensor: F64Array) -> Projection | None:
        """None: the beam vectors suffice."""
        return None
