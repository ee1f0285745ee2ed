"""CRC-64/XZ and CRC-32/MPEG-2 of many packets at once.

CRC-64: docs/sources/ouster.md section 2, "Packet footer": reflected polynomial 0xC96C5795D7870F42,
start and final xor all ones. The checksum is linear: with the first eight bytes inverted, the
register after words w0 .. wn is the xor of every word shifted over the words after it. So words are
folded in pairs, one level of all packets per step, without a loop over bytes.

CRC-32: docs/sources/hesai.md section 7: polynomial 04C11DB7, start all ones, no reflection, no
final xor. Also linear: the xor of the checksums of every byte alone, followed by zeros; a start of
all ones equals inverting the first four bytes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import U8Array, U32Array

U64Array = npt.NDArray[np.uint64]

_POLYNOMIAL64 = np.uint64(0xC96C5795D7870F42)
_ONES = np.uint64(0xFFFFFFFFFFFFFFFF)
_WORD = 8


def crc64(messages: U8Array) -> U64Array:
    """Checksums (P,) of messages (P, bytes) of one size, eight bytes or more."""
    count, size = messages.shape
    words = 1 << max(0, -(-size // _WORD) - 1).bit_length()
    # Leading zero words shift to zero and change nothing.
    padded = np.zeros((count, words * _WORD), np.uint8)
    padded[:, -size:] = messages
    first = words * _WORD - size
    padded[:, first : first + _WORD] ^= np.uint8(0xFF)
    folded: U64Array = padded.view("<u8").astype(np.uint64, copy=False)
    level = 0
    while folded.shape[1] > 1:
        folded = _shifted(folded[:, 0::2], _shift_tables(level)) ^ folded[:, 1::2]
        level += 1
    result: U64Array = _shifted(folded[:, 0], _shift_tables(0)) ^ _ONES
    return result


@lru_cache(maxsize=32)
def _shift_tables(level: int) -> U64Array:
    """Tables (8, 256), one per byte of the register, that shift it over 2**level words."""
    values = np.arange(256, dtype=np.uint64)[None, :]
    positions = np.arange(_WORD, dtype=np.uint64)[:, None] * np.uint64(8)
    table: U64Array = values << positions
    if level:
        half = _shift_tables(level - 1)
        return _shifted(_shifted(table, half), half)
    one = np.uint64(1)
    for _ in range(_WORD * 8):
        table = (table >> one) ^ ((table & one) * _POLYNOMIAL64)
    return table


def _shifted(registers: U64Array, tables: U64Array) -> U64Array:
    moved: U64Array = tables[0][registers & np.uint64(0xFF)]
    for byte in range(1, _WORD):
        moved ^= tables[byte][(registers >> np.uint64(8 * byte)) & np.uint64(0xFF)]
    return moved


_POLYNOMIAL32 = np.uint32(0x04C11DB7)
_TOP = np.uint32(0x80000000)
_START_BYTES = 4
_ROWS = 256


def crc32(messages: U8Array) -> U32Array:
    """Checksums (P,) of messages (P, bytes) of one size, four bytes or more."""
    count, size = messages.shape
    table = _contributions(size)
    place = np.arange(size) << 8
    sums = np.empty(count, np.uint32)
    # A few rows at a time, so that the lookups stay in the caches.
    for begin in range(0, count, _ROWS):
        rows = messages[begin : begin + _ROWS].astype(np.intp)
        rows[:, :_START_BYTES] ^= 0xFF
        rows += place
        np.bitwise_xor.reduce(table[rows], axis=1, out=sums[begin : begin + _ROWS])
    return sums


@lru_cache(maxsize=16)
def _contributions(size: int) -> npt.NDArray[np.uint32]:
    """(size * 256,) checksum of each byte value at each position of a message."""
    table = np.empty((size, 256), np.uint32)
    last = np.arange(256, dtype=np.uint32) << np.uint32(24)
    for _ in range(8):
        last = (last << np.uint32(1)) ^ np.where(last & _TOP, _POLYNOMIAL32, np.uint32(0))
    table[-1] = last
    for place in range(size - 2, -1, -1):
        after = table[place + 1]
        table[place] = (after << np.uint32(8)) ^ last[after >> np.uint32(24)]
    return table.reshape(-1)
