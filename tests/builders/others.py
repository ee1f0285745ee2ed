"""Packets to be named by their bytes, without readings."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from tests.builders.lidar_packets import even

EE = b"\xff\xee"


def rows(payloads: Sequence[bytes]) -> U8Array:
    """(k, size) payloads of one size."""
    return np.stack([np.frombuffer(payload, np.uint8) for payload in payloads])


def filled(size: int, parts: dict[int, bytes]) -> bytes:
    """A payload with these bytes at these places."""
    payload = bytearray(size)
    for at, part in parts.items():
        payload[at : at + len(part)] = part
    assert len(payload) == size
    return bytes(payload)


def velodyne_packets(
    factory: bytes, model: str, mode: str = "strongest", size: int = 1206, count: int = 8
) -> U8Array:
    """Packets at the pace of a model, with other bytes from 1204 on; they pass the full hour."""
    spec = VelodyneSpec(model, mode, start_azimuth_deg=350.0, start_us=3_599_998_000.0)
    payloads = [payload[:1204] + factory for _, payload in even(spec, count, 0, 0)]
    return rows([payload.ljust(size, b"\0") for payload in payloads])


def robosense_packets(
    head: dict[int, bytes],
    lines: int = 32,
    mode: str = "strongest",
    *,
    calendar: bool = False,
    count: int = 8,
) -> U8Array:
    """MSOP packets with blocks of 100 bytes and this header; their times pass a full minute."""
    model = {16: "RS-16", 32: "RS-32"}[lines] if calendar else f"Helios {lines}"
    start_ns = 1_700_000_040 * 10**9 - 1_500_000
    packets = rows(
        [
            data
            for _, data in even(
                RobosenseSpec(model, mode, start_deg=350.0, start_ns=start_ns), count, 0, 0
            )
        ]
    )
    packets[:, [*range(20), 30, 31, 32]] = 0
    for at, part in head.items():
        packets[:, at : at + len(part)] = list(part)
    return packets


def livox2_packets(kind: int, point_size: int, points: int, count: int = 3) -> U8Array:
    """Packets of Livox SDK2."""
    size = 36 + point_size * points
    return rows(
        [
            filled(size, {1: struct.pack("<HHHHBBB", size, 100, points, n, 0, kind, 1)})
            for n in range(count)
        ]
    )


def livox1_packets(
    kind: int, size: int, time_type: int = 1, step: int = 400_000, count: int = 3
) -> U8Array:
    """Packets of Livox SDK1; step: ns, or us with GPS time (time type 3)."""
    payloads = []
    for n in range(count):
        nanoseconds = struct.pack("<Q", 1_600_000_000_000_000_000 + n * step)
        gps = bytes((21, 12, 7, 3)) + struct.pack("<I", 1_000_000 + n * step)
        time = gps if time_type == 3 else nanoseconds
        head = bytes((5, 1, 0, 0, n, 0, 0, 0, time_type, kind))
        payloads.append(filled(size, {0: head, 10: time}))
    return rows(payloads)
