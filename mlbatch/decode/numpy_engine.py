"""The engine `numpy`: a window tile by tile, few passes over planes that stay in the caches.

The columns of a tile are decoded sensor by sensor, those of one kind in one go (`projection.py`);
the index by which the valid points leave the tile puts them in the order of the scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.decode.projector import Extras, Projector, Tile, TileView, wanted_points
from mlbatch.decode.scan_buffer import ScanBuffer, WindowColumns


@dataclass(slots=True)
class _TilePart:
    """Columns of a tile that are decoded together.

    rows: in the scan's order; begin: first element in the tile's planes; encoder: of each.
    """

    projector: Projector
    part: TileView
    rows: I64Array
    begin: int
    encoder: I64Array


class NumpyEngine:
    """Decodes the columns of some kinds of sensors; those of others are passed over."""

    def __init__(
        self,
        projectors: Sequence[Projector],
        seat: I64Array,
        columns: int,
        first_sensor: int,
        extras: Extras,
    ) -> None:
        """seat: (sensors, 2), projector of each and number there, -1 for other kinds.

        columns: of a tile; first_sensor: number of the first one in the scan; extras: those that
        the scan has, of any sensor.
        """
        self._projectors = projectors
        self._columns = columns
        self._first_sensor = first_sensor
        self._extras = extras
        self._slots = max(projector.slots for projector in projectors)
        self._tile = Tile(columns * self._slots)
        self._keep = np.zeros((columns, self._slots), np.bool_)
        self._element = np.arange(columns * self._slots)
        self._is_ordered = any(projector.order is not None for projector in projectors)
        self._member = np.concatenate([np.arange(len(one.sources)) for one in projectors])
        self._ends = np.cumsum([len(one.sources) for one in projectors])
        # Of each sensor: its place among those that are decoded here, beyond all of them if not.
        self._is_partial = bool((seat < 0).any())
        seats = len(self._member)
        first = np.array([0, *self._ends])[seat[:, 0]]
        self._seat = np.where(seat[:, 0] < 0, seats, first + seat[:, 1]).astype(np.uint8)
        self._is_alone = seats == 1

    def decode(
        self,
        due: WindowColumns,
        start_ns: int,
        first: int,
        out: ScanBuffer,
        points: I64Array | None = None,
    ) -> int:
        """As `compiled.SensorGroup.decode`."""
        count = 0
        # Of equal size, since what a small one costs is mostly its calls.
        tiles = max(1, -(-len(due) // self._columns))
        bounds = [len(due) * part // tiles for part in range(tiles + 1)]
        for begin, end in pairwise(bounds):
            number: I64Array = np.arange(first + begin, first + end)
            columns = due.part(slice(begin, end))
            own: I64Array | None = None
            if self._is_partial:
                own = (self._seat[columns.sensor] < len(self._member)).nonzero()[0]
                columns, number = columns.part(own), number[own]
            if not len(columns):
                continue
            laid = self._project(columns, start_ns)
            if out.is_organized:
                count += self._place(laid, columns, number, out)
                continue
            index, keep = self._index(laid, len(columns))
            self._move(index, out, count)
            if points is not None:
                points[begin:end][slice(None) if own is None else own] = wanted_points(keep)
            elif "column" in self._extras:
                out.column[count : count + len(index)] = number.repeat(wanted_points(keep))
            count += len(index)
        return count

    def _project(self, due: WindowColumns, start_ns: int) -> list[_TilePart]:
        """Decode the columns of one tile, sensor by sensor."""
        seat = self._seat[due.sensor]
        rows = self._element[: len(due)]
        if not self._is_alone:
            rows = seat.argsort(kind="stable")
            due, seat = due.part(rows), seat[rows]
        member, offset_ns = self._member[seat], due.stamp_ns - start_ns
        laid: list[_TilePart] = []
        element = begin = 0
        ends = np.searchsorted(seat, self._ends).tolist()
        for projector, end in zip(self._projectors, ends, strict=True):
            if begin == end:
                continue
            own = slice(begin, end)
            part = self._tile.part(element, end - begin, projector.slots)
            encoder = due.encoder[own]
            projector.project(member[own], due.place[own], encoder, offset_ns[own], part)
            laid.append(_TilePart(projector, part, rows[own], element, encoder))
            element += (end - begin) * projector.slots
            begin = end
        return laid

    def _index(self, laid: Sequence[_TilePart], columns: int) -> tuple[I64Array, BoolArray]:
        """Elements of the tile's planes in the order of the scan; wanted slots (columns, slots)."""
        if len(laid) == 1:
            return self._index_one(laid[0])
        wide = self._keep[:columns]
        shift = np.empty(columns, np.int64)
        elements = np.empty(columns * self._slots, np.int64) if self._is_ordered else None
        for one in laid:
            count, slots = one.part.keep.shape
            keep, element = one.projector.in_firing_order(one.part.keep, one.encoder)
            if elements is not None:
                own = slice(one.begin, one.begin + count * slots)
                within = self._element[: count * slots] if element is None else element
                np.add(within, one.begin, out=elements[own])
            wide[one.rows, :slots] = keep
            wide[one.rows, slots:] = False
            shift[one.rows] = self._element[one.begin : one.begin + count * slots : slots]
        shift -= self._element[: columns * self._slots : self._slots]
        index = wide.reshape(-1).nonzero()[0]
        index += shift.repeat(wanted_points(wide))
        return index if elements is None else elements.take(index), wide

    def _index_one(self, laid: _TilePart) -> tuple[I64Array, BoolArray]:
        """The same, where all columns were decoded together."""
        keep, element = laid.projector.in_firing_order(laid.part.keep, laid.encoder)
        if self._is_alone:
            index = keep.reshape(-1).nonzero()[0]
        else:
            count, slots = keep.shape
            place, number = np.empty(count, np.int64), self._element[:count]
            place[laid.rows] = number
            keep = keep.take(place, axis=0)
            index = keep.reshape(-1).nonzero()[0]
            place -= number
            place *= slots
            index += place.repeat(wanted_points(keep))
        return index if element is None else element.take(index), keep

    def _move(self, index: I64Array, buffer: ScanBuffer, at: int) -> None:
        """Copy the wanted points of a tile to their final rows, from row `at` on.

        No index is out of bounds; of what `take` might do then, to wrap is the fastest.
        """
        tile = self._tile
        rows = slice(at, at + len(index))
        whole = tile.point.view(np.complex128).reshape(-1)
        whole.take(index, out=buffer.point[rows].view(np.complex128).reshape(-1), mode="wrap")
        words = tile.label.view(np.uint64)
        words.take(index, out=buffer.label[rows].view(np.uint64), mode="wrap")
        if "range_m" in self._extras:
            tile.range_m.take(index, out=buffer.range_m[rows], mode="wrap")
        if "reflectivity" in self._extras:
            tile.reflectivity.take(index, out=buffer.reflectivity[rows], mode="wrap")

    def _place(
        self, laid: Sequence[_TilePart], due: WindowColumns, number: I64Array, buffer: ScanBuffer
    ) -> int:
        """Lay a tile down as it is, NaN and 0 where a slot is empty; gives its valid points.

        number: (n,) of the columns in the scan.
        """
        points = 0
        for one in laid:
            part, keep = one.part, one.part.keep
            points += int(np.count_nonzero(keep))
            row, slot = np.nonzero(keep)
            order = number[one.rows]
            buffer.clear(order)
            sensor = due.sensor[one.rows] + self._first_sensor
            buffer.label["lidar_id"][order] = sensor[:, None]
            at = (order[row], one.projector.number[slot])
            buffer.point[at] = part.point[keep]
            if "range_m" in self._extras:
                buffer.range_m[at] = part.range_m[keep]
            buffer.label[at] = part.label[keep]
            buffer.reflectivity[at] = part.reflectivity[keep]
        return points
