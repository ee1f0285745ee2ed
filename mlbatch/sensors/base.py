"""Defaults of the protocol `Lidar` for lidars without serial number, IMU or known extrinsics."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import BeamTable, Projection
from mlbatch.lidar.header_table import HeaderTable
from mlbatch.lidar.interface import Records
from mlbatch.lidar.pixel_table import PixelTable
from mlbatch.types import ImuSamples
from mlbatch.units import NS_PER_S


class BaseLidar:
    """Base class of the vendors' lidars.

    A subclass assigns the attributes that are only declared here and implements `faults`,
    `column_headers` and `read`.
    """

    vendor: str
    model: str
    mode: str
    channels: int
    returns: int
    packet_size: int
    columns_per_packet: int
    records: Records
    pixel_layout: tuple[str | int | bool, ...]
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

    def projection(self, body_from_sensor: F64Array, columns: int) -> Projection | None:
        """None: the beam vectors suffice."""
        return None


def content_keys(packets: U8Array) -> I64Array:
    """(P,) hashes >= 0 of packets (P, size).

    The sum of the packet's words times odd numbers, modulo 2**64: a single bit changes it.
    """
    size = packets.shape[1]
    words = size // 8
    # Bytes beyond whole words are hashed as the last eight bytes, which may overlap the words.
    if words and packets.strides[1] == 1:
        keys = np.einsum("ij,j->i", packets[:, : words * 8].view("<u8"), hash_factors(words))
        if size % 8:
            keys = keys * _ODD + packets[:, size - 8 :].view("<u8")[:, 0]
    else:
        keys = np.zeros(len(packets), np.uint64)
        for at in range(size):
            keys = keys * _ODD + packets[:, at]
    keys ^= keys >> np.uint64(29)
    return np.asarray(keys * _ODD >> np.uint64(1), np.int64)


# The golden ratio of 2**64, made odd (Knuth, multiplicative hashing).
_ODD = np.uint64(0x9E3779B97F4A7C15)


@lru_cache(maxsize=16)
def hash_factors(count: int) -> npt.NDArray[np.uint64]:
    """Return the factors of the words of a packet in `content_keys`: (count,) odd numbers."""
    numbers = np.arange(1, count + 1, dtype=np.uint64) * _ODD
    return np.asarray((numbers ^ numbers >> np.uint64(31)) | np.uint64(1), np.uint64)
