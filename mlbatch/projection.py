"""One sensor's raw columns to points in the body frame: every pixel is read once.

Work is done in tiles of columns, whose planes are few and reused. The formula is that of
`geometry.py`; what a pixel holds is the sensor's own business (`Lidar.read`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.ledger import PointCounts
from mlbatch.lidar import Lidar
from mlbatch.ring import RawRing
from mlbatch.types import (
    BoolArray,
    F32Array,
    F64Array,
    I64Array,
    Pixels,
    U8Array,
    U16Array,
)

# Enough work for a call to be cheap, little enough for the planes to stay in the caches.
TILE_SLOTS = 1 << 16
# What a point is, in the bytes of one word, so that it moves as one.
LABEL = np.dtype([("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")])
Extras: TypeAlias = frozenset[str]
Labels: TypeAlias = npt.NDArray[np.void]


@dataclass(slots=True)
class Source:
    """A sensor, its raw packets, and what of its points is wanted; ranges in m, 0 and inf: all."""

    lidar: Lidar
    ring: RawRing
    body_from_sensor: F64Array
    ring_base: int
    min_range_m: float = 0.0
    max_range_m: float = float("inf")

    @property
    def slots(self) -> int:
        """Readings of a column: channels times returns."""
        return self.lidar.channels * self.lidar.returns


def tile_columns(slots: int) -> int:
    """Columns of a tile, for columns of up to `slots` slots."""
    return max(16, TILE_SLOTS // slots)


class Tile:
    """Points of a tile of columns, as flat planes; each sensor has a part of them, row by row.

    `point` is x, y, z, intensity. Sensors lie one after the other; the order of the scan comes
    from the index by which points leave the tile, so that no plane has to be reordered.
    """

    def __init__(self, size: int) -> None:
        self.point = np.zeros((size, 4), np.float32)
        self.range_m = np.zeros(size, np.float32)
        self.reflectivity = np.zeros(size, np.uint16)
        self.label = np.zeros(size, LABEL)
        self.keep = np.zeros(size, np.bool_)

    def part(self, begin: int, count: int, slots: int) -> Part:
        """`count` columns of `slots` slots each, from element `begin` on."""
        place, shape = slice(begin, begin + count * slots), (count, slots)
        return Part(
            self.point[place].reshape(*shape, 4),
            self.range_m[place].reshape(shape),
            self.reflectivity[place].reshape(shape),
            self.label[place].reshape(shape),
            self.keep[place].reshape(shape),
        )


@dataclass(slots=True)
class Part:
    """The part of one sensor in a tile: (n, slots) views, `point` (n, slots, 4)."""

    point: F32Array
    range_m: F32Array
    reflectivity: U16Array
    label: Labels
    keep: BoolArray


class Projector:
    """One sensor: from places in its ring to points in the body frame, `columns` at most."""

    def __init__(
        self, source: Source, lidar_id: int, columns: int, boxes_m: F64Array, extras: Extras
    ) -> None:
        self.counts = PointCounts()
        self.slots = source.slots
        self._source = source
        self._boxes_m = boxes_m.astype(np.float32)
        lidar = source.lidar
        beams = lidar.beams.moved(source.body_from_sensor)
        self._direction = np.ascontiguousarray(beams.directions().transpose(1, 0, 2))
        self._origin = np.ascontiguousarray(beams.origins().transpose(1, 0, 2))
        self._reach_m = beams.reach_m.astype(np.float32)
        self._records = np.empty((columns, lidar.record_size), np.uint8)
        shape = (columns, lidar.channels)
        self._towards = np.empty((columns, 3, lidar.channels), np.float32)
        self._moved = np.empty_like(self._towards)
        self._range_m = np.empty((lidar.returns, *shape), np.float32)
        self._reached_m = np.empty(shape, np.float32)
        slot = np.arange(source.slots)
        self._label = np.zeros(source.slots, LABEL)
        self._label["ring"] = source.ring_base + slot // lidar.returns
        self._label["return_type"] = np.array(lidar.return_types, np.uint8)[slot % lidar.returns]
        self._label["lidar_id"] = lidar_id
        self._has_reflectivity = lidar.has_reflectivity and "reflectivity" in extras

    def project(self, place: I64Array, encoder: I64Array, part: Part) -> None:
        """Decode the columns at `place` into `part`."""
        lidar, count = self._source.lidar, len(place)
        records = self._records[:count]
        self._source.ring.gather(place, records)
        towards, origin = self._geometry(encoder)
        for which in range(lidar.returns):
            slots = slice(which, None, lidar.returns)
            # One return fills its plane in one piece; of several, each is every n-th slot.
            range_m = part.range_m if lidar.returns == 1 else self._range_m[which, :count]
            reflectivity = part.reflectivity[:, slots] if self._has_reflectivity else None
            lidar.read(records, which, Pixels(range_m, part.point[:, slots, 3], reflectivity))
            reached_m = np.add(range_m, self._reach_m, out=self._reached_m[:count])
            moved = np.multiply(reached_m[:, None, :], towards, out=self._moved[:count])
            np.add(moved, origin, out=part.point[:, slots, :3].transpose(0, 2, 1))
            if lidar.returns > 1:
                part.range_m[:, slots] = range_m
        if not lidar.has_reflectivity:
            part.reflectivity[:] = 0
        part.label.view(np.uint32)[:] = self._label.view(np.uint32)
        if lidar.returns == 2 and lidar.strongest_first:
            self._type_returns(part.label["return_type"])
        self._keep(part)

    def _geometry(self, encoder: I64Array) -> tuple[F32Array, F32Array]:
        """Directions (n, 3, channels) and origins (n, 3, channels or 1) at rotor positions."""
        first, count = int(encoder[0]), len(encoder)
        if bool((encoder[1:] - encoder[:-1] == 1).all()):
            turn = slice(first, first + count)
            return self._direction[turn], self._origin[turn]
        towards = self._towards[:count]
        self._direction.take(encoder, axis=0, out=towards, mode="clip")
        return towards, self._origin.take(encoder, axis=0, mode="clip")

    def _type_returns(self, types: U8Array) -> None:
        """Which of two returns is nearer: numbering of facts/outputs.md section 3."""
        strong, weak = self._range_m[:, : len(types)]
        types[:, 0::2] = np.where(weak == 0, 7, np.where(strong < weak, 3, 4))
        types[:, 1::2] = np.where(strong < weak, 6, 5)

    def _keep(self, part: Part) -> None:
        """Mark the points that are wanted, and count the others under their reason."""
        range_m, keep = part.range_m, part.keep
        counts, source = self.counts, self._source
        np.greater(range_m, 0, out=keep)
        left = int(np.count_nonzero(keep))
        counts.slots += keep.size
        counts.no_return += keep.size - left
        if source.min_range_m > 0 or source.max_range_m < float("inf"):
            keep &= range_m >= np.float32(source.min_range_m)
            keep &= range_m <= np.float32(source.max_range_m)
            counts.range += left - (left := int(np.count_nonzero(keep)))
        if len(self._boxes_m):
            self._cut_boxes(part.point[..., :3], keep)
            counts.box += left - (left := int(np.count_nonzero(keep)))
        counts.written += left

    def _cut_boxes(self, xyz: F32Array, keep: BoolArray) -> None:
        for box in self._boxes_m:
            inside = (xyz >= box[:3]) & (xyz <= box[3:])
            keep &= ~inside.all(axis=2)
