"""Reading numbers out of payloads of an unknown stream, (k, size) uint8, a row each.

Source: the byte orders of facts/velodyne.md, facts/hesai.md, facts/robosense.md, facts/others.md.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mlbatch.median import median
from mlbatch.types import BoolArray, F64Array, I64Array, U8Array

# What `discover` and `survey` look for in a description.
NO_DECODER = ": no decoder in this version"
US_PER_MINUTE = 60_000_000
_TICKS_PER_TURN = 36000
_MOST_LOST_TURN = _TICKS_PER_TURN // 2
Order = Literal["<", ">"]


def payload_rows(size: int, sample: U8Array) -> U8Array | None:
    """Payloads (k, size) of a sample (k, >= size) or of a single one; None without any."""
    packets = np.atleast_2d(sample)
    if not packets.size or packets.shape[1] < size:
        return None
    return packets[:, :size]


def number(packets: U8Array, at: int, width: int, order: Order = "<") -> I64Array:
    """(k,) unsigned numbers of `width` bytes at byte `at`; the bytes must be there."""
    places = np.arange(width) if order == "<" else np.arange(width)[::-1]
    shifted: I64Array = packets[:, at : at + width].astype(np.int64) << (8 * places)
    return np.asarray(shifted.sum(axis=1), np.int64)


def has_bytes(packets: U8Array, magic: bytes, at: int = 0) -> BoolArray:
    """(k,) which payloads hold these bytes at byte `at`."""
    if packets.shape[1] < at + len(magic):
        return np.zeros(len(packets), bool)
    same = packets[:, at : at + len(magic)] == np.frombuffer(magic, np.uint8)
    return np.asarray(same.all(axis=1))


def majority(packets: U8Array, good: BoolArray) -> U8Array | None:
    """The good payloads if they are the majority: one damaged packet must not hide a stream."""
    return packets[good] if 2 * int(good.sum()) > len(packets) else None


def most_common(values: I64Array) -> int:
    """The value that occurs most often."""
    found, counts = np.unique(values, return_counts=True)
    return int(found[counts.argmax()])


def block_azimuths(packets: U8Array, begin: int, stride: int, count: int, order: Order) -> I64Array:
    """(k, count) azimuths, 0.01 degree, at bytes 2 and 3 of equal blocks."""
    return np.stack(
        [number(packets, begin + stride * block + 2, 2, order) for block in range(count)], axis=1
    )


def in_pairs(azimuth: I64Array) -> bool:
    """Whether blocks come in pairs of one azimuth, which is how two returns are sent."""
    even = azimuth[:, 0::2]
    odd = azimuth[:, 1::2]
    width = min(even.shape[1], odd.shape[1])
    if width < 2:
        return False
    turning = median((even[:, 1:] - even[:, :-1]) % _TICKS_PER_TURN) > 0
    return bool(turning) and float((even[:, :width] == odd[:, :width]).mean()) > 0.75


def block_time_us(stamp_us: I64Array, azimuth: I64Array, wrap_us: int) -> float | None:
    """Time from azimuth to azimuth of a packet, by the rotor's speed between packets.

    It tells models apart whatever the returns, and though packets are lost; stamp_us: (k,), wraps
    at `wrap_us`; azimuth: (k, blocks), pairs taken as one. None where the rotor seems to rest, or a
    packet has one azimuth.
    """
    if len(stamp_us) < 2:
        return None
    if in_pairs(azimuth):
        azimuth = azimuth[:, 0::2]
    if azimuth.shape[1] < 2:
        return None
    step_us = np.diff(stamp_us) % wrap_us
    turned = np.diff(azimuth[:, 0]) % _TICKS_PER_TURN
    usable = (step_us > 0) & (step_us < US_PER_MINUTE) & (turned > 0) & (turned < _MOST_LOST_TURN)
    if not usable.any():
        return None
    speed = median(turned[usable] / step_us[usable])
    span: F64Array = ((azimuth[:, -1] - azimuth[:, 0]) % _TICKS_PER_TURN).astype(np.float64)
    return float(median(span) / (azimuth.shape[1] - 1) / speed)
