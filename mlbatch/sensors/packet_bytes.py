"""Numbers and patterns in payloads of an unknown stream, (k, size) uint8.

Source: the byte orders of docs/sources/velodyne.md, docs/sources/hesai.md,
docs/sources/robosense.md, docs/sources/others.md.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array, median

# Discovery searches descriptions for this text.
NO_DECODER = ": no decoder in this version"
US_PER_MINUTE = 60_000_000
_TICKS_PER_REVOLUTION = 36000
_MAX_LOST_ANGLE = _TICKS_PER_REVOLUTION // 2
Order = Literal["<", ">"]
_ORDERS: tuple[Order, ...] = ("<", ">")
_WORDS = {
    (width, order): np.dtype(f"{order}u{width}") for width in (1, 2, 4, 8) for order in _ORDERS
}


def payload_rows(size: int, sample: U8Array) -> U8Array | None:
    """Payloads (k, size) of a sample (k, >= size) or of a single one; None without any."""
    packets = np.atleast_2d(sample)
    if not packets.size or packets.shape[1] < size:
        return None
    return packets[:, :size]


def number(packets: U8Array, at: int, width: int, order: Order = "<") -> I64Array:
    """(k,) unsigned numbers of `width` bytes at byte `at`, which must be within the payloads."""
    part = packets[:, at : at + width]
    word = _WORDS.get((width, order))
    if word is not None:
        return np.ascontiguousarray(part).view(word)[:, 0].astype(np.int64)
    shifts = np.arange(width) if order == "<" else np.arange(width)[::-1]
    shifted: I64Array = part.astype(np.int64) << (8 * shifts)
    return np.asarray(shifted.sum(axis=1), np.int64)


def has_bytes(packets: U8Array, magic: bytes, at: int = 0) -> BoolArray:
    """(k,) whether payloads have these bytes at byte `at`."""
    if packets.shape[1] < at + len(magic):
        return np.zeros(len(packets), bool)
    same = packets[:, at : at + len(magic)] == np.frombuffer(magic, np.uint8)
    return np.asarray(same.all(axis=1))


def any_has_bytes(sample: U8Array, magic: bytes, at: int = 0) -> bool:
    """Whether one of the payloads (k, size), or a single one, has these bytes at byte `at`."""
    return bool(has_bytes(np.atleast_2d(sample), magic, at).any())


def majority(packets: U8Array, good: BoolArray) -> U8Array | None:
    """The good payloads if they are more than half: a damaged packet must not hide a stream."""
    return packets[good] if 2 * int(good.sum()) > len(packets) else None


def most_common(values: I64Array) -> int:
    """The most frequent value."""
    distinct, counts = np.unique(values, return_counts=True)
    return int(distinct[counts.argmax()])


def block_azimuths(packets: U8Array, begin: int, stride: int, count: int, order: Order) -> I64Array:
    """(k, count) azimuths, 0.01 degree, at bytes 2 and 3 of equal blocks."""
    at = begin + 2 + stride * np.arange(count)[:, None] + np.arange(2)
    pairs: U8Array = packets[:, at]
    return np.ascontiguousarray(pairs).view(_WORDS[2, order])[:, :, 0].astype(np.int64)


def in_pairs(azimuth: I64Array) -> bool:
    """Whether blocks come in pairs of equal azimuth, as dual returns are sent."""
    even = azimuth[:, 0::2]
    odd = azimuth[:, 1::2]
    width = min(even.shape[1], odd.shape[1])
    if width < 2:
        return False
    step = median((even[:, 1:] - even[:, :-1]) % _TICKS_PER_REVOLUTION) > 0
    return bool(step) and float((even[:, :width] == odd[:, :width]).mean()) > 0.75


def block_time_us(stamp_us: I64Array, azimuth: I64Array, wrap_us: int) -> float | None:
    """Time from azimuth to azimuth within a packet, by the rotor speed between packets.

    Distinguishes models in all return modes, and in spite of lost packets. stamp_us: (k,), wraps
    at `wrap_us`; azimuth: (k, blocks), equal pairs count once. None if the rotor rests, or if a
    packet has a single azimuth.
    """
    if len(stamp_us) < 2:
        return None
    if in_pairs(azimuth):
        azimuth = azimuth[:, 0::2]
    if azimuth.shape[1] < 2:
        return None
    step_us = np.diff(stamp_us) % wrap_us
    turned = np.diff(azimuth[:, 0]) % _TICKS_PER_REVOLUTION
    usable = (step_us > 0) & (step_us < US_PER_MINUTE) & (turned > 0) & (turned < _MAX_LOST_ANGLE)
    if not usable.any():
        return None
    speed = median(turned[usable] / step_us[usable])
    span: F64Array = ((azimuth[:, -1] - azimuth[:, 0]) % _TICKS_PER_REVOLUTION).astype(np.float64)
    return float(median(span) / (azimuth.shape[1] - 1) / speed)
