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

from mlbatch.arrays import I64Array

# Bits of a coordinate in a block, and of that of a block, around the origin of the map.
_SHIFT, _AXIS_BITS = 5, 21
_BLOCK_BYTES = 1 << (3 * _SHIFT - 3)
MOST_VOXELS = 1 << (_AXIS_BITS - 1 + _SHIFT)
# The file grows by so many blocks. After so many scans all pages are unmapped: those in use return.
_GROWTH, _SCANS = 4096, 64


class VoxelFilter:
    """Remembers which voxels have a point."""

    def __init__(self, edge: int, folder: Path) -> None:
        """edge: in units of the coordinates; folder: of the temporary file."""
        self._edge = edge
        self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        # Numbers of blocks, increasing, and their places in the file.
        self._keys: I64Array = np.zeros(0, np.int64)
        self._places: I64Array = np.zeros(0, np.int64)
        self._map: mmap.mmap | None = None
        self._scans = 0

    def first(self, units: I64Array) -> I64Array:
        """Return the indexes, increasing, of the points (n, 3) that are the first in their voxel.

        units: less than MOST_VOXELS voxels from the origin. OSError where the disk is full.
        """
        cells = units // self._edge
        x, y, z = ((cells >> _SHIFT) + (1 << (_AXIS_BITS - 1))).T
        keys, block = np.unique((((x << _AXIS_BITS) | y) << _AXIS_BITS) | z, return_inverse=True)
        a, b, c = (cells & ((1 << _SHIFT) - 1)).T
        voxels = (self._places_of(keys)[block] << (3 * _SHIFT)) | (a << (2 * _SHIFT))
        voxels, first = np.unique(voxels | (b << _SHIFT) | c, return_index=True)
        self._scans += 1
        if self._map is None or self._scans % _SCANS == 0:
            self._map = mmap.mmap(self._file.fileno(), 0)
        bits = np.frombuffer(self._map, np.uint8)
        mask = np.left_shift(1, voxels & 7).astype(np.uint8)
        is_new = (bits[voxels >> 3] & mask) == 0
        # Several voxels share a byte.
        np.bitwise_or.at(bits, voxels[is_new] >> 3, mask[is_new])
        return np.sort(first[is_new])

    def close(self) -> None:
        """Remove the temporary file."""
        self._map = None
        self._file.close()

    def _places_of(self, keys: I64Array) -> I64Array:
        """Places of the blocks with keys (k,), increasing; new ones are empty."""
        at = self._keys.searchsorted(keys)
        is_new = np.append(self._keys, -1)[at] != keys
        if not is_new.any():
            return self._places[at]
        count = len(self._keys)
        end = count + int(is_new.sum())
        self._keys = np.insert(self._keys, at[is_new], keys[is_new])
        self._places = np.insert(self._places, at[is_new], np.arange(count, end))
        while self._file.tell() < end * _BLOCK_BYTES:
            # Written, since a mapped page without a place on the disk would end the process.
            self._file.write(bytes(_GROWTH * _BLOCK_BYTES))
            self._map = None
        return self._places[self._keys.searchsorted(keys)]
