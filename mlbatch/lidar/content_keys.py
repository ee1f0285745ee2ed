"""Hashes of the contents of packets, by which repeated ones are found."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U8Array


def content_keys(packets: U8Array) -> I64Array:
    """(P,) hashes >= 0 of packets (P, size).

    The sum of the packet's words times odd numbers, modulo 2**64: a single bit changes it.
    """
    size = packets.shape[1]
    words = size // 8
    # Bytes beyond whole words are hashed as the last eight bytes, which may overlap the words.
    if words and packets.strides[1] == 1:
        keys = np.einsum("ij,j->i", packets[:, : words * 8].view("<u8"), hash_factors(words))
        if size % 8:
            keys = keys * _ODD + packets[:, size - 8 :].view("<u8")[:, 0]
    else:
        keys = np.zeros(len(packets), np.uint64)
        for at in range(size):
            keys = keys * _ODD + packets[:, at]
    keys ^= keys >> np.uint64(29)
    return np.asarray(keys * _ODD >> np.uint64(1), np.int64)


# The golden ratio of 2**64, made odd (Knuth, multiplicative hashing).
_ODD = np.uint64(0x9E3779B97F4A7C15)


@lru_cache(maxsize=16)
def hash_factors(count: int) -> npt.NDArray[np.uint64]:
    """Return the factors of the words of a packet in `content_keys`: (count,) odd numbers."""
    numbers = np.arange(1, count + 1, dtype=np.uint64) * _ODD
    return np.asarray((numbers ^ numbers >> np.uint64(31)) | np.uint64(1), np.uint64)
