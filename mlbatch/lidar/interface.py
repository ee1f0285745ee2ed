"""The face that every maker's module gives to the rest: a `Calibration` that becomes a `Lidar`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import BeamTable, Projection
from mlbatch.lidar.pixel_table import PixelTable
from mlbatch.types import Heads, ImuSamples, Pixels, Stream

# Verdicts of `Lidar.faults`, in the order of their numbers; 0 is a good packet.
FAULTS = ("", "bad_size", "bad_header", "bad_crc")


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A row of `mlbatch sensors`: what is supported, and how it was verified.

    same_packets_as: the model whose packets equal those of this one, under whose name it is found.
    """

    name: str
    vendor: str
    channels: int
    returns: tuple[int, ...]
    clock: str
    calibration: str
    verified: str
    same_packets_as: str = ""


@dataclass(frozen=True, slots=True)
class Beside:
    """Other packets from the same source (its IP, or topics of its namespace), as Evidence.

    Position packets, device packets, IMU packets: what says more of a lidar than its own packets.
    """

    stream: Stream
    size: int
    sample: U8Array
    host_ns: I64Array


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one kind of packets of a stream looks like; used to tell where they come from.

    size: bytes of a payload; sample: (k, size) uint8, the first few of them, then some of every
    quarter of a second; host_ns: (k,) their arrival.
    """

    stream: Stream
    size: int
    sample: U8Array
    host_ns: I64Array
    beside: tuple[Beside, ...] = ()


# What `Calibration.fit` gives for packets that could be read with it, though they name another
# model: taken only where the rig names this one.
READABLE = -1


class Calibration(Protocol):
    """What is known of one sensor, or (`is_shared`) of all sensors of a model.

    path: of the file it comes from, None where it is built in.
    """

    path: Path | None
    model: str
    serial: str
    is_shared: bool

    def fit(self, evidence: Evidence) -> int:
        """How well the packets fit: 0 cannot be this sensor, more is surer; see READABLE."""
        ...

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> Lidar:
        """The sensor; options are those of `--decode`; evidence None: it was not seen yet.

        Raises RigError where the file cannot be used, or packets are needed to say more.
        """
        ...


@runtime_checkable
class ModelFile(Calibration, Protocol):
    """A calibration file that does not say exactly which model it is of."""

    def for_model(self, name: str) -> Calibration | None:
        """The same as one of the model that the rig names; None if it cannot be one."""
        ...


@dataclass(frozen=True, slots=True)
class Records:
    """Where the columns of a packet lie.

    Column c begins `start + (c // per_row) * stride + (c % per_row) * step` bytes from the start
    of the packet, and is `size` bytes long; columns may overlap.
    """

    start: int
    stride: int
    size: int
    per_row: int = 1
    step: int = 0


class Lidar(Protocol):
    """One physical sensor: how its packets are read, nothing of windows or files.

    `records`: where its `columns_per_packet` columns lie. `channels`: beams of a column, in the
    order of the wire; `channel`: (channels,) the number of each in the output, or (T, channels) by
    the same rows as `firing_ns`:
    (T, channels) when each beam fires after its column's stamp, >= 0; rotor words choose the row,
    all else uses row 0. `sequence_modulus`: the sequence number wraps there (0: packets carry no
    count). `pixel_layout`: equal for sensors whose records `read` decodes alike; `pixels`: where
    they lie, None where only `read` knows. `carries_serial`:
    the packets name the sensor; `imu_port`: where its IMU packets go, 0 unknown. `return_types`:
    numbering of docs/sources/outputs.md section 3 per return; `typed_by`: how those of two returns
    are told: "order" (the first is the stronger), "level" (by range and intensity), "" (not at
    all). `column_period_ns`: from column to column where nothing is left out, 0 unknown.
    `sends_twice`: a single return is sent once for each return of the mode. `extrinsics`: (4, 4)
    body_from_sensor if the calibration knows it; `sensor_from_lidar`: (4, 4), where the maker's
    driver has a lidar frame of its own. `timestamp_mode`: the maker's word or "";
    `clock_period_ns`: what its stamps leave out and the recorder's clock gave (an hour), or 0.
    """

    vendor: str
    model: str
    serial: str
    carries_serial: bool
    mode: str
    channels: int
    returns: int
    has_reflectivity: bool
    packet_size: int
    columns_per_packet: int
    column_period_ns: float
    records: Records
    pixel_layout: tuple[str | int | bool, ...]
    pixels: PixelTable | None
    sequence_modulus: int
    imu_port: int
    return_types: tuple[int, ...]
    typed_by: str
    sends_twice: bool
    channel: I64Array
    firing_ns: I64Array
    beams: BeamTable
    extrinsics: F64Array | None
    sensor_from_lidar: F64Array | None
    timestamp_mode: str
    clock_period_ns: int
    calibration: str
    notes: tuple[str, ...]

    def owns(self, packets: U8Array) -> BoolArray:
        """Which of the packets (P, packet_size) are this sensor's, by the serial number in them.

        True where packets carry none.
        """
        ...

    def faults(self, packets: U8Array) -> U8Array:
        """Index into FAULTS for each of the packets (P, packet_size)."""
        ...

    def sequence(self, packets: U8Array) -> I64Array:
        """(P,) number of each packet in the sensor's own count, below `sequence_modulus`.

        Without a count: a number that only packets of equal content share. Negative: no identity.
        """
        ...

    def heads(self, packets: U8Array, host_ns: I64Array) -> Heads:
        """Stamps, rotor positions and validity of all columns; no pixel is touched.

        host_ns: (P,) arrival, for clocks that leave out the hour or the date. The answer for a
        packet depends on it alone, not on those before it.
        """
        ...

    def read(self, records: U8Array, which: int, out: Pixels) -> None:
        """Decode return `which` of n gathered columns (n, records.size) into `out`."""
        ...

    def is_imu(self, size: int) -> bool:
        """Whether a payload of this size on the sensor's streams is an IMU packet."""
        ...

    def imu(self, payloads: U8Array, sensor: int) -> ImuSamples:
        """Samples of IMU packets (P, size), in their order."""
        ...

    def sensor_from_imu(self) -> F64Array:
        """Pose of the IMU in the sensor frame, (4, 4), metres; identity where unknown."""
        ...

    def projection(self, body_from_sensor: F64Array, columns: int) -> Projection | None:
        """What makes points of ranges where the beams' vectors do not suffice; else None.

        columns: the most that are aimed at once.
        """
        ...
