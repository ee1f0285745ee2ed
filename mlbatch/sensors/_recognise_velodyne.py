"""Names of Velodyne packets and of those that look like them, by content.

Source: facts/velodyne.md sections 1, 2 and 8; facts/others.md (LSLIDAR).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.sensors._recognise_bytes import (
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

_BLOCKS, _STRIDE = 12, 100
_SIZE, _POSITION_SIZE, _LSLIDAR_SIZE = 1206, 512, 1212
_STAMP_AT, _MODE_AT, _PRODUCT_AT = 1200, 1204, 1205
_HOUR_US = 3_600_000_000
_TURN_CDEG = 36000
_RETURNS = {0x37: "strongest return", 0x38: "last return", 0x39: "dual return"}
# Block flags, as they lie on the wire.
_EE, _DD, _CC, _BB = 0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF
_BANKS = (_EE, _DD, _CC, _BB)
_TIME_TOLERANCE = 0.05
_NMEA_AT, _NMEA_SIZE, _PPS_AT, _POSITION_STAMP_AT = 206, 128, 202, 198
_DEVICE_MAGIC = bytes.fromhex("a5ff005a")


@dataclass(frozen=True, slots=True)
class _Product:
    """A model by its product byte; block_us: time from block to block, 0 where it varies."""

    name: str
    block_us: float = 0.0


_PRODUCTS = {
    0x21: _Product("HDL-32E", 46.080),
    0x22: _Product("VLP-16", 110.592),
    0x23: _Product("VLP-32A/B"),
    0x24: _Product("Puck Hi-Res", 110.592),
    0x28: _Product("VLP-32C", 55.296),
    0x31: _Product("Velarray"),
    0xA1: _Product("VLS-128"),
}
_VLS_128 = 0xA1
# What a product byte may hide: only seen, or said of, the oldest models.
_OLDEST = (0x22, 0x21)


def velodyne(size: int, packets: U8Array) -> str | None:
    """A line on Velodyne packets and their look-alikes, or None."""
    if size == _POSITION_SIZE and _mostly_positions(packets):
        return "Velodyne position packet"
    if (
        size in (_SIZE, _LSLIDAR_SIZE)
        and mostly(packets, starts(packets, _DEVICE_MAGIC)) is not None
    ):
        return "LSLIDAR device packet"
    if size not in (_SIZE, _LSLIDAR_SIZE):
        return None
    flags = _flags(packets)
    azimuth = block_azimuths(packets, 0, _STRIDE, _BLOCKS, "<")
    one_bank = (flags == _EE).all(axis=1) & (azimuth < _TURN_CDEG).all(axis=1)
    if size == _LSLIDAR_SIZE:
        look_alike = mostly(packets, one_bank) is not None
        return f"LSLIDAR-like, {size} bytes: not supported" if look_alike else None
    return (
        _describe_banks(packets, flags, azimuth)
        or _describe_hdl64(packets, flags, azimuth)
        or _describe_one_bank(mostly(packets, one_bank & _within_the_hour(packets)))
    )


def _flags(packets: U8Array) -> I64Array:
    """(k, blocks) flags of the blocks."""
    return np.stack([number(packets, _STRIDE * n, 2) for n in range(_BLOCKS)], axis=1)


def _within_the_hour(packets: U8Array) -> BoolArray:
    return number(packets, _STAMP_AT, 4) < _HOUR_US


def _describe_banks(packets: U8Array, flags: I64Array, azimuth: I64Array) -> str | None:
    """VLS-128: four banks a sequence, each twice (and four blocks unused) with two returns."""
    for returns, used in ((1, _BLOCKS), (2, 8)):
        wanted = np.resize(np.repeat(_BANKS, returns), used)
        good = (flags[:, :used] == wanted).all(axis=1)
        good &= (azimuth[:, :used] < _TURN_CDEG).all(axis=1) & _within_the_hour(packets)
        chosen = mostly(packets, good)
        if chosen is not None:
            mode = _RETURNS.get(usual(number(chosen, _MODE_AT, 1)), ("single", "dual")[returns - 1])
            return _lidar(_PRODUCTS[_VLS_128].name, mode)
    return None


def _describe_hdl64(packets: U8Array, flags: I64Array, azimuth: I64Array) -> str | None:
    """HDL-64E: upper and lower block in turn; two returns are told by four equal azimuths."""
    good = (flags == np.resize((_EE, _DD), _BLOCKS)).all(axis=1)
    good &= (azimuth < _TURN_CDEG).all(axis=1)
    if mostly(packets, good) is None:
        return None
    return _lidar("HDL-64E", "dual return" if in_pairs(azimuth[good][:, 0::2]) else "single return")


def _describe_one_bank(packets: U8Array | None) -> str | None:
    """Models whose blocks all bear one flag: by the factory bytes, and by what belies them."""
    if packets is None:
        return None
    factory = usual(number(packets, _MODE_AT, 2))
    mode, product = factory & 0xFF, factory >> 8
    azimuth = block_azimuths(packets, 0, _STRIDE, _BLOCKS, "<")
    took_us = block_time_us(number(packets, _STAMP_AT, 4), azimuth, _HOUR_US)
    told = _PRODUCTS.get(product)
    seen = next((n for n in _OLDEST if _takes(_PRODUCTS[n].block_us, took_us)), None)
    if factory == 0 and seen is not None:
        returns = "dual return" if in_pairs(azimuth) else "single return"
        return _lidar(f"{_PRODUCTS[seen].name} (its factory bytes are not set)", returns)
    if told is None or mode not in _RETURNS:
        return f"Velodyne-like lidar, factory bytes {mode:02X} {product:02X}{NO_DECODER}"
    belied = product in _OLDEST and seen is not None and seen != product
    if belied and seen is not None:
        name = f"{_PRODUCTS[seen].name} (its product byte says {told.name})"
        return _lidar(name, _RETURNS[mode])
    return _lidar(told.name, _RETURNS[mode])


def _takes(block_us: float, took_us: float | None) -> bool:
    return took_us is not None and abs(took_us - block_us) < _TIME_TOLERANCE * block_us


def _lidar(model: str, mode: str) -> str:
    return f"Velodyne lidar {model}, {mode}{NO_DECODER}"


def _mostly_positions(packets: U8Array) -> bool:
    """Position packets: an NMEA sentence, or none yet, behind a stamp within the hour."""
    nmea = packets[:, _NMEA_AT : _NMEA_AT + _NMEA_SIZE]
    stamp_us = number(packets, _POSITION_STAMP_AT, 4)
    silent = (nmea == 0).all(axis=1) & (packets[:, :14] == 0).all(axis=1) & (stamp_us > 0)
    good = (starts(packets, b"$GP", _NMEA_AT) | silent) & (stamp_us < _HOUR_US)
    return mostly(packets, good & (packets[:, _PPS_AT] <= 3)) is not None
