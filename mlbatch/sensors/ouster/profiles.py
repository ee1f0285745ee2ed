"""Layout of Ouster packets and of the pixels of every profile.

Source: docs/sources/ouster.md sections 2-4 (ouster-sdk 1.0.1 `parsing.cpp` and the Firmware User
Manual, "Lidar Data"). All integers are little-endian; bits count from bit 0 of a pixel's first
byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

MAX_UDP_PAYLOAD = 65507
LEGACY = "LEGACY"
OFF = "OFF"
STANDARD = "STANDARD"
FUSA = "FUSA"
HEADER_TYPES = (STANDARD, FUSA)

LIDAR_PACKET = 1
IMU_PACKET = 2
ZONE_PACKET = 3
HEADER_SIZE = 32
FOOTER_SIZE = 32
CRC_SIZE = 8

# Section 2: 16 bytes, and 4 bytes of status after the pixels.
LEGACY_COLUMN = np.dtype(
    [("stamp_ns", "<i8"), ("measurement_id", "<u2"), ("frame_id", "<u2"), ("encoder", "<u4")]
)
LEGACY_STATUS = np.dtype("<u4")
# Section 2: 12 bytes.
COLUMN = np.dtype([("stamp_ns", "<i8"), ("measurement_id", "<u2"), ("status", "<u2")])
ENCODER_TICKS = 90112


class Field(NamedTuple):
    """A field of a pixel: `width` bits from `first_bit` on, times 2**shift."""

    first_bit: int
    width: int
    shift: int = 0


class HeaderLayout(NamedTuple):
    """Fields of a packet header as (first byte, bytes)."""

    packet_type: tuple[int, int]
    frame_id: tuple[int, int]
    init_id: tuple[int, int]
    serial: tuple[int, int]
    alert_flags: tuple[int, int]


# Section 2, "Packet header, two layouts"; frame ids of STANDARD wrap at 2**16.
HEADERS: Mapping[str, HeaderLayout] = {
    STANDARD: HeaderLayout((0, 2), (2, 2), (4, 3), (7, 5), (12, 1)),
    FUSA: HeaderLayout((0, 1), (4, 4), (1, 3), (11, 5), (8, 1)),
}


class Profile(NamedTuple):
    """A lidar profile: pixel fields by name; RANGE in mm, 0 for no return."""

    name: str
    pixel_size: int
    fields: Mapping[str, Field]

    @property
    def returns(self) -> int:
        """Returns of a shot; 0 for OFF."""
        return sum(name in self.fields for name in ("RANGE", "RANGE2"))

    @property
    def header(self) -> str:
        """Header type of the profile if the metadata have none."""
        return FUSA if self.name.startswith("FUSA") else STANDARD


class PacketLayout(NamedTuple):
    """Sizes of a lidar packet."""

    profile: Profile
    beams: int
    columns: int

    @property
    def legacy(self) -> bool:
        """Whether packets have neither header nor footer."""
        return self.profile.name == LEGACY

    @property
    def record_start(self) -> int:
        """First byte of the first column."""
        return 0 if self.legacy else HEADER_SIZE

    @property
    def column_header_size(self) -> int:
        """Bytes before the pixels of a column."""
        return LEGACY_COLUMN.itemsize if self.legacy else COLUMN.itemsize

    @property
    def record_size(self) -> int:
        """Bytes of a column."""
        footer = LEGACY_STATUS.itemsize if self.legacy else 0
        return self.column_header_size + self.beams * self.profile.pixel_size + footer

    @property
    def packet_size(self) -> int:
        """Bytes of a packet."""
        footer = 0 if self.legacy else FOOTER_SIZE
        return self.record_start + self.columns * self.record_size + footer


_LOW = {"RANGE": Field(0, 15, 3), "FLAGS": Field(15, 1), "REFLECTIVITY": Field(16, 8)}
_LOW_NIR = _LOW | {"NEAR_IR": Field(24, 8, 4)}
_LOW_DUAL = _LOW_NIR | {
    "RANGE2": Field(32, 15, 3),
    "FLAGS2": Field(47, 1),
    "REFLECTIVITY2": Field(48, 8),
    "WINDOW": Field(56, 8),
}
_RANGE19 = {"RANGE": Field(0, 19), "FLAGS": Field(19, 5)}
_SINGLE = _RANGE19 | {
    "REFLECTIVITY": Field(32, 8),
    "SIGNAL": Field(48, 16),
    "NEAR_IR": Field(64, 16),
}
# Bits 0 to 95 of all profiles with two full returns.
_DUAL = _RANGE19 | {
    "REFLECTIVITY": Field(24, 8),
    "RANGE2": Field(32, 19),
    "FLAGS2": Field(51, 5),
    "REFLECTIVITY2": Field(56, 8),
    "SIGNAL": Field(64, 16),
    "SIGNAL2": Field(80, 16),
}
_LEGACY = {
    "RANGE": Field(0, 20),
    "FLAGS": Field(28, 4),
    "REFLECTIVITY": Field(32, 8),
    "SIGNAL": Field(48, 16),
    "NEAR_IR": Field(64, 16),
}
_RGB = _RANGE19 | {
    "REFLECTIVITY": Field(24, 8),
    "SIGNAL": Field(32, 16),
    "NEAR_IR": Field(48, 16),
    "RED": Field(64, 16),
    "GREEN": Field(80, 16),
    "BLUE": Field(96, 16),
}
_RGB_DUAL = _DUAL | {
    "NEAR_IR": Field(96, 16),
    "RED": Field(112, 16),
    "GREEN": Field(128, 16),
    "BLUE": Field(144, 16),
}
_ZONE_LOW = _LOW_NIR | {"ZONE_MASK": Field(32, 16), "WINDOW": Field(48, 8)}
_ZONE_SINGLE = _SINGLE | {"WINDOW": Field(40, 8), "ZONE_MASK": Field(80, 16)}
_ZONE_DUAL = _DUAL | {"ZONE_MASK": Field(96, 16), "WINDOW": Field(120, 8)}

PROFILES: Mapping[str, Profile] = {
    profile.name: profile
    for profile in (
        Profile(LEGACY, 12, _LEGACY),
        Profile("RNG19_RFL8_SIG16_NIR16", 12, _SINGLE | {"WINDOW": Field(88, 8)}),
        Profile(
            "RNG19_RFL8_SIG16_NIR16_DUAL",
            16,
            _DUAL | {"NEAR_IR": Field(96, 16), "WINDOW": Field(120, 8)},
        ),
        Profile("RNG15_RFL8_NIR8", 4, _LOW_NIR),
        Profile("RNG15_RFL8_WIN8", 4, _LOW | {"WINDOW": Field(24, 8)}),
        Profile("RNG15_RFL8_NIR8_DUAL", 8, _LOW_DUAL),
        Profile("FUSA_RNG15_RFL8_NIR8_DUAL", 8, _LOW_DUAL),
        Profile("RNG15_RFL8_NIR8_ZONE16", 8, _ZONE_LOW),
        Profile("RNG19_RFL8_SIG16_NIR16_ZONE16", 12, _ZONE_SINGLE),
        Profile("RNG19_RFL8_SIG16_ZONE16_DUAL", 16, _ZONE_DUAL),
        Profile("RNG19_RFL8_SIG16_NIR16_RGB16", 16, _RGB),
        Profile("RNG19_RFL8_SIG16_NIR16_RGB16_DUAL", 20, _RGB_DUAL),
        Profile("FIVE_WORD_PIXEL", 20, _DUAL | {"NEAR_IR": Field(96, 16)}),
        Profile(OFF, 0, {}),
    )
}
