"""Readings of ROBOSENSE packets: byte by byte where they lie, and when they fired.

Source: docs/sources/robosense.md sections 1 to 6, each number worked out by hand.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

FIRST = bytes.fromhex("55aa050a5aa550a0")
SECOND = bytes.fromhex("55aa055a")
# 2021-12-07 03:06:24.765698 UTC: 18968 days, 3 hours, 6 minutes, 24 s.
CALENDAR = bytes((21, 12, 7, 3, 6, 24)) + struct.pack(">HH", 765, 698)
CALENDAR_NS = (((18968 * 24 + 3) * 60 + 6) * 60 + 24) * 10**9 + 765_698_000
SECONDS = struct.pack(">HII", 0, 1_700_000_000, 355_991)
SECONDS_NS = 1_700_000_000_355_991_000


@dataclass(frozen=True, slots=True)
class Probe:
    """A reading: its byte, and what it is.

    after_us: when it fires after the packet's time; turned_cdeg: what the rotor has turned by then
    since the first block, 0.01 degree.
    """

    at: int
    column: int
    channel: int
    after_us: float
    turned_cdeg: float
    which: int = 0


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of packet.

    head: its bytes; blocks: (first byte, stride, count) of blocks; shared: blocks that share an
    azimuth; step_cdeg: from one azimuth to the next; lens_m: radius and height; difop: return mode,
    place and unit (degrees) of elevations and of azimuths (0: none).
    """

    model: str
    head: Mapping[int, bytes]
    step_cdeg: int
    unit_m: float
    lens_m: tuple[float, float]
    difop: tuple[int, int, int, float]
    probes: tuple[Probe, ...]
    blocks: tuple[int, int, int] = (42, 100, 12)
    block_id: bytes = b"\xff\xee"
    shared: int = 1
    size: int = 1248
    mode: str = "single return"
    extra: Mapping[int, bytes] = field(default_factory=dict)


CENTI = 0.01
FIRST_CDEG = 12_345
RS16 = {0: FIRST, 30: b"\x01", 20: CALENDAR}
RS32 = {0: FIRST, 30: b"\x02", 20: CALENDAR}
BPEARL_3 = {0: FIRST, 30: b"\x03", 20: CALENDAR}
BPEARL_4 = {0: FIRST, 31: b"\x03\x04", 20: SECONDS}
HELIOS_32 = {0: SECOND, 17: b"\x01", 31: b"\x06\x01", 20: SECONDS}
HELIOS_16 = {0: SECOND, 17: b"\x01", 31: b"\x06\x03", 20: SECONDS}
AIRY = {0: SECOND, 31: b"\x31\x02", 20: SECONDS}
RUBY = {0: SECOND, 7: b"\x01", 31: b"\x04", 10: SECONDS}
PLUS = {0: SECOND, 7: b"\x01", 31: b"\x05", 10: SECONDS}
FIRST_80 = (80, 244, 4)
FIRST_48 = (80, 148, 8)
CASES = (
    Case(
        "RS-LiDAR-16",
        RS16,
        40,  # two rounds of 55.5 us a block
        0.005,
        (0.03825, 0.0),
        (1, 1165, 0, 0.0001),
        (
            Probe(42 + 4, 0, 0, 0.0, 0.0),
            # Block 1, reading 20: second round, fifth channel.
            Probe(42 + 100 + 4 + 60, 3, 4, 111 + 55.5 + 4 * 2.8, 40 + 40 * (55.5 + 11.2) / 111),
            # Last reading of the packet.
            Probe(1142 + 4 + 93, 23, 15, 11 * 111 + 55.5 + 42, 440 + 40 * (55.5 + 42) / 111),
        ),
    ),
    Case(
        "RS-LiDAR-16",
        RS16,
        20,  # one round a block
        0.005,
        (0.03825, 0.0),
        (0, 1165, 0, 0.0001),
        (
            Probe(42 + 4 + 15, 0, 5, 14.0, 20 * 14 / 55.5),
            Probe(342 + 4 + 48, 3, 0, 3 * 55.5, 60.0, which=1),
            Probe(1142 + 4 + 93, 11, 15, 11 * 55.5 + 42, 220 + 20 * 42 / 55.5, which=1),
        ),
        mode="dual return",
    ),
    Case(
        "RS-LiDAR-32",
        RS32,
        20,
        0.005,
        (0.03997, 0.0),
        (2, 468, 564, 0.001),
        (
            Probe(42 + 4 + 45, 0, 15, 44.64, 20 * 44.64 / 55.52),  # channel 16: 15 * 2.88 + 1.44
            Probe(242 + 4 + 48, 2, 16, 2 * 55.52 + 1.44, 40 + 20 * 1.44 / 55.52),
            Probe(1142 + 4 + 93, 11, 31, 11 * 55.52 + 46.08, 220 + 20 * 46.08 / 55.52),
        ),
    ),
    Case(
        "RS-LiDAR-32",
        RS32,
        20,
        0.005,
        (0.03997, 0.0),
        (0, 468, 564, 0.001),
        (
            Probe(142 + 4, 0, 0, 0.0, 0.0, which=1),
            Probe(442 + 4 + 3, 2, 1, 2 * 55.52 + 2.88, 40 + 20 * 2.88 / 55.52),
            Probe(1142 + 4 + 6, 5, 2, 5 * 55.52 + 5.76, 100 + 20 * 5.76 / 55.52, which=1),
        ),
        shared=2,
        mode="dual return",
    ),
    Case(
        "RS-Bpearl v3",
        BPEARL_3,
        20,
        0.005,
        (0.01473, 0.09427),
        (1, 468, 564, CENTI),
        (
            Probe(42 + 4 + 24, 0, 8, 8 * 2.56 + 5.2, 20 * 25.68 / 55.52),
            Probe(142 + 4 + 48, 1, 16, 55.52 + 1.28, 20 + 20 * 1.28 / 55.52),
            Probe(1142 + 4 + 93, 11, 31, 11 * 55.52 + 44.88, 220 + 20 * 44.88 / 55.52),
        ),
    ),
    Case(
        "RS-Bpearl v4",
        BPEARL_4,
        20,
        0.0025,
        (0.01619, 0.09571),
        (4, 468, 564, CENTI),
        (
            Probe(42 + 4 + 9, 0, 3, 5.0, 20 * 5.0 / 55.56),
            Probe(542 + 4 + 42, 5, 14, 5 * 55.56 + 23.35, 100 + 20 * 23.35 / 55.56),
            Probe(1142 + 4 + 93, 11, 31, 11 * 55.56 + 51.71, 220 + 20 * 51.71 / 55.56),
        ),
    ),
    Case(
        "Helios 32",
        HELIOS_32,
        20,
        0.0025,
        (0.03498, 0.0),
        (5, 468, 564, CENTI),
        (
            Probe(42 + 4 + 3, 0, 1, 1.73, 20 * 1.73 / 55.56),
            Probe(642 + 4 + 60, 6, 20, 6 * 55.56 + 34.6, 120 + 20 * 34.6 / 55.56),
            Probe(1142 + 4 + 93, 11, 31, 11 * 55.56 + 53.63, 220 + 20 * 53.63 / 55.56),
        ),
    ),
    Case(
        "Helios 32",
        HELIOS_32,
        20,
        0.0025,
        (0.03498, 0.0),
        (0, 468, 564, CENTI),
        (
            Probe(42 + 4, 0, 0, 0.0, 0.0),
            Probe(742 + 4 + 6, 3, 2, 3 * 55.56 + 3.46, 60 + 20 * 3.46 / 55.56, which=1),
            Probe(1042 + 4 + 93, 5, 31, 5 * 55.56 + 53.63, 100 + 20 * 53.63 / 55.56),
        ),
        shared=2,
        mode="dual return",
    ),
    Case(
        "Helios 16",
        HELIOS_16,
        40,
        0.0025,
        (0.03498, 0.0),
        (6, 468, 564, CENTI),
        (
            Probe(42 + 4, 0, 0, 27.68, 40 * 27.68 / 111.12),
            Probe(42 + 4 + 48, 1, 0, 55.56 + 27.68, 40 * 83.24 / 111.12),
            Probe(
                1142 + 4 + 93,
                23,
                15,
                11 * 111.12 + 55.56 + 27.68 + 25.95,
                440 + 40 * (55.56 + 53.63) / 111.12,
            ),
        ),
    ),
    Case(
        "Helios 16",
        HELIOS_16,
        20,
        0.0025,
        (0.03498, 0.0),
        (0, 468, 564, CENTI),
        (
            Probe(42 + 4 + 3, 0, 1, 27.68 + 1.73, 20 * 29.41 / 55.56),
            Probe(142 + 4 + 51, 1, 1, 55.56 + 29.41, 20 + 20 * 29.41 / 55.56, which=1),
            Probe(1142 + 4 + 45, 11, 15, 11 * 55.56 + 53.63, 220 + 20 * 53.63 / 55.56),
        ),
        mode="dual return",
    ),
    Case(
        "Airy 96",
        AIRY,
        40,
        0.005,
        (0.01002, 0.04532),
        (0, 468, 756, CENTI),
        (
            Probe(42 + 4 + 24, 0, 8, 5.712, 40 * 5.712 / 111.08),
            Probe(42 + 3 * 148 + 4, 1, 48, 111.08 + 41.888, 40 + 40 * 41.888 / 111.08),
            Probe(42 + 7 * 148 + 145, 3, 95, 3 * 111.08 + 93.296, 120 + 40 * 93.296 / 111.08),
        ),
        blocks=(42, 148, 8),
        shared=2,
    ),
    Case(
        "Airy 96",
        {**AIRY, 17: b"\x03"},
        40,
        0.005,
        (0.01002, 0.04532),
        (0, 468, 756, CENTI),
        (
            Probe(42 + 4, 0, 0, 0.0, 0.0),
            Probe(42 + 3 * 148 + 4 + 3, 0, 49, 41.888, 40 * 41.888 / 111.08, which=1),
            Probe(
                42 + 7 * 148 + 145,
                1,
                95,
                111.08 + 93.296,
                40 + 40 * 93.296 / 111.08,
                which=1,
            ),
        ),
        blocks=(42, 148, 8),
        shared=4,
        mode="dual return",
        extra={289: b"\xff"},  # the mount is not set: that of a normal one
    ),
    Case(
        "Airy 48",
        {**AIRY, 31: b"\x31\x01"},
        40,
        0.005,
        (0.01002, 0.04532),
        (0, 468, 756, CENTI),
        (
            Probe(42 + 4 + 12, 0, 4, 7.616, 40 * 7.616 / 111.08),
            Probe(42 + 148 + 4 + 9, 1, 3, 111.08, 40.0),
            Probe(42 + 7 * 148 + 145, 7, 47, 7 * 111.08 + 97.104, 280 + 40 * 97.104 / 111.08),
        ),
        blocks=(42, 148, 8),
    ),
    Case(
        "Ruby 128",
        RUBY,
        20,
        0.005,
        (0.03615, 0.0),
        (1, 468, 852, CENTI),
        (
            Probe(84 + 12, 0, 4, 3.236, 20 * 3.236 / 55.55),
            Probe(84 + 388 + 192, 1, 64, 55.55, 20.0),
            Probe(84 + 776 + 381, 2, 127, 2 * 55.55 + 48.54, 40 + 20 * 48.54 / 55.55),
        ),
        blocks=(80, 388, 3),
        block_id=b"\xfe\x01",
    ),
    Case(
        "Ruby 80",
        RUBY,
        20,
        0.005,
        (0.03615, 0.0),
        (2, 468, 852, CENTI),
        (
            Probe(84 + 9, 0, 3, 3.236, 20 * 3.236 / 55.552),
            Probe(84 + 244 + 120, 1, 40, 55.552, 20.0),
            Probe(84 + 732 + 237, 3, 79, 3 * 55.552 + 48.54, 60 + 20 * 48.54 / 55.552),
        ),
        blocks=FIRST_80,
        block_id=b"\xfe\x01",
    ),
    Case(
        "Ruby 48",
        RUBY,
        20,
        0.005,
        (0.03615, 0.0),
        (1, 468, 852, CENTI),
        (
            Probe(84 + 15, 0, 5, 12.944, 20 * 12.944 / 55.552),
            Probe(84 + 148 + 72, 1, 24, 55.552, 20.0),
            Probe(84 + 7 * 148 + 141, 7, 47, 7 * 55.552 + 48.54, 140 + 20 * 48.54 / 55.552),
        ),
        blocks=FIRST_48,
        block_id=b"\xfe\x01",
        size=1268,
    ),
    Case(
        "Ruby Plus 128",
        PLUS,
        20,
        0.005,
        (0.02892, 0.0),
        (0, 468, 852, CENTI),
        (
            Probe(84 + 12, 0, 4, 1.13, 20 * 1.13 / 55.56),
            Probe(84 + 388 + 192, 1, 64, 55.56 + 21.14, 20 + 20 * 21.14 / 55.56),
            Probe(84 + 776 + 381, 2, 127, 2 * 55.56 + 53.771, 40 + 20 * 53.771 / 55.56),
        ),
        blocks=(80, 388, 3),
        block_id=b"\xfe\x01",
    ),
    Case(
        "Ruby Plus 80",
        PLUS,
        20,
        0.005,
        (0.02892, 0.0),
        (1, 468, 852, CENTI),
        (
            Probe(84 + 30, 0, 10, 3.652, 20 * 3.652 / 55.56),
            Probe(84 + 244 + 219, 1, 73, 55.56 + 42.683, 20 + 20 * 42.683 / 55.56),
            Probe(84 + 732 + 237, 3, 79, 3 * 55.56 + 53.771, 60 + 20 * 53.771 / 55.56),
        ),
        blocks=FIRST_80,
        block_id=b"\xfe\x01",
    ),
    Case(
        "Ruby Plus 80",
        {**PLUS, 7: b"\x03", 31: b"\x05\x03"},  # 80v: the other list of times
        20,
        0.005,
        (0.02892, 0.0),
        (3, 468, 852, CENTI),
        (
            Probe(84 + 30, 0, 10, 2.434, 20 * 2.434 / 55.56),
            Probe(84 + 244 + 219, 0, 73, 29.579, 20 * 29.579 / 55.56, which=1),
            Probe(84 + 732 + 237, 1, 79, 55.56 + 31.963, 20 + 20 * 31.963 / 55.56, which=1),
        ),
        blocks=FIRST_80,
        block_id=b"\xfe\x01",
        shared=2,
        mode="dual return",
    ),
    Case(
        "Ruby Plus 48",
        PLUS,
        20,
        0.005,
        (0.02892, 0.0),
        (2, 468, 852, CENTI),
        (
            Probe(84 + 6, 0, 2, 1.217, 20 * 1.217 / 55.56),
            Probe(84 + 3 * 148 + 60, 3, 20, 3 * 55.56 + 12.907, 60 + 20 * 12.907 / 55.56),
            Probe(84 + 7 * 148 + 141, 7, 47, 7 * 55.56 + 40.666, 140 + 20 * 40.666 / 55.56),
        ),
        blocks=FIRST_48,
        block_id=b"\xfe\x01",
        size=1268,
    ),
)
