"""Raw columns of a window to the arrays of a scan: every pixel is read once and written once.

Columns are decoded in tiles that stay in the processor's cache. Each sensor of a tile is projected
on its own, then its columns are laid between those of the others, and the valid returns of the tile
are moved to their final rows.
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
    EXTRAS,
    BoolArray,
    F32Array,
    F64Array,
    I64Array,
    Pixels,
    RunInfo,
    Scan,
    U8Array,
    U16Array,
)

TILE_COLUMNS = 1024
# What a point is, in the bytes of one word, so that it moves as one.
LABEL = np.dtype([("ring", "<u2"), ("return_type", "u1"), ("lidar_id", "u1")])
Extras: TypeAlias = frozenset[str]
Labels: TypeAlias = npt.NDArray[np.void]
_NAN = np.float32("nan")


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


@dataclass(slots=True)
class Due:
    """Columns of a scan in their final order; all (n,) int64, stamps in ns."""

    stamp_ns: I64Array
    sensor: I64Array
    place: I64Array
    encoder: I64Array

    def __len__(self) -> int:
        return len(self.stamp_ns)


@dataclass(frozen=True, slots=True)
class Label:
    """What a scan says of itself; see Scan."""

    index: int
    slice: int
    start_ns: int
    end_ns: int
    complete: bool
    ready_host_ns: int


class _Tile:
    """Points of a tile of columns, as flat planes; each sensor has a part of them, row by row.

    `point` is x, y, z, intensity. Sensors lie one after the other; the order of the scan comes
    from the index by which points leave the tile, so that no plane has to be reordered.
    """

    def __init__(self, slots: int) -> None:
        size = TILE_COLUMNS * slots
        self.point = np.zeros((size, 4), np.float32)
        self.range_m = np.zeros(size, np.float32)
        self.reflectivity = np.zeros(size, np.uint16)
        self.label = np.zeros(size, LABEL)
        self.keep = np.zeros(size, np.bool_)

    def part(self, begin: int, count: int, slots: int) -> _Part:
        """`count` columns of `slots` slots each, from element `begin` on."""
        place, shape = slice(begin, begin + count * slots), (count, slots)
        return _Part(
            self.point[place].reshape(*shape, 4),
            self.range_m[place].reshape(shape),
            self.reflectivity[place].reshape(shape),
            self.label[place].reshape(shape),
            self.keep[place].reshape(shape),
        )


@dataclass(slots=True)
class _Part:
    """The part of one sensor in a tile: (n, slots) views, `point` (n, slots, 4)."""

    point: F32Array
    range_m: F32Array
    reflectivity: U16Array
    label: Labels
    keep: BoolArray


class _Projector:
    """One sensor: from places in its ring to points in the body frame."""

    def __init__(self, source: Source, lidar_id: int, boxes_m: F64Array, extras: Extras) -> None:
        self.counts = PointCounts()
        self.slots = source.slots
        self._source = source
        self._boxes_m = boxes_m.astype(np.float32)
        lidar = source.lidar
        beams = lidar.beams.moved(source.body_from_sensor)
        self._direction = np.ascontiguousarray(beams.directions().transpose(1, 0, 2))
        self._origin = np.ascontiguousarray(beams.origins().transpose(1, 0, 2))
        self._reach_m = beams.reach_m.astype(np.float32)
        self._records = np.empty((TILE_COLUMNS, lidar.record_size), np.uint8)
        shape = (TILE_COLUMNS, lidar.channels)
        self._towards = np.empty((TILE_COLUMNS, 3, lidar.channels), np.float32)
        self._moved = np.empty_like(self._towards)
        self._range_m = np.empty((lidar.returns, *shape), np.float32)
        self._reached_m = np.empty(shape, np.float32)
        slot = np.arange(source.slots)
        self._label = np.zeros(source.slots, LABEL)
        self._label["ring"] = source.ring_base + slot // lidar.returns
        self._label["return_type"] = np.array(lidar.return_types, np.uint8)[slot % lidar.returns]
        self._label["lidar_id"] = lidar_id
        self._has_reflectivity = lidar.has_reflectivity and "reflectivity" in extras

    def project(self, place: I64Array, encoder: I64Array, part: _Part) -> None:
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

    def _keep(self, part: _Part) -> None:
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


class _Buffer:
    """Arrays of one scan, reused by the next; rows beyond a scan's points are stale."""

    def __init__(self, rows: int, slots: int | None) -> None:
        shape = (rows,) if slots is None else (rows, slots)
        self.rows = rows
        self.point = np.empty((*shape, 4), np.float32)
        self.range_m = np.empty(shape, np.float32)
        self.reflectivity = np.empty(shape, np.uint16)
        self.label = np.empty(shape, LABEL)
        self.time_ns = np.empty(shape, np.uint32)
        self.column = np.empty(rows if slots is None else 0, np.uint32)

    def clear(self, rows: slice) -> None:
        """Empty slots: NaN for what is measured in metres or as a level, else 0."""
        for real in (self.point, self.range_m):
            real[rows] = _NAN
        for whole in (self.reflectivity, self.label.view(np.uint32), self.time_ns):
            whole[rows] = 0


@dataclass(slots=True)
class _Laid:
    """One sensor's columns of a tile: their part, rows in the tile's order, first element."""

    part: _Part
    rows: I64Array | slice
    begin: int


class Decoder:
    """Turns the columns of windows into scans; `only` (a sensor) serves `--split`."""

    def __init__(
        self,
        info: RunInfo,
        sources: Sequence[Source],
        boxes_m: F64Array,
        extras: Extras = EXTRAS,
        only: int | None = None,
    ) -> None:
        self._info = info
        self._only = only
        self._extras = extras
        first = only or 0
        self._projectors = [
            _Projector(source, number, boxes_m, extras)
            for number, source in enumerate(sources, first)
        ]
        self._slots = max(source.slots for source in sources)
        self._tile = _Tile(self._slots)
        self._keep = np.zeros((TILE_COLUMNS, self._slots), np.bool_)
        self._organized = info.layout == "organized"
        self._has_reflectivity = "reflectivity" in extras and any(
            source.lidar.has_reflectivity for source in sources
        )
        self._buffer = self._new_buffer(0)

    @property
    def counts(self) -> list[PointCounts]:
        """The ledger of pixels of each sensor."""
        return [projector.counts for projector in self._projectors]

    def scan(self, due: Due, label: Label) -> Scan:
        """Decode the columns of one window; the arrays are valid until the next call."""
        rows = len(due) if self._organized else len(due) * self._slots
        if rows > self._buffer.rows:
            self._buffer = self._new_buffer(rows)
        points = 0
        for begin in range(0, len(due), TILE_COLUMNS):
            tile = slice(begin, min(begin + TILE_COLUMNS, len(due)))
            laid = self._project(due, tile)
            if self._organized:
                points += self._place(laid, due, tile, label.start_ns)
            else:
                points += self._compress(laid, due, tile, points, label.start_ns)
        return self._scan(due, label, points)

    def _new_buffer(self, rows: int) -> _Buffer:
        return _Buffer(rows, self._slots if self._organized else None)

    def _project(self, due: Due, tile: slice) -> list[_Laid]:
        """Decode the columns of one tile, sensor by sensor."""
        sensor, place, encoder = due.sensor[tile], due.place[tile], due.encoder[tile]
        laid, begin = [], 0
        counts = np.bincount(sensor).tolist()
        for number, projector in enumerate(self._projectors[: len(counts)]):
            count = counts[number]
            if not count:
                continue
            part = self._tile.part(begin, count, projector.slots)
            if count == len(sensor):
                projector.project(place, encoder, part)
                return [_Laid(part, slice(0, count), begin)]
            rows = (sensor == number).nonzero()[0]
            projector.project(place[rows], encoder[rows], part)
            laid.append(_Laid(part, rows, begin))
            begin += count * projector.slots
        return laid

    def _index(self, laid: Sequence[_Laid], columns: int) -> tuple[I64Array, I64Array]:
        """Elements of the tile's planes in the order of the scan, and how many of each column."""
        if len(laid) == 1:
            keep = laid[0].part.keep
            return keep.reshape(-1).nonzero()[0], np.add.reduce(keep, axis=1, dtype=np.uint16)
        keep = self._keep[:columns]
        shift = np.empty(columns, np.int64)
        for one in laid:
            count, slots = one.part.keep.shape
            keep[one.rows, :slots] = one.part.keep
            keep[one.rows, slots:] = False
            shift[one.rows] = one.begin + np.arange(count) * slots
        shift -= np.arange(columns) * self._slots
        counts = np.add.reduce(keep, axis=1, dtype=np.uint16)
        index = keep.reshape(-1).nonzero()[0]
        index += shift.repeat(counts)
        return index, counts

    def _compress(
        self, laid: Sequence[_Laid], due: Due, columns: slice, at: int, start_ns: int
    ) -> int:
        """Move the wanted points of a tile to their final rows; gives their number."""
        tile, buffer = self._tile, self._buffer
        index, counts = self._index(laid, columns.stop - columns.start)
        rows = slice(at, at + len(index))
        whole = tile.point.view(np.complex128).reshape(-1)
        whole.take(index, out=buffer.point[rows].view(np.complex128).reshape(-1), mode="clip")
        words = tile.label.view(np.uint32)
        words.take(index, out=buffer.label[rows].view(np.uint32), mode="clip")
        if "range_m" in self._extras:
            tile.range_m.take(index, out=buffer.range_m[rows], mode="clip")
        if self._has_reflectivity:
            tile.reflectivity.take(index, out=buffer.reflectivity[rows], mode="clip")
        offset = (due.stamp_ns[columns] - start_ns).astype(np.uint32)
        buffer.time_ns[rows] = offset.repeat(counts)
        if "column" in self._extras:
            number = np.arange(columns.start, columns.stop, dtype=np.uint32)
            buffer.column[rows] = number.repeat(counts)
        return len(index)

    def _lidar_id(self, due: Due, columns: slice) -> U8Array:
        sensor = due.sensor[columns]
        if self._only is not None:
            return np.full(len(sensor), self._only, np.uint8)
        return sensor.astype(np.uint8)

    def _place(self, laid: Sequence[_Laid], due: Due, columns: slice, start_ns: int) -> int:
        """Lay a tile down as it is, NaN and 0 where a slot is empty; gives its valid points."""
        buffer, points = self._buffer, 0
        buffer.clear(columns)
        offset = (due.stamp_ns[columns] - start_ns).astype(np.uint32)
        buffer.label["lidar_id"][columns] = self._lidar_id(due, columns)[:, None]
        for one in laid:
            part, keep = one.part, one.part.keep
            points += int(np.count_nonzero(keep))
            row, slot = np.nonzero(keep)
            order = np.arange(columns.start, columns.stop)[one.rows]
            at = (order[row], slot)
            buffer.point[at] = part.point[keep]
            buffer.range_m[at] = part.range_m[keep]
            buffer.label[at] = part.label[keep]
            buffer.reflectivity[at] = part.reflectivity[keep]
            buffer.time_ns[at] = offset[one.rows][row]
        return points

    def _scan(self, due: Due, label: Label, points: int) -> Scan:
        rows, buffer = slice(0, len(due) if self._organized else points), self._buffer
        lidar_id = self._lidar_id(due, slice(None))
        has_column = "column" in self._extras and not self._organized
        return Scan(
            info=self._info,
            index=label.index,
            slice=label.slice,
            start_ns=label.start_ns,
            end_ns=label.end_ns,
            complete=label.complete,
            ready_host_ns=label.ready_host_ns,
            xyz=buffer.point[rows, ..., :3],
            intensity=buffer.point[rows, ..., 3],
            reflectivity=buffer.reflectivity[rows] if self._has_reflectivity else None,
            range_m=buffer.range_m[rows] if "range_m" in self._extras else None,
            time_ns=buffer.time_ns[rows],
            ring=buffer.label["ring"][rows],
            return_type=buffer.label["return_type"][rows],
            lidar_id=buffer.label["lidar_id"][rows],
            column=buffer.column[rows] if has_column else None,
            column_stamp_ns=due.stamp_ns,
            column_lidar_id=lidar_id,
            points=points,
            columns_per_sensor=tuple(
                np.bincount(lidar_id, minlength=len(self._info.sensors)).tolist()
            ),
            max_gap_ns=self._gaps(due.stamp_ns, lidar_id),
        )

    def _gaps(self, stamp_ns: I64Array, lidar_id: U8Array) -> tuple[int, ...]:
        """Widest step between columns of each sensor, ns."""
        numbers = range(len(self._info.sensors))
        steps = (np.diff(stamp_ns[lidar_id == number]) for number in numbers)
        return tuple(int(step.max(initial=0)) for step in steps)
