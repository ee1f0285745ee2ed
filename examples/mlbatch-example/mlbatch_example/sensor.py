"""The Example-4: an imaginary lidar of four beams.

Packet, little endian, 128 bytes: "EX4" and a zero, u32 packet counter, u64 time of the first column
(UTC, ns); then eight columns, 250 us apart, of u16 rotor angle (0.01 degrees, clockwise) and four
readings of u16 range (5 mm) and u8 intensity.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, spherical
from mlbatch.lidar.interface import (
    FAULTS,
    Calibration,
    Evidence,
    Lidar,
    PixelTable,
    Records,
    SensorModel,
    readings,
)
from mlbatch.types import ColumnHeaders

# A structured array; numpy has no type for the fields of a dtype.
Fields: TypeAlias = npt.NDArray[Any]

VENDOR = "Example"
NAME = "Example-4"
MODELS = (
    SensorModel(
        name=NAME,
        vendor=VENDOR,
        channels=4,
        returns=(1,),
        clock="UTC, ns in every packet",
        calibration="none: all units are alike",
        verified="imaginary",
    ),
)

MAGIC = b"EX4\0"
HEADER_BYTES = 16
COLUMNS = 8
COLUMN_NS = 250_000
POSITIONS = 36_000
ELEVATION_DEG = (-15.0, -5.0, 5.0, 15.0)
PER_METRE = 200.0

READING = np.dtype([("range", "<u2"), ("intensity", "u1")])
COLUMN = np.dtype([("angle", "<u2"), ("reading", READING, 4)])
PACKET = np.dtype(
    [("magic", "S4"), ("counter", "<u4"), ("time_ns", "<u8"), ("column", COLUMN, COLUMNS)]
)
# Readings begin behind the angle, 3 bytes each: u16 range, u8 intensity.
PIXELS = PixelTable(READING.itemsize, readings(((2,),), 4, "<u2"), PER_METRE)


class ExampleCalibration(Calibration):
    """The beams of all units."""

    model = NAME
    is_shared = True

    def match_score(self, evidence: Evidence) -> int:
        """100 for packets that begin as those of an Example-4."""
        return 100 if _are_packets(evidence.size, evidence.sample) else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> ExampleLidar:
        """Decoder of the sensor; there are no options."""
        if options:
            raise RigError(f"{NAME}: expected no option, found {', '.join(options)}; leave it out")
        return ExampleLidar()


BUILT_IN: tuple[Calibration, ...] = (ExampleCalibration(),)


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """None: there are no calibration files."""
    return None


def describe(size: int, sample: U8Array) -> str | None:
    """Name packets of an Example-4."""
    return f"{NAME} lidar" if _are_packets(size, sample) else None


def _are_packets(size: int, sample: U8Array) -> bool:
    return size == PACKET.itemsize and bool(_begins_right(sample).any())


def _begins_right(packets: U8Array) -> BoolArray:
    right: BoolArray = (packets[:, : len(MAGIC)] == np.frombuffer(MAGIC, np.uint8)).all(axis=1)
    return right


class ExampleLidar(Lidar):
    """Decoder of one Example-4; implements `Lidar`."""

    def __init__(self) -> None:
        self.vendor = VENDOR
        self.model = NAME
        self.mode = "10 Hz"
        self.channels = 4
        self.returns = 1
        self.packet_size = PACKET.itemsize
        self.columns_per_packet = COLUMNS
        self.column_period_ns = COLUMN_NS
        self.records = Records(HEADER_BYTES, COLUMN.itemsize, COLUMN.itemsize)
        self.pixels = PIXELS
        self.return_types = (0,)
        self.sends_twice = False
        self.sequence_modulus = 1 << 32
        self.channel = np.arange(4)
        # All four beams fire at once.
        self.firing_ns = np.zeros((1, 4), np.int64)
        elevation_rad = np.radians(ELEVATION_DEG)
        self.beams = BeamTable(
            direction=spherical(np.zeros(4), elevation_rad),
            origin=np.zeros((3, 1, 3)),
            reach_m=np.zeros(1),
            angle_rad=np.arange(POSITIONS, dtype=np.float64) * (2 * np.pi / POSITIONS),
        )
        self.calibration = "built in"

    def faults(self, packets: U8Array) -> U8Array:
        """(P,) index into FAULTS."""
        angles_fit = (_fields(packets)["column"]["angle"] < POSITIONS).all(axis=1)
        bad = ~(_begins_right(packets) & angles_fit)
        verdicts: U8Array = bad.astype(np.uint8) * np.uint8(FAULTS.index("bad_header"))
        return verdicts

    def sequence(self, packets: U8Array) -> I64Array:
        """(P,) packet counter."""
        return _fields(packets)["counter"].astype(np.int64)

    def column_headers(self, packets: U8Array, host_ns: I64Array) -> ColumnHeaders:
        """Timestamps and rotor positions of all columns."""
        fields = _fields(packets)
        first_ns = fields["time_ns"].astype(np.int64)[:, None]
        stamp_ns = first_ns + np.arange(COLUMNS) * COLUMN_NS
        encoder = fields["column"]["angle"].astype(np.int64)
        return ColumnHeaders(stamp_ns, encoder, np.ones(stamp_ns.shape, np.bool_))


def _fields(packets: U8Array) -> Fields:
    """Packets (P, size) as records (P,)."""
    return np.ascontiguousarray(packets).view(PACKET)[:, 0]
