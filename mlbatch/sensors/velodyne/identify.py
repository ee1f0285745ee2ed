"""Names of Velodyne packets and of those that look like them, by content.

Source: facts/velodyne.md sections 1, 2 and 8; facts/others.md (LSLIDAR).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mlbatch.sensors.packet_bytes import (
    NO_DECODER,
    block_azimuths,
    block_time_us,
    in_pairs,
    mostly,
    number,
    starts,
    usual,
)
from mlbatch.types import BoolArray, I64Array, U8Array

BLOCKS, STRIDE, BLOCK_LASERS = 12, 100, 32
PACKET_SIZE, POSITION_SIZE = 1206, 512
STAMP_AT, MODE_AT = 1200, 1204
NMEA_AT, NMEA_SIZE, PPS_AT, POSITION_STAMP_AT = 206, 128, 202, 198
HOUR_US = 3_600_000_000
TURN_CDEG = 36000
# Block flags as numbers; a sequence takes a block of each bank.
BANK_FLAGS = {1: (0xEEFF,), 2: (0xEEFF, 0xDDFF), 4: (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)}
DUAL = "dual return"
UNSET_MODES = ("single return", DUAL)
MODES = {0x37: "strongest return", 0x38: "last return", 0x39: DUAL}
HDL_64E, VLS_128 = "HDL-64E", "VLS-128"
_LSLIDAR_SIZE = 1212
_TIME_TOLERANCE = 0.05
_DEVICE_MAGIC = bytes.fromhex("a5ff005a")


@dataclass(frozen=True, slots=True)
class _Product:
    """A model by its product byte; block_us: time from block to block, 0 where it varies."""

    name: str
    block_us: float = 0.0
    is_decoded: bool = True


_PRODUCTS = {
    0x21: _Product("HDL-32E", 46.080),
    0x22: _Product("VLP-16", 110.592),
    0x23: _Product("VLP-32A/B", is_decoded=False),
    0x24: _Product("Puck Hi-Res", 110.592),
    0x28: _Product("VLP-32C", 55.296),
    0x31: _Product("Velarray", is_decoded=False),
}
# What a product byte may hide: only seen, or said of, the oldest models.
_OLDEST = (0x22, 0x21)


@dataclass(frozen=True, slots=True)
class Identity:
    """What data packets are by their bytes and by their pace.

    model: "" where they do not say; banks: blocks that a firing sequence takes; label: the model
    that a wrong product byte names, or what else is odd about the factory bytes; block_us: time
    from block to block, None where it was not measured.
    """

    model: str
    mode: str
    banks: int
    label: str = ""
    is_decoded: bool = True
    block_us: float | None = None

    @property
    def returns(self) -> int:
        """Returns of each shot."""
        return 2 if self.mode == DUAL else 1


def identify(size: int, packets: U8Array) -> Identity | None:
    """What payloads (k, size) are, if most of them are data packets of Velodyne's form."""
    if size != PACKET_SIZE or packets.shape[1] < size or not len(packets):
        return None
    flags = block_flags(packets)
    azimuth = block_azimuths(packets, 0, STRIDE, BLOCKS, "<")
    one_bank = (flags == BANK_FLAGS[1][0]).all(axis=1) & (azimuth < TURN_CDEG).all(axis=1)
    return (
        _four_banks(packets, flags, azimuth)
        or _two_banks(packets, flags, azimuth)
        or _one_bank(mostly(packets, one_bank & _within_the_hour(packets)))
    )


def velodyne(size: int, packets: U8Array) -> str | None:
    """A line on Velodyne packets and their look-alikes, or None."""
    if size == POSITION_SIZE and mostly(packets, are_positions(packets)) is not None:
        return "Velodyne position packet"
    if size not in (PACKET_SIZE, _LSLIDAR_SIZE):
        return None
    if mostly(packets, starts(packets, _DEVICE_MAGIC)) is not None:
        return "LSLIDAR device packet"
    if size == _LSLIDAR_SIZE:
        azimuth = block_azimuths(packets, 0, STRIDE, BLOCKS, "<")
        alike = (block_flags(packets) == BANK_FLAGS[1][0]) & (azimuth < TURN_CDEG)
        look_alike = mostly(packets, alike.all(axis=1)) is not None
        return f"LSLIDAR-like, {size} bytes: not supported" if look_alike else None
    seen = identify(size, packets)
    if seen is None:
        return None
    if not seen.model:
        return f"Velodyne-like lidar, {seen.label}{NO_DECODER}"
    name = f"{seen.model} ({seen.label})" if seen.label else seen.model
    return f"Velodyne lidar {name}, {seen.mode}{'' if seen.is_decoded else NO_DECODER}"


def are_positions(packets: U8Array) -> BoolArray:
    """Which packets (k, 512) hold an NMEA sentence, or none yet, and a stamp within the hour."""
    nmea = packets[:, NMEA_AT : NMEA_AT + NMEA_SIZE]
    stamp_us = number(packets, POSITION_STAMP_AT, 4)
    silent = (nmea == 0).all(axis=1) & (packets[:, :14] == 0).all(axis=1) & (stamp_us > 0)
    good = (starts(packets, b"$GP", NMEA_AT) | silent) & (stamp_us < HOUR_US)
    return np.asarray(good & (packets[:, PPS_AT] <= 3))


def block_flags(packets: U8Array) -> I64Array:
    """(k, blocks) flags of the blocks."""
    return np.stack([number(packets, STRIDE * n, 2) for n in range(BLOCKS)], axis=1)


@lru_cache(maxsize=8)
def expected_flags(banks: int, returns: int) -> I64Array:
    """Flags of the blocks that a packet uses, which may be fewer than it has.

    HDL-64E sends the second return after both banks of the first; VLS-128 bank by bank.
    """
    flags = np.array(BANK_FLAGS[banks], np.int64)
    group = flags.repeat(returns) if banks == 4 else np.tile(flags, returns)
    return np.tile(group, BLOCKS // len(group))


def _within_the_hour(packets: U8Array) -> BoolArray:
    return number(packets, STAMP_AT, 4) < HOUR_US


def _four_banks(packets: U8Array, flags: I64Array, azimuth: I64Array) -> Identity | None:
    """VLS-128: four banks a sequence, each twice (and four blocks unused) with two returns."""
    for returns in (1, 2):
        wanted = expected_flags(4, returns)
        used = len(wanted)
        good = (flags[:, :used] == wanted).all(axis=1)
        good &= (azimuth[:, :used] < TURN_CDEG).all(axis=1) & _within_the_hour(packets)
        chosen = mostly(packets, good)
        if chosen is not None:
            mode = MODES.get(usual(number(chosen, MODE_AT, 1)), "")
            is_told = mode != "" and (mode == DUAL) == (returns == 2)
            return Identity(VLS_128, mode if is_told else UNSET_MODES[returns - 1], banks=4)
    return None


def _two_banks(packets: U8Array, flags: I64Array, azimuth: I64Array) -> Identity | None:
    """HDL-64E: upper and lower block in turn; two returns are told by four equal azimuths."""
    good = (flags == expected_flags(2, 1)).all(axis=1)
    good &= (azimuth < TURN_CDEG).all(axis=1)
    if mostly(packets, good) is None:
        return None
    return Identity(HDL_64E, UNSET_MODES[in_pairs(azimuth[good][:, 0::2])], banks=2)


def _one_bank(packets: U8Array | None) -> Identity | None:
    """Models whose blocks all bear one flag: by the factory bytes, and by what belies them."""
    if packets is None:
        return None
    factory = usual(number(packets, MODE_AT, 2))
    azimuth = block_azimuths(packets, 0, STRIDE, BLOCKS, "<")
    took_us = block_time_us(number(packets, STAMP_AT, 4), azimuth, HOUR_US)
    told = _PRODUCTS.get(factory >> 8)
    mode = MODES.get(factory & 0xFF, UNSET_MODES[in_pairs(azimuth)])
    seen = next((n for n in _OLDEST if takes(_PRODUCTS[n].block_us, took_us)), None)
    if factory == 0 and seen is not None:
        unset = "its factory bytes are not set"
        return Identity(_PRODUCTS[seen].name, mode, 1, unset, block_us=took_us)
    if told is None or factory & 0xFF not in MODES:
        label = f"factory bytes {factory & 0xFF:02X} {factory >> 8:02X}"
        return Identity("", mode, 1, label, is_decoded=False, block_us=took_us)
    if factory >> 8 in _OLDEST and seen is not None and seen != factory >> 8:
        belied = f"its product byte says {told.name}"
        return Identity(_PRODUCTS[seen].name, mode, 1, belied, block_us=took_us)
    return Identity(told.name, mode, 1, is_decoded=told.is_decoded, block_us=took_us)


def takes(block_us: float, took_us: float | None) -> bool:
    """Whether a block took as long as those of a model do, as far as that was measured."""
    return took_us is not None and abs(took_us - block_us) < _TIME_TOLERANCE * block_us
