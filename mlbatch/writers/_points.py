"""The point arrays of a scan as writers pack them, also several of them as one.

Decoders leave what belongs to a point side by side in memory (`buffers.py`). What lies so in a
record, too, moves as one wide word: that takes a fraction of the time of its parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, U8Array, U16Array, U32Array
from mlbatch.types import Scan, SensorInfo

Values: TypeAlias = npt.NDArray[np.generic]
# Four float32 as one item, whatever they mean; time_ns, ring, return type and sensor as one; the
# last two of them as one.
REALS, LABEL, PAIR = "<c16", "<u8", "<u2"
_PARTS = {REALS: (0, 4, 8, 12), LABEL: (0, 4, 6, 7)}


@dataclass(frozen=True, slots=True)
class Points:
    """The point arrays of a scan in the order of the file: (p,), or (slots, n) when organized.

    reals: x, y, z and intensity, labels: time_ns, ring, return_type and lidar_id of every point in
    one word, None where they do not lie side by side.
    """

    sensors: tuple[SensorInfo, ...]
    start_ns: int
    xyz: F32Array
    intensity: F32Array
    reflectivity: U16Array | None
    range_m: F32Array | None
    time_ns: U32Array
    ring: U16Array
    return_type: U8Array
    lidar_id: U8Array
    reals: Values | None = None
    labels: Values | None = None

    def take(self, rows: slice) -> Points:
        """The points in `rows` of the first axis."""
        return Points(
            self.sensors,
            self.start_ns,
            self.xyz[rows],
            self.intensity[rows],
            None if self.reflectivity is None else self.reflectivity[rows],
            None if self.range_m is None else self.range_m[rows],
            self.time_ns[rows],
            self.ring[rows],
            self.return_type[rows],
            self.lidar_id[rows],
            None if self.reals is None else self.reals[rows],
            None if self.labels is None else self.labels[rows],
        )


def points_of(scan: Scan) -> Points:
    """The points of a scan; organized ones are turned so that a column is a column of the image."""
    turned = scan.info.layout == "organized"
    reflectivity, range_m = scan.reflectivity, scan.range_m
    x, y, z = (scan.xyz[..., axis] for axis in range(3))
    reals = _as_one(REALS, x, y, z, scan.intensity)
    labels = _as_one(LABEL, scan.time_ns, scan.ring, scan.return_type, scan.lidar_id)
    return Points(
        scan.info.sensors,
        scan.start_ns,
        scan.xyz.transpose(1, 0, 2) if turned else scan.xyz,
        scan.intensity.T,
        None if reflectivity is None else reflectivity.T,
        None if range_m is None else range_m.T,
        scan.time_ns.T,
        scan.ring.T,
        scan.return_type.T,
        scan.lidar_id.T,
        None if reals is None else reals.T,
        None if labels is None else labels.T,
    )


def _as_one(word: str, *parts: Values) -> Values | None:
    """Arrays whose items lie side by side in one array, as items of this type; None if they don't.

    That array is what they are all views of: its rows are words, or end with the parts of one.
    """
    base, first, size = parts[0].base, parts[0], np.dtype(word).itemsize
    if not isinstance(base, np.ndarray) or not base.flags.c_contiguous:
        return None
    steps = _steps(first.shape, base, size)
    if steps != first.strides or any(part.base is not base for part in parts):
        return None
    begin = base.__array_interface__["data"][0]
    at = [part.__array_interface__["data"][0] - begin for part in parts]
    if at != list(_PARTS[word]) or any(part.strides != steps for part in parts):
        return None
    words: Values = base.reshape(-1).view(word).reshape(base.shape[: first.ndim])
    return words[: len(first)]


def _steps(shape: tuple[int, ...], base: Values, size: int) -> tuple[int, ...] | None:
    """Steps of views of this shape if the base's rows are words of this size, else None."""
    deep = len(shape)
    if base.ndim < deep or base.shape[1:deep] != shape[1:]:
        return None
    steps = base.strides[:deep]
    return steps if steps and steps[-1] == size else None
