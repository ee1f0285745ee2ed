"""Packets to be named by their bytes: what facts/*.md say of them, all else zero."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import U8Array

EE = b"\xff\xee"
DD = b"\xff\xdd"
CC = b"\xff\xcc"
BB = b"\xff\xbb"
CDEG_PER_US = 0.36  # 600 rpm
START_CDEG = 35000  # so that streams of a few packets pass zero


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


def turning(count: int, azimuths: int, row_us: float) -> list[tuple[float, list[int]]]:
    """(time of the packet in us, azimuths in 0.01 degree, `row_us` apart) of successive packets."""
    found = []
    for packet in range(count):
        begin_us = packet * azimuths * row_us
        times_us = [begin_us + row * row_us for row in range(azimuths)]
        found.append((begin_us, [round(START_CDEG + CDEG_PER_US * t) % 36000 for t in times_us]))
    return found


def velodyne_packets(
    factory: bytes,
    row_us: float,
    flags: Sequence[bytes] = (EE,) * 12,
    azimuths: int = 12,
    count: int = 8,
    size: int = 1206,
    begin_us: int = 3_599_998_000,
) -> U8Array:
    """A stream of 12 blocks a packet; blocks share an azimuth where there are fewer of them.

    It passes the full hour, where stamps start over.
    """
    payloads = []
    for time_us, cdeg in turning(count, azimuths, row_us):
        parts = {
            100 * block: flag + struct.pack("<H", cdeg[block * azimuths // len(flags)])
            for block, flag in enumerate(flags)
        }
        stamp_us = round(begin_us + time_us) % 3_600_000_000
        parts[1200] = struct.pack("<I", stamp_us) + factory
        payloads.append(filled(size, parts))
    return rows(payloads)


def robosense_packets(
    head: dict[int, bytes],
    row_us: float = 55.5,
    azimuths: int = 12,
    *,
    calendar: bool = False,
    count: int = 8,
) -> U8Array:
    """MSOP packets with a header of 42 bytes and 12 blocks of 100."""
    payloads = []
    for time_us, cdeg in turning(count, azimuths, row_us):
        micro = 59_998_500 + round(time_us)  # it passes a full minute
        second = micro // 1_000_000
        rest = micro % 1_000_000
        form = bytes((21, 12, 7, 3, 6 + second // 60, second % 60))
        time = (
            form + struct.pack(">HH", rest // 1000, rest % 1000)
            if calendar
            else struct.pack(">HII", 0, second, rest)
        )
        parts = {20: time, **head}
        for block in range(12):
            parts[42 + 100 * block] = EE + struct.pack(">H", cdeg[block * azimuths // 12])
        payloads.append(filled(1248, parts))
    return rows(payloads)


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
