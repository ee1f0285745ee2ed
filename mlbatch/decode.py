"""Raw columns of a window to the arrays of a scan: every pixel is written once, to its final row.

Sensors of one kind are projected together (`projection.py`); the index by which the valid points
leave the tile lays their columns between those of other kinds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from mlbatch.geometry import SECTORS, sectors
from mlbatch.ledger import PointCounts
from mlbatch.projection import (
    LABEL,
    Extras,
    Part,
    Projector,
    Source,
    Tile,
    tile_columns,
    wanted_points,
)
from mlbatch.types import EXTRAS, BoolArray, F64Array, I64Array, RunInfo, Scan, U8Array

__all__ = ["Decoder", "Due", "Label", "Source"]

_NAN = np.float32("nan")
# What became of the slots of every sensor of a run, in the order of `ledger.POINT_FATES`.
Fates: TypeAlias = Sequence[Sequence[int]]


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


class _Buffer:
    """Arrays of one scan, reused by the next; rows beyond a scan's points are stale."""

    def __init__(self, rows: int, slots: int | None) -> None:
        shape = (rows,) if slots is None else (rows, slots)
        self.rows = rows
        self.point = np.empty((*shape, 4), np.float32)
        self.range_m = np.empty(shape, np.float32)
        self.reflectivity = np.empty(shape, np.uint16)
        self.label = np.empty(shape, LABEL)
        self.column = np.empty(rows if slots is None else 0, np.uint32)

    def clear(self, rows: slice) -> None:
        """Empty slots: NaN for what is measured in metres or as a level, else 0."""
        for real in (self.point, self.range_m):
            real[rows] = _NAN
        for whole in (self.reflectivity, self.label.view(np.uint64)):
            whole[rows] = 0


@dataclass(slots=True)
class _Laid:
    """Columns of a tile that are decoded together.

    rows: in the tile's order; begin: first element in its planes; encoder: of each.
    """

    projector: Projector
    part: Part
    rows: I64Array | slice
    begin: int
    encoder: I64Array


class Decoder:
    """Turns the columns of windows into scans; `only` (a sensor) serves `--split`."""

    def __init__(
        self,
        info: RunInfo,
        sources: Sequence[Source],
        boxes_m: F64Array,
        extras: Extras = EXTRAS,
        only: int | None = None,
        buffers: int = 1,
    ) -> None:
        """buffers: the arrays of so many scans are valid at a time."""
        self._info = info
        self._only = only
        self._extras = extras
        self._slots = max(source.slots for source in sources)
        self._columns = tile_columns(self._slots)
        # Rotor positions of a turn, None for those that columns tell themselves.
        angles = [source.lidar.beams.angle_rad for source in sources]
        self._positions = [None if one is None else len(one) for one in angles]
        groups = _alike(sources)
        first = only or 0
        self._projectors = [
            Projector(
                [(first + number, sources[number]) for number in group],
                self._columns,
                boxes_m,
                extras,
            )
            for group in groups
        ]
        # Of each sensor: its projector, and its number there.
        self._seat = np.empty((len(sources), 2), np.int64)
        for which, group in enumerate(groups):
            self._seat[group] = [(which, member) for member in range(len(group))]
        self._tile = Tile(self._columns * self._slots)
        self._keep = np.zeros((self._columns, self._slots), np.bool_)
        self._element = np.empty(self._columns * self._slots, np.int64)
        self._organized = info.layout == "organized"
        self._has_reflectivity = "reflectivity" in extras and any(
            source.lidar.has_reflectivity for source in sources
        )
        self._buffer = self._new_buffer(0)
        self._others = deque(self._new_buffer(0) for _ in range(buffers - 1))

    @property
    def counts(self) -> list[PointCounts]:
        """The ledger of pixels of each sensor."""
        return [self._projectors[which].counts[member] for which, member in self._seat]

    def scan(self, due: Due, label: Label, fates: Fates | None = None) -> Scan:
        """Decode the columns of one window; the arrays are valid until as many calls as buffers.

        fates: given where an output already holds the points; their arrays then mean nothing.
        """
        if fates is not None:
            return self._outline(due, label, fates)
        self._others.append(self._buffer)
        self._buffer = self._others.popleft()
        self._fit(len(due))
        points = 0
        for begin in range(0, len(due), self._columns):
            tile = slice(begin, min(begin + self._columns, len(due)))
            laid = self._project(due, tile, label.start_ns)
            if self._organized:
                points += self._place(laid, due, tile)
            else:
                points += self._compress(laid, tile, points)
        return self._scan(due, label, points)

    def _outline(self, due: Due, label: Label, fates: Fates) -> Scan:
        """All of a scan but its points; organized, its arrays have their shapes."""
        if self._organized:
            self._fit(len(due))
        counts = self.counts
        before = sum(one.written for one in counts)
        own = fates if self._only is None else fates[self._only : self._only + 1]
        for one, numbers in zip(counts, own, strict=True):
            one.add(numbers)
        points = sum(one.written for one in counts) - before
        return replace(self._scan(due, label, 0), points=points)

    def _fit(self, columns: int) -> None:
        rows = columns if self._organized else columns * self._slots
        if rows > self._buffer.rows:
            self._buffer = self._new_buffer(rows)

    def _new_buffer(self, rows: int) -> _Buffer:
        return _Buffer(rows, self._slots if self._organized else None)

    def _project(self, due: Due, tile: slice, start_ns: int) -> list[_Laid]:
        """Decode the columns of one tile, kind by kind."""
        place, encoder = due.place[tile], due.encoder[tile]
        offset_ns = due.stamp_ns[tile] - start_ns
        which, member = self._seat[due.sensor[tile]].T
        laid: list[_Laid] = []
        begin = 0
        counts = np.bincount(which).tolist()
        for number, projector in enumerate(self._projectors[: len(counts)]):
            count = counts[number]
            if not count:
                continue
            part = self._tile.part(begin, count, projector.slots)
            if count == len(place):
                projector.project(member, place, encoder, offset_ns, part)
                return [_Laid(projector, part, slice(0, count), begin, encoder)]
            rows = (which == number).nonzero()[0]
            words = encoder[rows]
            projector.project(member[rows], place[rows], words, offset_ns[rows], part)
            laid.append(_Laid(projector, part, rows, begin, words))
            begin += count * projector.slots
        return laid

    def _index(self, laid: Sequence[_Laid], columns: int) -> tuple[I64Array, BoolArray]:
        """Elements of the tile's planes in the order of the scan; wanted slots (columns, slots)."""
        if len(laid) == 1:
            keep, element = laid[0].projector.in_firing_order(laid[0].part.keep, laid[0].encoder)
            index = keep.reshape(-1).nonzero()[0]
            return index if element is None else element.take(index), keep
        wide = self._keep[:columns]
        shift = np.empty(columns, np.int64)
        is_ordered = False
        for one in laid:
            count, slots = one.part.keep.shape
            keep, element = one.projector.in_firing_order(one.part.keep, one.encoder)
            own = slice(one.begin, one.begin + count * slots)
            is_ordered |= element is not None
            elements = np.arange(count * slots) if element is None else element
            np.add(elements, one.begin, out=self._element[own])
            wide[one.rows, :slots] = keep
            wide[one.rows, slots:] = False
            shift[one.rows] = one.begin + np.arange(count) * slots
        shift -= np.arange(columns) * self._slots
        index = wide.reshape(-1).nonzero()[0]
        index += shift.repeat(wanted_points(wide))
        return self._element.take(index) if is_ordered else index, wide

    def _compress(self, laid: Sequence[_Laid], columns: slice, at: int) -> int:
        """Move the wanted points of a tile to their final rows; gives their number."""
        tile, buffer = self._tile, self._buffer
        index, keep = self._index(laid, columns.stop - columns.start)
        rows = slice(at, at + len(index))
        whole = tile.point.view(np.complex128).reshape(-1)
        whole.take(index, out=buffer.point[rows].view(np.complex128).reshape(-1), mode="clip")
        words = tile.label.view(np.uint64)
        words.take(index, out=buffer.label[rows].view(np.uint64), mode="clip")
        if "range_m" in self._extras:
            tile.range_m.take(index, out=buffer.range_m[rows], mode="clip")
        if self._has_reflectivity:
            tile.reflectivity.take(index, out=buffer.reflectivity[rows], mode="clip")
        if "column" in self._extras:
            number = np.arange(columns.start, columns.stop, dtype=np.uint32)
            buffer.column[rows] = number.repeat(wanted_points(keep))
        return len(index)

    def _lidar_id(self, due: Due, columns: slice) -> U8Array:
        sensor = due.sensor[columns]
        if self._only is not None:
            return np.full(len(sensor), self._only, np.uint8)
        return sensor.astype(np.uint8)

    def _place(self, laid: Sequence[_Laid], due: Due, columns: slice) -> int:
        """Lay a tile down as it is, NaN and 0 where a slot is empty; gives its valid points."""
        buffer, points = self._buffer, 0
        buffer.clear(columns)
        buffer.label["lidar_id"][columns] = self._lidar_id(due, columns)[:, None]
        for one in laid:
            part, keep = one.part, one.part.keep
            points += int(np.count_nonzero(keep))
            row, slot = np.nonzero(keep)
            order = np.arange(columns.start, columns.stop)[one.rows]
            at = (order[row], one.projector.number[slot])
            buffer.point[at] = part.point[keep]
            if "range_m" in self._extras:
                buffer.range_m[at] = part.range_m[keep]
            buffer.label[at] = part.label[keep]
            buffer.reflectivity[at] = part.reflectivity[keep]
        return points

    def _scan(self, due: Due, label: Label, points: int) -> Scan:
        rows, buffer = slice(0, len(due) if self._organized else points), self._buffer
        lidar_id = self._lidar_id(due, slice(None))
        passes = self._passes(due)
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
            time_ns=buffer.label["time_ns"][rows],
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
            coverage=self._shares(passes >= 1),
            overlap=self._shares(passes >= 2),
        )

    def _passes(self, due: Due) -> I64Array:
        """How often the rotor of each sensor entered each sector: (sensors, SECTORS)."""
        passes = np.zeros((len(self._positions), SECTORS), np.int64)
        for number, positions in enumerate(self._positions):
            own = due.encoder if len(self._positions) == 1 else due.encoder[due.sensor == number]
            if not len(own):
                continue
            sector = sectors(own, positions)
            entered = np.flatnonzero(sector[1:] != sector[:-1]) + 1
            passes[number] = np.bincount(sector[entered], minlength=SECTORS)
            passes[number, sector[0]] += 1
        return passes

    def _shares(self, sectors_seen: BoolArray) -> tuple[float, ...]:
        shares: list[float] = (np.count_nonzero(sectors_seen, axis=1) / SECTORS).tolist()
        if self._only is None:
            return tuple(shares)
        return tuple(shares[0] if n == self._only else 0.0 for n in range(len(self._info.sensors)))

    def _gaps(self, stamp_ns: I64Array, lidar_id: U8Array) -> tuple[int, ...]:
        """Widest step between columns of each sensor, ns."""
        numbers = range(len(self._info.sensors))
        steps = (np.diff(stamp_ns[lidar_id == number]) for number in numbers)
        return tuple(int(step.max(initial=0)) for step in steps)


def _alike(sources: Sequence[Source]) -> list[list[int]]:
    """Numbers of the sensors, grouped by what their pixels look like.

    Those that say their angle themselves stay alone: their directions are made, not looked up.
    """
    groups: dict[tuple[str | int | bool, ...], list[int]] = {}
    for number, source in enumerate(sources):
        own = source.lidar.beams.angle_rad is None
        groups.setdefault((number,) if own else source.lidar.pixel_layout, []).append(number)
    return list(groups.values())
