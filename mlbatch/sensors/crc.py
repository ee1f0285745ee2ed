"""CRC-64/XZ of many packets at once.

Source: facts/ouster.md section 2, "Packet footer": reflected polynomial 0xC96C5795D7870F42, start
and final xor all ones. The checksum is linear: with the first eight bytes inverted, the register
after words w0 .. wn is the xor of every word moved over the words behind it. So words are folded in
pairs, a whole level of all packets in one step, and no loop runs over bytes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mlbatch.types import U8Array

U64Array = npt.NDArray[np.uint64]

_POLYNOMIAL = np.uint64(0xC96C5795D7870F42)
_ONES = np.uint64(0xFFFFFFFFFFFFFFFF)
_WORD = 8


def crc64(messages: U8Array) -> U64Array:
    """Checksums (P,) of messages (P, bytes) of one size, eight bytes or more."""
    count, size = messages.shape
    words = 1 << max(0, -(-size // _WORD) - 1).bit_length()
    # Zero words in front move to zero, so they change nothing.
    padded = np.zeros((count, words * _WORD), np.uint8)
    padded[:, -size:] = messages
    first = words * _WORD - size
    padded[:, first : first + _WORD] ^= np.uint8(0xFF)
    folded: U64Array = padded.view("<u8").astype(np.uint64, copy=False)
    level = 0
    while folded.shape[1] > 1:
        folded = _moved(folded[:, 0::2], _mover(level)) ^ folded[:, 1::2]
        level += 1
    result: U64Array = _moved(folded[:, 0], _mover(0)) ^ _ONES
    return result


@lru_cache(maxsize=32)
def _mover(level: int) -> U64Array:
    """Tables (8, 256) that move a register over 2**level words: one table for each of its bytes."""
    values = np.arange(256, dtype=np.uint64)[None, :]
    positions = np.arange(_WORD, dtype=np.uint64)[:, None] * np.uint64(8)
    table: U64Array = values << positions
    if level:
        half = _mover(level - 1)
        return _moved(_moved(table, half), half)
    one = np.uint64(1)
    for _ in range(_WORD * 8):
        table = (table >> one) ^ ((table & one) * _POLYNOMIAL)
    return table


def _moved(registers: U64Array, tables: U64Array) -> U64Array:
    moved: U64Array = tables[0][registers & np.uint64(0xFF)]
    for byte in range(1, _WORD):
        moved ^= tables[byte][(registers >> np.uint64(8 * byte)) & np.uint64(0xFF)]
    return moved
