"""Encoder of Livox SDK2 packets: what a lidar would send, from plain raw values.

Source: docs/sources/others.md (Livox SDK2); what the CRC-32 covers, and frames: Livox communication
protocol of the Avia2, v1.0. Nothing here is shared with the decoder.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array

CARTESIAN32 = 1
CARTESIAN16 = 2
SPHERICAL = 3
DUAL = 0x11
IMU = 0
# Three coordinates, reflectivity, tag.
_RETURN = {CARTESIAN32: "<3iBB", CARTESIAN16: "<3hBB", SPHERICAL: "<I2HBB", DUAL: "<3iBB"}
# x, y, z in mm; x, y, z in cm; depth in mm, theta and phi in 0.01 degrees.
START_NS = 1_700_000_000_000_000_123


@dataclass(frozen=True, slots=True)
class LivoxSpec:
    """A lidar to imitate.

    kind: data type; points: of a packet; interval: of a packet, 0.1 us; frame_packets: after so
    many the counter starts over, 0: never; shares_stamp: all packets of a frame have one time.
    """

    kind: int = CARTESIAN32
    points: int = 96
    interval: int = 4800
    time_type: int = 1
    start_ns: int = START_NS
    first_counter: int = 0
    frame_packets: int = 0
    shares_stamp: bool = False
    latency_ns: int = 100_000

    @property
    def returns(self) -> int:
        """Of a point."""
        return 2 if self.kind == DUAL else 1

    @property
    def size(self) -> int:
        """Bytes of a packet."""
        return 36 + self.points * self.returns * struct.calcsize(_RETURN[self.kind])


def packet(
    spec: LivoxSpec, data: bytes, stamp_ns: int, counter: int, *, kind: int, points: int
) -> bytes:
    """Header and data."""
    timed = struct.pack("<Q", stamp_ns) + data
    head = struct.pack("<BHHHHBBB", 1, 28 + len(timed), spec.interval, points, counter, 0, kind,
                       spec.time_type)  # fmt: skip
    return head.ljust(24, b"\0") + struct.pack("<I", zlib.crc32(timed)) + timed


def point_packets(
    spec: LivoxSpec, coordinates: I64Array, levels: I64Array
) -> list[tuple[int, bytes]]:
    """(receive time in ns, payload) of n points, n a multiple of the points of a packet.

    coordinates: (n, returns, 3) raw; levels: (n, returns).
    """
    sent = []
    interval_ns = spec.interval * 100
    for number in range(len(coordinates) // spec.points):
        rows = slice(number * spec.points, (number + 1) * spec.points)
        values = np.concatenate([coordinates[rows], levels[rows, :, None]], axis=2).reshape(-1, 4)
        data = b"".join(struct.pack(_RETURN[spec.kind], *row, 0) for row in values.tolist())
        counter = spec.first_counter + number
        frame = number
        if spec.frame_packets:
            counter %= spec.frame_packets
            frame -= counter if spec.shares_stamp else 0
        stamp_ns = spec.start_ns + frame * interval_ns
        payload = packet(spec, data, stamp_ns, counter % 65536, kind=spec.kind, points=spec.points)
        receive_ns = spec.start_ns + (number + 1) * interval_ns + spec.latency_ns
        sent.append((receive_ns, payload))
    return sent


def imu_packet(
    spec: LivoxSpec,
    stamp_ns: int,
    angular_velocity: npt.NDArray[np.float64],
    acceleration_g: npt.NDArray[np.float64],
) -> bytes:
    """A sample: (3,) rad/s and (3,) g."""
    data = struct.pack("<6f", *angular_velocity.tolist(), *acceleration_g.tolist())
    return packet(spec, data, stamp_ns, 0, kind=IMU, points=1)
