"""The engine `numpy`: a window tile by tile, few passes over planes that stay in the caches.

Sensors of one kind are projected together (`projection.py`); the index by which the valid points
leave the tile lays their columns between those of other kinds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.buffers import Buffer, Due
from mlbatch.projection import Extras, Part, Projector, Tile, wanted_points
from mlbatch.types import BoolArray, I64Array


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


class Tiles:
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
        self._seat = seat
        self._columns = columns
        self._first_sensor = first_sensor
        self._extras = extras
        self._slots = max(projector.slots for projector in projectors)
        self._tile = Tile(columns * self._slots)
        self._keep = np.zeros((columns, self._slots), np.bool_)
        self._element = np.empty(columns * self._slots, np.int64)

    def decode(
        self, due: Due, start_ns: int, first: int, out: Buffer, points: I64Array | None = None
    ) -> int:
        """As `compiled.CompiledKind.decode`."""
        count = 0
        for begin in range(0, len(due), self._columns):
            tile = slice(begin, min(begin + self._columns, len(due)))
            laid = self._project(due, tile, start_ns)
            if not laid:
                continue
            if out.is_organized:
                count += self._place(laid, due, tile, first, out)
            else:
                count += self._compress(laid, tile, first, out, count, points)
        return count

    def _project(self, due: Due, tile: slice, start_ns: int) -> list[_Laid]:
        """Decode the columns of one tile, kind by kind."""
        place, encoder = due.place[tile], due.encoder[tile]
        offset_ns = due.stamp_ns[tile] - start_ns
        which, member = self._seat[due.sensor[tile]].T
        laid: list[_Laid] = []
        begin = 0
        counts = np.bincount(which + 1, minlength=1)[1:].tolist()
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

    def _compress(
        self,
        laid: Sequence[_Laid],
        columns: slice,
        first: int,
        buffer: Buffer,
        at: int,
        points: I64Array | None,
    ) -> int:
        """Move the wanted points of a tile to their final rows; gives their number."""
        tile = self._tile
        index, keep = self._index(laid, columns.stop - columns.start)
        rows = slice(at, at + len(index))
        whole = tile.point.view(np.complex128).reshape(-1)
        whole.take(index, out=buffer.point[rows].view(np.complex128).reshape(-1), mode="clip")
        words = tile.label.view(np.uint64)
        words.take(index, out=buffer.label[rows].view(np.uint64), mode="clip")
        if "range_m" in self._extras:
            tile.range_m.take(index, out=buffer.range_m[rows], mode="clip")
        if "reflectivity" in self._extras:
            tile.reflectivity.take(index, out=buffer.reflectivity[rows], mode="clip")
        if points is not None:
            own = laid[0].rows if len(laid) == 1 else slice(None)
            points[columns][own] = wanted_points(keep)
        elif "column" in self._extras:
            number = np.arange(first + columns.start, first + columns.stop, dtype=np.uint32)
            buffer.column[rows] = number.repeat(wanted_points(keep))
        return len(index)

    def _place(
        self, laid: Sequence[_Laid], due: Due, columns: slice, first: int, buffer: Buffer
    ) -> int:
        """Lay a tile down as it is, NaN and 0 where a slot is empty; gives its valid points."""
        points = 0
        for one in laid:
            part, keep = one.part, one.part.keep
            points += int(np.count_nonzero(keep))
            row, slot = np.nonzero(keep)
            order = np.arange(first + columns.start, first + columns.stop)[one.rows]
            buffer.clear(order)
            sensor = due.sensor[columns][one.rows] + self._first_sensor
            buffer.label["lidar_id"][order] = sensor[:, None]
            at = (order[row], one.projector.number[slot])
            buffer.point[at] = part.point[keep]
            if "range_m" in self._extras:
                buffer.range_m[at] = part.range_m[keep]
            buffer.label[at] = part.label[keep]
            buffer.reflectivity[at] = part.reflectivity[keep]
        return points
