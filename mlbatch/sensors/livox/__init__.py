"""Livox lidars; `sensor.py` is the plug-in."""

from __future__ import annotations

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.sensors.packet_bytes import number

_SDK1_SIZES = (42, 678, 786, 918, 978, 1278, 1318, 1362)
# The header of SDK2 packets: size, its length, and the number of points.
_HEADER_SIZE = 36
_LENGTH_AT = 1
_POINTS_AT = 5


def may_send(size: int, packets: U8Array) -> bool:
    """Packets of SDK2 contain their size and divide into points; SDK1 has a few sizes."""
    if size in _SDK1_SIZES or size <= _HEADER_SIZE:
        return size in _SDK1_SIZES
    rows = np.atleast_2d(packets)
    points = number(rows, _POINTS_AT, 2)
    whole = (points > 0) & ((size - _HEADER_SIZE) % np.maximum(points, 1) == 0)
    return bool((whole & (number(rows, _LENGTH_AT, 2) == size)).any())


def may_calibrate(content: bytes) -> bool:
    """False: there are no calibration files."""
    return False
