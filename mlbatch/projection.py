"""Raw columns of sensors of one kind to points in the body frame: every pixel is read once.

Work is done in tiles of columns, whose planes are few and reused. The formula is that of
`geometry.py`; what a pixel holds is the sensor's own business (`Lidar.read`).
"""

from __future__ import annotations

from collections.abc import Sequence
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
    """Sensors whose pixels decode alike: from places in their rings to points in the body frame.

    They are decoded together, in the order of the scan; `counts` has one ledger for each.
    columns: the most that are projected at once.
    """

    def __init__(
        self, members: Sequence[tuple[int, Source]], columns: int, boxes_m: F64Array, extras: Extras
    ) -> None:
        """members: number of each sensor in the scan, and how to read it."""
        sources = [source for _, source in members]
        self.counts = [PointCounts() for _ in sources]
        self.slots = sources[0].slots
        self._sources = sources
        self._lidar = lidar = sources[0].lidar
        self._boxes_m = boxes_m.astype(np.float32)
        tables = [source.lidar.beams.moved(source.body_from_sensor) for source in sources]
        self._direction = _stacked([table.directions() for table in tables])
        self._origin = _stacked([table.origins() for table in tables])
        turns = np.cumsum([0, *(len(table.angle_rad) for table in tables[:-1])])
        self._first_position = turns.astype(np.int64)
        reaches = np.broadcast_arrays(*(table.reach_m for table in tables))
        self._reach_m = np.stack(reaches).astype(np.float32)
        self._label = np.stack([_labels(source, number) for number, source in members])
        limits = [(source.min_range_m, source.max_range_m) for source in sources]
        self._limits_m = np.array(limits, np.float32)
        self._is_limited = any(low > 0 or high < float("inf") for low, high in limits)
        self._records = np.empty((2, columns, lidar.record_size), np.uint8)
        shape = (columns, lidar.channels)
        self._towards = np.empty((columns, 3, lidar.channels), np.float32)
        self._moved = np.empty_like(self._towards)
        self._range_m = np.empty((lidar.returns, *shape), np.float32)
        self._reached_m = np.empty(shape, np.float32)
        self._has_reflectivity = lidar.has_reflectivity and "reflectivity" in extras

    def project(
        self, member: I64Array, place: I64Array, encoder: I64Array, part: Part
    ) -> npt.NDArray[np.uint16]:
        """Decode the columns at `place` into `part`; gives the wanted points of each column.

        member: (n,) which of the sensors each column is of; place, encoder: as in Columns.
        """
        lidar, count = self._lidar, len(place)
        records = self._gathered(member, place)
        towards, origin = self._geometry(encoder + self._first_position[member])
        reach_m = self._reach_m[0] if len(self._sources) == 1 else self._reach_m[member]
        for which in range(lidar.returns):
            slots = slice(which, None, lidar.returns)
            # One return fills its plane in one piece; of several, each is every n-th slot.
            range_m = part.range_m if lidar.returns == 1 else self._range_m[which, :count]
            reflectivity = part.reflectivity[:, slots] if self._has_reflectivity else None
            lidar.read(records, which, Pixels(range_m, part.point[:, slots, 3], reflectivity))
            reached_m = np.add(range_m, reach_m, out=self._reached_m[:count])
            moved = np.multiply(reached_m[:, None, :], towards, out=self._moved[:count])
            np.add(moved, origin, out=part.point[:, slots, :3].transpose(0, 2, 1))
            if lidar.returns > 1:
                part.range_m[:, slots] = range_m
        if not lidar.has_reflectivity:
            part.reflectivity[:] = 0
        words = part.label.view(np.uint32)
        self._label.view(np.uint32).take(member, axis=0, out=words, mode="clip")
        if lidar.returns == 2 and lidar.strongest_first:
            self._type_returns(part.label["return_type"])
        return self._keep(member, part)

    def _gathered(self, member: I64Array, place: I64Array) -> U8Array:
        """Records of all columns, in their order."""
        count = len(place)
        if len(self._sources) == 1:
            self._sources[0].ring.gather(place, self._records[0, :count])
            return self._records[0, :count]
        order, begin = np.empty(count, np.int64), 0
        for number, source in enumerate(self._sources):
            rows = (member == number).nonzero()[0]
            end = begin + len(rows)
            source.ring.gather(place[rows], self._records[1, begin:end])
            order[rows] = np.arange(begin, end)
            begin = end
        self._records[1].take(order, axis=0, out=self._records[0, :count], mode="clip")
        return self._records[0, :count]

    def _geometry(self, position: I64Array) -> tuple[F32Array, F32Array]:
        """Directions (n, 3, channels) and origins (n, 3, channels or 1) at rotor positions."""
        first, count = int(position[0]), len(position)
        if bool((position[1:] - position[:-1] == 1).all()):
            turn = slice(first, first + count)
            return self._direction[turn], self._origin[turn]
        towards = self._towards[:count]
        self._direction.take(position, axis=0, out=towards, mode="clip")
        return towards, self._origin.take(position, axis=0, mode="clip")

    def _type_returns(self, types: U8Array) -> None:
        """Which of two returns is nearer: numbering of facts/outputs.md section 3."""
        strong, weak = self._range_m[:, : len(types)]
        types[:, 0::2] = np.where(weak == 0, 7, np.where(strong < weak, 3, 4))
        types[:, 1::2] = np.where(strong < weak, 6, 5)

    def _keep(self, member: I64Array, part: Part) -> npt.NDArray[np.uint16]:
        """Mark the points that are wanted, and count the others under their reason."""
        range_m, keep = part.range_m, part.keep
        np.greater(range_m, 0, out=keep)
        columns = np.bincount(member, minlength=len(self._sources))
        wanted, left = self._left(member, keep)
        for counts, number, points in zip(self.counts, columns.tolist(), left, strict=True):
            counts.slots += number * self.slots
            counts.no_return += number * self.slots - points
        if self._is_limited:
            limits_m = self._limits_m[member]
            keep &= range_m >= limits_m[:, :1]
            keep &= range_m <= limits_m[:, 1:]
            wanted, left = self._drop("range", member, keep, left)
        if len(self._boxes_m):
            self._cut_boxes(part.point[..., :3], keep)
            wanted, left = self._drop("box", member, keep, left)
        for counts, points in zip(self.counts, left, strict=True):
            counts.written += points
        return wanted

    def _left(self, member: I64Array, keep: BoolArray) -> tuple[npt.NDArray[np.uint16], list[int]]:
        """Points that are still wanted, of each column and of each sensor."""
        wanted = np.add.reduce(keep, axis=1, dtype=np.uint16)
        # Sums of whole numbers far below 2**53 are exact in a float64.
        left = np.bincount(member, weights=wanted, minlength=len(self._sources))
        return wanted, left.astype(np.int64).tolist()

    def _drop(
        self, reason: str, member: I64Array, keep: BoolArray, before: list[int]
    ) -> tuple[npt.NDArray[np.uint16], list[int]]:
        wanted, left = self._left(member, keep)
        for counts, had, has in zip(self.counts, before, left, strict=True):
            setattr(counts, reason, getattr(counts, reason) + had - has)
        return wanted, left

    def _cut_boxes(self, xyz: F32Array, keep: BoolArray) -> None:
        for box in self._boxes_m:
            inside = (xyz >= box[:3]) & (xyz <= box[3:])
            keep &= ~inside.all(axis=2)


def _stacked(planes: Sequence[F32Array]) -> F32Array:
    """Tables (3, W, B) of several sensors, one after the other, as (sum of W, 3, B)."""
    widest = max(plane.shape[2] for plane in planes)
    same = [np.broadcast_to(plane, (*plane.shape[:2], widest)) for plane in planes]
    return np.ascontiguousarray(np.concatenate(same, axis=1).transpose(1, 0, 2))


def _labels(source: Source, lidar_id: int) -> Labels:
    """What the points of a column are, (slots,)."""
    slot, lidar = np.arange(source.slots), source.lidar
    label = np.zeros(source.slots, LABEL)
    label["ring"] = source.ring_base + slot // lidar.returns
    label["return_type"] = np.array(lidar.return_types, np.uint8)[slot % lidar.returns]
    label["lidar_id"] = lidar_id
    return label
