"""Defaults of the protocol `Lidar` for lidars without serial number, IMU or known extrinsics."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import BeamTable, Projection
from mlbatch.lidar.headers import HeaderReader, Headers, content_keys
from mlbatch.lidar.interface import PixelTable, Records
from mlbatch.types import ColumnHeaders, ImuSamples
from mlbatch.units import NS_PER_S


class BaseLidar:
    """Base class of the vendors' lidars.

    A subclass assigns the attributes that are only declared here.
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
    # None: a subclass implements the methods that read packets.
    reader: HeaderReader | None = None

    pixels: PixelTable | None = None
    serial: str = ""
    carries_serial: bool = False
    has_reflectivity: bool = False
    sequence_modulus: int = 0
    column_period_ns: float = 0.0
    lit_share: float | None = None
    lidar_port: int = 0
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
    def columns_per_s(self) -> float:
        """Columns sent per second: one per period."""
        return NS_PER_S / self.column_period_ns if self.column_period_ns else 0.0

    def _read(self, packets: U8Array, host_ns: I64Array | None = None) -> Headers:
        if self.reader is None:
            raise TypeError(f"{type(self).__name__}: expected a reader, or methods of its own")
        return self.reader.read_rows(packets, host_ns)

    def sent_by_me(self, packets: U8Array) -> BoolArray:
        """(P,) whether packets have this sensor's serial number, or none."""
        if self.reader is None:
            return np.ones(len(packets), np.bool_)
        return self.reader.read_rows(packets).is_mine

    def faults(self, packets: U8Array) -> U8Array:
        """(P,) index into FAULTS."""
        return self._read(packets).faults

    def sequence(self, packets: U8Array) -> I64Array:
        """(P,) packet counter; for sensors without one, a hash of the content."""
        return content_keys(packets) if self.reader is None else self._read(packets).key

    def column_headers(self, packets: U8Array, host_ns: I64Array) -> ColumnHeaders:
        """Timestamps, rotor positions and validity of all columns."""
        return self._read(packets, host_ns).columns

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
