"""CRC-32/MPEG-2 of many messages at once.

Source: facts/hesai.md section 7: polynomial 04C11DB7, start all ones, no reflection, no final xor.
The checksum is linear: it is the xor of what every byte alone, followed by zeros, would give; all
ones at the start are the same as the first four bytes inverted.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mlbatch.types import U8Array, U32Array

_POLYNOMIAL = np.uint32(0x04C11DB7)
_TOP = np.uint32(0x80000000)
_START_BYTES = 4
_ROWS = 256


def crc32(messages: U8Array) -> U32Array:
    """Checksums (P,) of messages (P, bytes) of one size, four bytes or more."""
    count, size = messages.shape
    table, place = _contributions(size), np.arange(size) << 8
    sums = np.empty(count, np.uint32)
    # A few rows at a time, so that what is looked up stays in the caches.
    for begin in range(0, count, _ROWS):
        rows = messages[begin : begin + _ROWS].astype(np.intp)
        rows[:, :_START_BYTES] ^= 0xFF
        rows += place
        np.bitwise_xor.reduce(table[rows], axis=1, out=sums[begin : begin + _ROWS])
    return sums


@lru_cache(maxsize=16)
def _contributions(size: int) -> npt.NDArray[np.uint32]:
    """What each byte value at each place of a message gives: (size * 256,)."""
    table = np.empty((size, 256), np.uint32)
    last = np.arange(256, dtype=np.uint32) << np.uint32(24)
    for _ in range(8):
        last = (last << np.uint32(1)) ^ np.where(last & _TOP, _POLYNOMIAL, np.uint32(0))
    table[-1] = last
    for place in range(size - 2, -1, -1):
        after = table[place + 1]
        table[place] = (after << np.uint32(8)) ^ last[after >> np.uint32(24)]
    return table.reshape(-1)
