"""The interface of a sensor module: a `Calibration`, from which a `Lidar` is made."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import BeamTable, Projection
from mlbatch.lidar.headers import HeaderReader, Headers, content_keys
from mlbatch.types import ColumnHeaders, ImuSamples, Stream
from mlbatch.units import NS_PER_S

# Verdicts of `Lidar.faults`, in the order of their numbers; 0 is a good packet.
FAULTS = ("", "bad_size", "bad_header", "bad_crc")


class SensorModel(NamedTuple):
    """A row of `mlbatch sensors`: a supported model.

    returns: supported numbers of returns; clock, calibration: their sources; verified: how the
    model was tested; same_packets_as: the model that is reported instead, as packets are equal.
    """

    name: str
    vendor: str
    channels: int
    returns: tuple[int, ...]
    clock: str
    calibration: str
    verified: str
    same_packets_as: str = ""


class Recorded(NamedTuple):
    """How the packets of a vendor are recorded where nothing else is known.

    port, imu_port, device_port: default destinations of lidar, IMU and other packets; topic,
    imu_topic: last parts of topics ("": as for the lidar); message, message_ros1: types of its
    drivers, package/Type; device_magic: first bytes of packets that describe the device.
    """

    port: int
    topic: str
    message: str
    message_ros1: str
    imu_port: int = 0
    imu_topic: str = ""
    device_port: int = 0
    device_magic: bytes = b""


class NeighbourStream(NamedTuple):
    """Packets of another stream with the same source IP or topic namespace; as `Evidence`.

    Position, device and IMU packets contain facts that the packets of a lidar lack.
    """

    stream: Stream
    size: int
    sample: U8Array
    host_ns: I64Array


class Evidence(NamedTuple):
    """A sample of the packets of one stream and size, from which the sensor is identified.

    size: bytes of a payload; sample: (k, size) uint8, the first packets, then some of each quarter
    of a second; host_ns: (k,) int64, their receive times; neighbours: samples of other streams of
    the same source.
    """

    stream: Stream
    size: int
    sample: U8Array
    host_ns: I64Array
    neighbours: tuple[NeighbourStream, ...] = ()


# `Calibration.match_score` of packets that can be read with it but name another model: the
# calibration is used only if the rig names its model.
NAMED_ONLY = -1


class Calibration(ABC):
    """Calibration of one sensor, or (`is_shared`) of all sensors of a model."""

    # Of its file; None: built in.
    path: Path | None = None
    model: str
    serial: str = ""
    is_shared: bool = False

    def for_model(self, name: str) -> Calibration | None:
        """Return the calibration for the model that the rig names; None if it does not match.

        For files that do not name their model exactly, and packets that fit several.
        """
        return None

    @abstractmethod
    def match_score(self, evidence: Evidence) -> int:
        """Score the match with packets: 0: none, 100: a built-in one that they name, 200: a file.

        Negative: see NAMED_ONLY.
        """

    @abstractmethod
    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> Lidar:
        """Make the lidar; options: of `--decode`; evidence: None before any packet.

        Raises RigError if the file is unusable, or if packets are needed first.
        """


class Records(NamedTuple):
    """Positions of the columns of a packet.

    Column c begins `start + (c // per_row) * stride + (c % per_row) * step` bytes from the start
    of the packet, and is `size` bytes long; columns may overlap.
    """

    start: int
    stride: int
    size: int
    per_row: int = 1
    step: int = 0


class BitField(NamedTuple):
    """An unsigned integer in a pixel: `(word >> shift) & mask` of the word at byte `first`.

    word: numpy type, "u1", "<u2", ">u2" or "<u4".
    """

    first: int
    word: str
    shift: int = 0
    mask: int = 0xFFFFFFFF


class ChannelRun(NamedTuple):
    """Channels with evenly spaced pixels.

    first_byte: offset of the first pixel in a record; channel: its channel; channels: their number.
    """

    first_byte: int
    channel: int
    channels: int


class ReturnLayout(NamedTuple):
    """The pixels of one return; reflectivity: None if the sensor has none besides intensity."""

    runs: tuple[ChannelRun, ...]
    distance: BitField
    intensity: BitField
    reflectivity: BitField | None = None


class PixelTable(NamedTuple):
    """The pixels of a record, `step` bytes from channel to channel.

    The range in m is `distance * factor / divisor`, each step rounded to float32; 0 (no return) if
    the distance is at most `silent`, and for the channels `dark`.
    """

    step: int
    returns: tuple[ReturnLayout, ...]
    divisor: float
    factor: float = 1.0
    silent: int = 0
    dark: tuple[int, ...] = ()


def readings(
    first_bytes: tuple[tuple[int, ...], ...], channels: int, word: str, mask: int = 0xFFFFFFFF
) -> tuple[ReturnLayout, ...]:
    """Return layouts of pixels with 2 bytes of distance, then 1 byte of intensity.

    first_bytes: by return, the first bytes of runs of equally many channels.
    """
    distance = BitField(0, word, 0, mask)
    intensity = BitField(2, "u1")
    return tuple(
        ReturnLayout(
            tuple(
                ChannelRun(first, number * (channels // len(firsts)), channels // len(firsts))
                for number, first in enumerate(firsts)
            ),
            distance,
            intensity,
        )
        for firsts in first_bytes
    )


class Lidar:
    """Decoder of the packets of one physical sensor.

    Vendors derive theirs, and assign what is only declared here. The rest are defaults: of a sensor
    without serial number, counter, IMU and known pose, whose beams are described by vectors.
    """

    vendor: str
    model: str
    # "" if unknown.
    serial: str = ""
    # The packets contain the serial number.
    carries_serial: bool = False
    # Return mode or profile, for people.
    mode: str
    # Beams of a column, in wire order.
    channels: int
    # Returns of a shot.
    returns: int
    has_reflectivity: bool = False
    # Bytes of a payload.
    packet_size: int
    columns_per_packet: int
    # From column to column without gaps; 0: unknown.
    column_period_ns: float = 0.0
    # Share of a revolution in which it is set to measure; None: not known.
    lit_share: float | None = None
    # Positions of the columns in a packet.
    records: Records
    # Readings of the pixels of a record; None: it has coordinates (`projection`).
    pixels: PixelTable | None = None
    # Reads headers by compiled loops; None: a subclass has methods that read packets.
    reader: HeaderReader | None = None
    # The sequence number wraps there; 0: packets have none.
    sequence_modulus: int = 0
    # Destination ports of its packets and of IMU packets by its settings; 0: unknown.
    lidar_port: int = 0
    imu_port: int = 0
    # By return; numbers of docs/sources/outputs.md section 3.
    return_types: tuple[int, ...]
    # How dual returns get their types: "order" (the first is the stronger), "level" (by range and
    # intensity), "" (they keep `return_types`).
    typed_by: str = "level"
    # A single return is sent once for each return of the mode.
    sends_twice: bool = True
    # (channels,) or (T, channels), output number of each beam; rows as of `firing_ns`.
    channel: I64Array
    # (T, channels), delay of each beam after the timestamp of its column, ns, >= 0. Rotor words
    # select the row; columns without them use row 0.
    firing_ns: I64Array
    beams: BeamTable
    # (4, 4) body_from_sensor, m, if the calibration contains it.
    extrinsics: F64Array | None = None
    # (4, 4), m, if the vendor's driver has a lidar frame besides the sensor frame.
    sensor_from_lidar: F64Array | None = None
    # The vendor's name, or "".
    timestamp_mode: str = ""
    # Period of incomplete timestamps (an hour), completed by the receive time; 0: complete.
    clock_period_ns: int = 0
    # Source of the calibration, for people.
    calibration: str
    # Part of the calibration that packets cannot confirm, or "": for information, no warning.
    unproven: str = ""
    notes: tuple[str, ...] = ()

    @property
    def columns_per_s(self) -> float:
        """Columns sent in a second, while it measures and without loss; 0: unknown."""
        return NS_PER_S / self.column_period_ns if self.column_period_ns else 0.0

    def _read(self, packets: U8Array, host_ns: I64Array | None = None) -> Headers:
        if self.reader is None:
            raise TypeError(f"{type(self).__name__}: expected a reader, or methods of its own")
        return self.reader.read_rows(packets, host_ns)

    def sent_by_me(self, packets: U8Array) -> BoolArray:
        """Return which packets (P, packet_size) have this sensor's serial number: (P,) bool.

        True for packets without a serial number.
        """
        if self.reader is None:
            return np.ones(len(packets), np.bool_)
        return self.reader.read_rows(packets).is_mine

    def faults(self, packets: U8Array) -> U8Array:
        """Return indices into FAULTS (P,) of packets (P, packet_size)."""
        return self._read(packets).faults

    def sequence(self, packets: U8Array) -> I64Array:
        """Return the sequence numbers (P,) of packets, below `sequence_modulus`.

        Without sequence numbers: a number that only packets of equal content share, or a negative
        one if packets cannot be compared.
        """
        return content_keys(packets) if self.reader is None else self._read(packets).key

    def column_headers(self, packets: U8Array, host_ns: I64Array) -> ColumnHeaders:
        """Return timestamps, rotor positions and validity of all columns, without reading pixels.

        host_ns: (P,) receive times, for clocks without hour or date. The result for a packet does
        not depend on other packets.
        """
        return self._read(packets, host_ns).columns

    def is_imu(self, size: int) -> bool:
        """Return whether a payload of this size on the sensor's streams is an IMU packet."""
        return False

    def imu(self, payloads: U8Array, sensor: int) -> ImuSamples:
        """Return the samples of IMU packets (P, size), in their order; sensor: its index."""
        nothing = np.empty((0, 3))
        return ImuSamples(sensor, np.empty(0, np.int64), nothing, nothing)

    def sensor_from_imu(self) -> F64Array | None:
        """Return the pose of the IMU in the sensor frame, (4, 4), m; None: no IMU packets."""
        return None

    def projection(self, body_from_sensor: F64Array) -> Projection | None:
        """Return how ranges become points of a sensor that `beams` cannot describe; else None."""
        return None
