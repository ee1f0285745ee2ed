"""The face that every maker's module gives to the rest: a `Calibration` that becomes a `Lidar`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from mlbatch.geometry import BeamTable
from mlbatch.types import BoolArray, F64Array, Heads, I64Array, ImuSamples, Pixels, Stream, U8Array

# Verdicts of `Lidar.faults`, in the order of their numbers; 0 is a good packet.
FAULTS = ("", "bad_size", "bad_header", "bad_crc")


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A row of `mlbatch sensors`: what is supported, and how it was verified."""

    name: str
    maker: str
    channels: int
    returns: tuple[int, ...]
    clock: str
    calibration: str
    verified: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one kind of packets of a stream looks like; used to tell where they come from.

    size: bytes of a payload; sample: (k, size) uint8, the first few of them; sizes: all payload
    sizes seen from the same source IP (any port), to tell twins apart by their IMU.
    """

    stream: Stream
    size: int
    sample: U8Array
    sizes: frozenset[tuple[int, int]] = frozenset()  # (port, size)


class Calibration(Protocol):
    """A calibration or metadata file, parsed; one sensor."""

    path: Path | None
    model: str
    serial: str

    def fit(self, evidence: Evidence) -> int:
        """How well the packets fit: 0 cannot be this sensor, more is surer."""
        ...

    def lidar(self, options: dict[str, str]) -> Lidar:
        """The sensor; options are those of `--decode`. Raises RigError for an unusable file."""
        ...


class Lidar(Protocol):
    """One physical sensor: how its packets are read, nothing of windows or files.

    A packet holds `columns_per_packet` columns as equal records of `record_size` bytes from byte
    `record_start` on. `sequence_modulus`: the sequence number wraps there (0: packets carry none).
    `pixel_layout`: equal for sensors whose records `read` decodes alike. `carries_serial`: the
    packets name the sensor; `imu_port`: where its IMU packets go, 0 unknown. `return_types`:
    numbering of facts/outputs.md section 3 per return; `strongest_first`: of two returns the first
    is the stronger. `extrinsics`: (4, 4) body_from_sensor if the calibration knows it;
    `sensor_from_lidar`: (4, 4), where the maker's driver has a lidar frame of its own.
    `timestamp_mode`: the maker's word or "".
    """

    maker: str
    model: str
    serial: str
    carries_serial: bool
    mode: str
    channels: int
    returns: int
    has_reflectivity: bool
    packet_size: int
    columns_per_packet: int
    record_start: int
    record_size: int
    pixel_layout: tuple[str | int | bool, ...]
    sequence_modulus: int
    imu_port: int
    return_types: tuple[int, ...]
    strongest_first: bool
    beams: BeamTable
    extrinsics: F64Array | None
    sensor_from_lidar: F64Array | None
    timestamp_mode: str
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
        """(P,) number of each packet in the sensor's own count, below `sequence_modulus`."""
        ...

    def heads(self, packets: U8Array) -> Heads:
        """Stamps, rotor positions and validity of all columns; no pixel is touched."""
        ...

    def read(self, records: U8Array, which: int, out: Pixels) -> None:
        """Decode return `which` of n gathered records (n, record_size) into `out`."""
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
