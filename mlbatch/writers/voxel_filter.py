"""The first point in each voxel of a map, in constant memory.

Voxels are bits in blocks of 32 x 32 x 32, 4 KB each, in a temporary file that is mapped into
memory: a scan touches the blocks in the range of its lidars, the system keeps the others on the
disk. Memory that grows is 16 bytes per block.
"""

from __future__ import annotations

import mmap
import tempfile
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array, U8Array

# Bits of a coordinate in a block; its bytes: one bit per voxel.
_SHIFT = 5
_BLOCK_BYTES = 1 << (3 * _SHIFT - 3)
# Blocks are numbered by this many bits per axis, around the origin of the map.
_AXIS_BITS = 21
MOST_VOXELS = 1 << (_AXIS_BITS - 1 + _SHIFT)
# The file grows by so many blocks; after so many scans all pages are unmapped, so that only those
# of the last scans count as memory.
_GROWTH = 4096
_SCANS = 64


class VoxelFilter:
    """Remembers which voxels have a point."""

    def __init__(self, edge: int, folder: Path) -> None:
        """edge: of a voxel, in units of the coordinates; folder: of the temporary file."""
        self._edge = edge
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 closed by `close`
        # Numbers of blocks, increasing, and their places in the file.
        self._keys: I64Array = np.zeros(0, np.int64)
        self._places: I64Array = np.zeros(0, np.int64)
        self._capacity = 0
        self._map: mmap.mmap | None = None
        self._scans = 0

    def first(self, units: I64Array) -> I64Array:
        """Return the indexes, increasing, of the points that are the first in their voxel so far.

        units: (n, 3) coordinates, less than MOST_VOXELS voxels from the origin. OSError where the
        disk is full.
        """
        if not len(units):
            return np.zeros(0, np.int64)
        cells = units // self._edge
        x, y, z = ((cells >> _SHIFT) + (1 << (_AXIS_BITS - 1))).T
        keys, block = np.unique(
            (x << (2 * _AXIS_BITS)) | (y << _AXIS_BITS) | z, return_inverse=True
        )
        a, b, c = (cells & ((1 << _SHIFT) - 1)).T
        bit = (a << (2 * _SHIFT)) | (b << _SHIFT) | c
        voxels, first = np.unique(
            (self._places_of(keys)[block] << (3 * _SHIFT)) | bit, return_index=True
        )
        bits = self._bits()
        mask = np.left_shift(1, voxels & 7).astype(np.uint8)
        is_new = (bits[voxels >> 3] & mask) == 0
        voxels, mask, first = voxels[is_new], mask[is_new], first[is_new]
        if len(voxels):
            place = voxels >> 3
            begin = np.flatnonzero(np.concatenate([[True], place[1:] != place[:-1]]))
            bits[place[begin]] |= np.bitwise_or.reduceat(mask, begin)
        return np.sort(first)

    def close(self) -> None:
        """Remove the temporary file."""
        self._map = None
        self._file.close()

    def _places_of(self, keys: I64Array) -> I64Array:
        """Places of the blocks with keys (k,), increasing; new ones are empty."""
        at = self._keys.searchsorted(keys)
        is_new = np.concatenate([self._keys, [-1]])[at] != keys
        added = int(is_new.sum())
        if added:
            count = len(self._keys)
            while count + added > self._capacity:
                # Written, since a mapped file without space would end the process.
                self._file.write(bytes(_GROWTH * _BLOCK_BYTES))
                self._file.flush()
                self._capacity += _GROWTH
                self._map = None
            places = np.arange(count, count + added)
            self._keys = np.insert(self._keys, at[is_new], keys[is_new])
            self._places = np.insert(self._places, at[is_new], places)
            at = self._keys.searchsorted(keys)
        return self._places[at]

    def _bits(self) -> U8Array:
        """All blocks."""
        self._scans += 1
        if self._map is None or self._scans % _SCANS == 0:
            self._map = mmap.mmap(self._file.fileno(), self._capacity * _BLOCK_BYTES)
        return np.frombuffer(self._map, np.uint8)
