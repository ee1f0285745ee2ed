"""Raw columns of a window to the arrays of a scan: every pixel is read once and written once.

Columns are decoded in tiles that stay in the processor's cache. Each sensor of a tile is projected
on its own, then its columns are laid between those of the others, and the valid returns of the tile
are moved to their final rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.ledger import PointCounts
from mlbatch.lidar import Lidar
from mlbatch.ring import RawRing
from mlbatch.types import (
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

TILE_COLUMNS = 256
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
    """Planes of a tile of columns, (TILE_COLUMNS, slots) each; `point` is x, y, z, intensity."""

    def __init__(self, slots: int) -> None:
        shape = (TILE_COLUMNS, slots)
        self.point = np.zeros((*shape, 4), np.float32)
        self.range_m = np.zeros(shape, np.float32)
        self.reflectivity = np.zeros(shape, np.uint16)
        self.ring = np.zeros(shape, np.uint16)
        self.return_type = np.zeros(shape, np.uint8)
        self.keep = np.zeros(shape, np.bool_)

    def planes(self) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.generic]], ...]:
        """All planes."""
        return (
            self.point,
            self.range_m,
            self.reflectivity,
            self.ring,
            self.return_type,
            self.keep,
        )


class _Projector:
    """One sensor: from places in its ring to a tile of points in the body frame."""

    def __init__(self, source: Source, boxes_m: F64Array) -> None:
        self.counts = PointCounts()
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
        self.tile = _Tile(source.slots)
        slot = np.arange(source.slots)
        self.tile.ring[:] = source.ring_base + slot // lidar.returns
        self.tile.return_type[:] = np.array(lidar.return_types, np.uint8)[slot % lidar.returns]

    def project(self, place: I64Array, encoder: I64Array) -> None:
        """Fill the first rows of the own tile with the columns at `place`."""
        lidar, count, tile = self._source.lidar, len(place), self.tile
        records = self._records[:count]
        self._source.ring.gather(place, records)
        towards = self._towards[:count]
        np.take(self._direction, encoder, axis=0, out=towards, mode="clip")
        origin = np.take(self._origin, encoder, axis=0, mode="clip")
        for which in range(lidar.returns):
            slots = slice(which, None, lidar.returns)
            range_m = self._range_m[which, :count]
            pixels = Pixels(
                range_m,
                tile.point[:count, slots, 3],
                tile.reflectivity[:count, slots] if lidar.has_reflectivity else None,
            )
            lidar.read(records, which, pixels)
            reached_m = np.add(range_m, self._reach_m, out=self._reached_m[:count])
            moved = np.multiply(reached_m[:, None, :], towards, out=self._moved[:count])
            np.add(moved, origin, out=tile.point[:count, slots, :3].transpose(0, 2, 1))
            tile.range_m[:count, slots] = range_m
        if lidar.returns == 2 and lidar.strongest_first:
            self._type_returns(count)
        self._keep(count)

    def _type_returns(self, count: int) -> None:
        """Which of two returns is nearer: numbering of facts/outputs.md section 3."""
        strong, weak = self._range_m[0, :count], self._range_m[1, :count]
        types = self.tile.return_type[:count]
        types[:, 0::2] = np.where(weak == 0, 7, np.where(strong < weak, 3, 4))
        types[:, 1::2] = np.where(strong < weak, 6, 5)

    def _keep(self, count: int) -> None:
        """Mark the points that are wanted, and count the others under their reason."""
        range_m, keep = self.tile.range_m[:count], self.tile.keep[:count]
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
            self._cut_boxes(count, keep)
            counts.box += left - (left := int(np.count_nonzero(keep)))
        counts.written += left

    def _cut_boxes(self, count: int, keep: BoolArray) -> None:
        xyz = self.tile.point[:count, :, :3]
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
        self.ring = np.empty(shape, np.uint16)
        self.return_type = np.empty(shape, np.uint8)
        self.lidar_id = np.empty(shape, np.uint8)
        self.time_ns = np.empty(shape, np.uint32)
        self.column = np.empty(rows if slots is None else 0, np.uint32)


class Decoder:
    """Turns the columns of windows into scans; `only` (a sensor) serves `--split`."""

    def __init__(
        self, info: RunInfo, sources: Sequence[Source], boxes_m: F64Array, only: int | None = None
    ) -> None:
        self._info = info
        self._only = only
        self._projectors = [_Projector(source, boxes_m) for source in sources]
        self._slots = max(source.slots for source in sources)
        self._merged = _Tile(self._slots) if len(sources) > 1 else None
        self._organized = info.layout == "organized"
        self._has_reflectivity = any(source.lidar.has_reflectivity for source in sources)
        self._buffer = _Buffer(0, self._slots if self._organized else None)

    @property
    def counts(self) -> list[PointCounts]:
        """The ledger of pixels of each sensor."""
        return [projector.counts for projector in self._projectors]

    def scan(self, due: Due, label: Label) -> Scan:
        """Decode the columns of one window; the arrays are valid until the next call."""
        self._reserve(len(due))
        points = 0
        for begin in range(0, len(due), TILE_COLUMNS):
            end = min(begin + TILE_COLUMNS, len(due))
            tile = self._tile(due, slice(begin, end))
            if self._organized:
                points += self._place(tile, due, begin, end, label.start_ns)
            else:
                points += self._compress(tile, due, begin, end, points, label.start_ns)
        return self._scan(due, label, points)

    def _reserve(self, columns: int) -> None:
        rows = columns if self._organized else columns * self._slots
        if rows > self._buffer.rows:
            self._buffer = _Buffer(rows, self._slots if self._organized else None)

    def _tile(self, due: Due, part: slice) -> _Tile:
        """The columns of one tile, of all sensors, in their final order."""
        sensor = due.sensor[part]
        present = np.flatnonzero(np.bincount(sensor))
        place, encoder = due.place[part], due.encoder[part]
        if len(present) == 1:
            projector = self._projectors[int(present[0])]
            projector.project(place, encoder)
            if self._merged is None or projector.tile.keep.shape == self._merged.keep.shape:
                return projector.tile
        merged = self._merged
        if merged is None:
            raise AssertionError("one sensor needs no merging")
        merged.keep[:] = False
        for number in present:
            projector = self._projectors[int(number)]
            rows = np.flatnonzero(sensor == number)
            if len(present) > 1:
                projector.project(place[rows], encoder[rows])
            for target, source in zip(merged.planes(), projector.tile.planes(), strict=True):
                target[rows, : source.shape[1]] = source[: len(rows)]
        return merged

    def _compress(self, tile: _Tile, due: Due, begin: int, end: int, at: int, start_ns: int) -> int:
        """Move the wanted points of a tile to their final rows; gives their number."""
        count, buffer = end - begin, self._buffer
        keep = tile.keep[:count]
        index = np.flatnonzero(keep)
        rows = slice(at, at + len(index))
        _take(tile.point, index, buffer.point[rows])
        _take(tile.range_m, index, buffer.range_m[rows])
        _take(tile.ring, index, buffer.ring[rows])
        _take(tile.return_type, index, buffer.return_type[rows])
        if self._has_reflectivity:
            _take(tile.reflectivity, index, buffer.reflectivity[rows])
        wanted = np.add.reduce(keep, axis=1, dtype=np.uint32)
        offset = (due.stamp_ns[begin:end] - start_ns).astype(np.uint32)
        buffer.time_ns[rows] = np.repeat(offset, wanted)
        buffer.lidar_id[rows] = np.repeat(self._lidar_id(due, begin, end), wanted)
        buffer.column[rows] = np.repeat(np.arange(begin, end, dtype=np.uint32), wanted)
        return len(index)

    def _lidar_id(self, due: Due, begin: int, end: int) -> U8Array:
        if self._only is not None:
            return np.full(end - begin, self._only, np.uint8)
        return due.sensor[begin:end].astype(np.uint8)

    def _place(self, tile: _Tile, due: Due, begin: int, end: int, start_ns: int) -> int:
        """Lay a tile down as it is, NaN and 0 where a slot is empty; gives its valid points."""
        rows, count, buffer = slice(begin, end), end - begin, self._buffer
        keep = tile.keep[:count]
        empty = ~keep
        buffer.point[rows] = tile.point[:count]
        buffer.point[rows][empty] = _NAN
        buffer.range_m[rows] = np.where(keep, tile.range_m[:count], _NAN)
        buffer.ring[rows] = tile.ring[:count] * keep
        buffer.return_type[rows] = tile.return_type[:count] * keep
        buffer.reflectivity[rows] = tile.reflectivity[:count] * keep
        offset = (due.stamp_ns[rows] - start_ns).astype(np.uint32)
        buffer.time_ns[rows] = offset[:, None] * keep
        buffer.lidar_id[rows] = self._lidar_id(due, begin, end)[:, None]
        return int(np.count_nonzero(keep))

    def _scan(self, due: Due, label: Label, points: int) -> Scan:
        rows, buffer = slice(0, len(due) if self._organized else points), self._buffer
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
            range_m=buffer.range_m[rows],
            time_ns=buffer.time_ns[rows],
            ring=buffer.ring[rows],
            return_type=buffer.return_type[rows],
            lidar_id=buffer.lidar_id[rows],
            column=None if self._organized else buffer.column[rows],
            column_stamp_ns=due.stamp_ns,
            column_lidar_id=self._lidar_id(due, 0, len(due)),
            points=points,
            columns_per_sensor=self._per_sensor(due),
            max_gap_ns=self._gaps(due),
        )

    def _per_sensor(self, due: Due) -> tuple[int, ...]:
        lidar_id = self._lidar_id(due, 0, len(due))
        return tuple(np.bincount(lidar_id, minlength=len(self._info.sensors)).tolist())

    def _gaps(self, due: Due) -> tuple[int, ...]:
        """Widest step between columns of each sensor, ns."""
        lidar_id = self._lidar_id(due, 0, len(due))
        steps = (
            np.diff(due.stamp_ns[lidar_id == number]) for number in range(len(self._info.sensors))
        )
        return tuple(int(step.max(initial=0)) for step in steps)


def _take(
    plane: F32Array | U16Array | U8Array, index: I64Array, out: F32Array | U16Array | U8Array
) -> None:
    """Gather elements of a plane (points of 16 bytes as one), without a temporary array."""
    if plane.ndim == 3:
        whole = plane.reshape(-1, 4).view(np.complex128).reshape(-1)
        np.take(whole, index, out=out.view(np.complex128).reshape(-1), mode="clip")
    else:
        np.take(plane.reshape(-1), index, out=out, mode="clip")
