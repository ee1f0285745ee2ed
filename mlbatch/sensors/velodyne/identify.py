"""Names of Velodyne packets and look-alikes by content.

Source: docs/sources/velodyne.md sections 1, 2 and 8; docs/sources/others.md (LSLIDAR).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.sensors.packet_bytes import (
    NO_DECODER,
    block_azimuths,
    block_time_us,
    has_bytes,
    in_pairs,
    majority,
    most_common,
    number,
    payload_rows,
)
from mlbatch.sensors.velodyne.clock import HOUR_US, POSITION_SIZE, are_positions
from mlbatch.sensors.velodyne.models import (
    ALL,
    BANK_FLAGS,
    BLOCKS,
    CIRCLE_CDEG,
    DUAL,
    HDL_32E,
    HDL_64E,
    MODE_AT,
    MODES,
    PACKET_SIZE,
    STAMP_AT,
    STRIDE,
    UNSET_MODES,
    VLP_16,
    VLS_128,
    expected_flags,
)

_LSLIDAR_SIZE = 1212
_TIME_TOLERANCE = 0.05
_DEVICE_MAGIC = bytes.fromhex("a5ff005a")


_PRODUCTS = {row.product: row.reported_as for row in ALL if row.product is not None}
_UNDECODED = {0x23: "VLP-32A/B", 0x31: "Velarray"}
# Wrong product bytes are known only of the oldest models, which are identified by their pace.
_OLDEST = (VLP_16, HDL_32E)


@dataclass(frozen=True, slots=True)
class Identity:
    """Model and mode of data packets by their bytes and their pace.

    model: "" if unknown.
    banks: blocks of a firing sequence.
    label: remark on factory bytes that are wrong or unset.
    block_us: time from block to block, None if it was not measured.
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
    """Identify payloads (k, size); None unless most of them are Velodyne data packets."""
    if size != PACKET_SIZE or packets.shape[1] < size or not len(packets):
        return None
    flags = block_flags(packets)
    azimuth = block_azimuths(packets, 0, STRIDE, BLOCKS, "<")
    one_bank = (flags == BANK_FLAGS[1][0]).all(axis=1) & (azimuth <= CIRCLE_CDEG).all(axis=1)
    return (
        _four_banks(packets, flags, azimuth)
        or _two_banks(packets, flags, azimuth)
        or _one_bank(majority(packets, one_bank & _within_the_hour(packets)))
    )


def describe(size: int, sample: U8Array) -> str | None:
    """Name payloads (k, size); None if they are neither Velodyne's nor look-alikes."""
    packets = payload_rows(size, sample)
    if packets is None:
        return None
    if size == POSITION_SIZE and majority(packets, are_positions(packets)) is not None:
        return "Velodyne position packet"
    if size not in (PACKET_SIZE, _LSLIDAR_SIZE):
        return None
    if majority(packets, has_bytes(packets, _DEVICE_MAGIC)) is not None:
        return "LSLIDAR device packet"
    if size == _LSLIDAR_SIZE:
        azimuth = block_azimuths(packets, 0, STRIDE, BLOCKS, "<")
        alike = (block_flags(packets) == BANK_FLAGS[1][0]) & (azimuth <= CIRCLE_CDEG)
        look_alike = majority(packets, alike.all(axis=1)) is not None
        return f"LSLIDAR-like, {size} bytes: not supported" if look_alike else None
    seen = identify(size, packets)
    if seen is None:
        return None
    if not seen.model:
        return f"Velodyne-like lidar, {seen.label}{NO_DECODER}"
    name = f"{seen.model} ({seen.label})" if seen.label else seen.model
    return f"Velodyne lidar {name}, {seen.mode}{'' if seen.is_decoded else NO_DECODER}"


def block_flags(packets: U8Array) -> I64Array:
    """(k, blocks) block flags."""
    return np.stack([number(packets, STRIDE * n, 2) for n in range(BLOCKS)], axis=1)


def _within_the_hour(packets: U8Array) -> BoolArray:
    return number(packets, STAMP_AT, 4) < HOUR_US


def _four_banks(packets: U8Array, flags: I64Array, azimuth: I64Array) -> Identity | None:
    """VLS-128: four banks a sequence, each twice (and four blocks unused) with two returns."""
    for returns in (1, 2):
        expected = expected_flags(4, returns)
        used = len(expected)
        good = (flags[:, :used] == expected).all(axis=1)
        good &= (azimuth[:, :used] <= CIRCLE_CDEG).all(axis=1) & _within_the_hour(packets)
        chosen = majority(packets, good)
        if chosen is not None:
            mode = MODES.get(most_common(number(chosen, MODE_AT, 1)), "")
            is_known = mode != "" and (mode == DUAL) == (returns == 2)
            return Identity(VLS_128, mode if is_known else UNSET_MODES[returns - 1], banks=4)
    return None


def _two_banks(packets: U8Array, flags: I64Array, azimuth: I64Array) -> Identity | None:
    """HDL-64E: alternating upper and lower blocks; dual returns have four equal azimuths."""
    good = (flags == expected_flags(2, 1)).all(axis=1)
    good &= (azimuth <= CIRCLE_CDEG).all(axis=1)
    if majority(packets, good) is None:
        return None
    return Identity(HDL_64E, UNSET_MODES[in_pairs(azimuth[good][:, 0::2])], banks=2)


def _one_bank(packets: U8Array | None) -> Identity | None:
    """Models with a single block flag: by factory bytes, corrected by their pace."""
    if packets is None:
        return None
    factory = most_common(number(packets, MODE_AT, 2))
    azimuth = block_azimuths(packets, 0, STRIDE, BLOCKS, "<")
    took_us = block_time_us(number(packets, STAMP_AT, 4), azimuth, HOUR_US)
    product = factory >> 8
    name = _PRODUCTS.get(product) or _UNDECODED.get(product)
    mode = MODES.get(factory & 0xFF, UNSET_MODES[in_pairs(azimuth)])
    seen = next((row for row in _OLDEST if is_pace(row.block_us, took_us)), None)
    if factory == 0 and seen is not None:
        unset = "its factory bytes are not set"
        return Identity(seen.reported_as, mode, 1, unset, block_us=took_us)
    if name is None or factory & 0xFF not in MODES:
        label = f"factory bytes {factory & 0xFF:02X} {product:02X}"
        return Identity("", mode, 1, label, is_decoded=False, block_us=took_us)
    may_be_wrong = product in {row.product for row in _OLDEST}
    if seen is not None and may_be_wrong and seen.product != product:
        label = f"its product byte says {name}"
        return Identity(seen.reported_as, mode, 1, label, block_us=took_us)
    return Identity(name, mode, 1, is_decoded=product in _PRODUCTS, block_us=took_us)


def is_pace(block_us: float, took_us: float | None) -> bool:
    """Whether a measured block time fits a model's."""
    return took_us is not None and abs(took_us - block_us) < _TIME_TOLERANCE * block_us
