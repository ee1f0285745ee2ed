"""The engine `numpy`: decodes a window tile by tile, by passes over arrays that fit the caches.

The columns of a tile are decoded sensor by sensor, those of one projector in one call
(`projector.py`); the index by which points are copied out of the tile has the order of the scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.decode.engine import EngineSetup
from mlbatch.decode.projector import Projector, Tile, TileView, move, points_by_column
from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.types import RecordLayout, WindowColumns

# Four NaN of float32 in one number.
_NO_POINT = np.full(4, np.nan, np.float32).view(np.complex128)
# The sensor in a label.
_LIDAR_ID_BIT = np.uint64(56)


@dataclass(slots=True)
class _TilePart:
    """Columns of a tile that one projector decoded.

    rows: (n,) their positions in the tile's share of the scan; begin: first element in the arrays
    of the tile; encoder: (n,).
    """

    projector: Projector
    view: TileView
    rows: I64Array
    begin: int
    encoder: I64Array


class NumpyEngine:
    """Decodes the columns of the sensors of some projectors; skips those of other sensors."""

    def __init__(self, setup: EngineSetup) -> None:
        projectors = setup.projectors
        seat = setup.seat
        # Writers pack its arrays (`writers/point_layouts.py`).
        self.record: RecordLayout | None = None
        self._projectors = projectors
        self._columns = setup.tile_columns
        self._first_sensor = setup.first_sensor
        self._extras = setup.extras
        self._slots = max(projector.slots for projector in projectors)
        self._tile = Tile(self._columns * self._slots)
        self._keep = np.zeros((self._columns, self._slots), np.bool_)
        self._element = np.arange(self._columns * self._slots)
        self._is_ordered = any(projector.order is not None for projector in projectors)
        # All members of all projectors, one after the other.
        members = [len(one.sources) for one in projectors]
        self._member = np.concatenate([np.arange(count) for count in members])
        self._ends = np.cumsum(members)
        self._is_alone = len(self._member) == 1
        # By sensor: its index in that order; skipped sensors come after all others.
        self._is_partial = bool((seat < 0).any())
        first = np.array([0, *self._ends])[seat[:, 0]]
        skipped = len(self._member)
        self._seat = np.where(seat[:, 0] < 0, skipped, first + seat[:, 1]).astype(np.uint8)

    def decode(
        self,
        columns: WindowColumns,
        start_ns: int,
        first_number: int,
        out: ScanBuffer,
        points: I64Array | None = None,
    ) -> int:
        """See `Engine`; points: (n,), receives the number of points of each decoded column."""
        count = 0
        # Tiles of equal size: the cost of a small one is mostly that of its calls.
        tiles = max(1, -(-len(columns) // self._columns))
        bounds = [len(columns) * tile // tiles for tile in range(tiles + 1)]
        for begin, end in pairwise(bounds):
            number: I64Array = np.arange(first_number + begin, first_number + end)
            some = columns.take(slice(begin, end))
            own: I64Array | None = None
            if self._is_partial:
                own = (self._seat[some.sensor] < len(self._member)).nonzero()[0]
                some = some.take(own)
                number = number[own]
            if not len(some):
                continue
            parts = self._project(some, start_ns)
            if out.is_organized:
                count += self._write_organized(parts, some, number, out)
                continue
            index, keep = self._index(parts, len(some))
            self._write_dense(index, out, count)
            if points is not None:
                points[begin:end][slice(None) if own is None else own] = points_by_column(keep)
            elif "column" in self._extras:
                out.column[count : count + len(index)] = number.repeat(points_by_column(keep))
            count += len(index)
        return count

    def _project(self, columns: WindowColumns, start_ns: int) -> list[_TilePart]:
        """Decode the columns of one tile, projector by projector."""
        seat = self._seat[columns.sensor]
        rows = self._element[: len(columns)]
        if not self._is_alone:
            rows = seat.argsort(kind="stable")
            columns = columns.take(rows)
            seat = seat[rows]
        member = self._member[seat]
        offset_ns = columns.stamp_ns - start_ns
        parts: list[_TilePart] = []
        element = 0
        begin = 0
        ends = np.searchsorted(seat, self._ends).tolist()
        for projector, end in zip(self._projectors, ends, strict=True):
            if begin == end:
                continue
            own = slice(begin, end)
            view = self._tile.view(element, end - begin, projector.slots)
            encoder = columns.encoder[own]
            projector.project(member[own], columns.ring_index[own], encoder, offset_ns[own], view)
            if columns.moves is not None:
                # After the filters, whose boxes are in the body frame of each column.
                move(view.point, columns.moves[own])
            parts.append(_TilePart(projector, view, rows[own], element, encoder))
            element += (end - begin) * projector.slots
            begin = end
        return parts

    def _index(self, parts: Sequence[_TilePart], columns: int) -> tuple[I64Array, BoolArray]:
        """Return tile elements of the points in scan order, and marked slots (columns, slots)."""
        if len(parts) == 1:
            return self._index_of_one(parts[0])
        marked = self._keep[:columns]
        shift = np.empty(columns, np.int64)
        elements = np.empty(columns * self._slots, np.int64) if self._is_ordered else None
        for part in parts:
            count, slots = part.view.keep.shape
            keep, element = part.projector.in_firing_order(part.view.keep, part.encoder)
            if elements is not None:
                own = slice(part.begin, part.begin + count * slots)
                within = self._element[: count * slots] if element is None else element
                np.add(within, part.begin, out=elements[own])
            marked[part.rows, :slots] = keep
            marked[part.rows, slots:] = False
            shift[part.rows] = self._element[part.begin : part.begin + count * slots : slots]
        shift -= self._element[: columns * self._slots : self._slots]
        index = marked.reshape(-1).nonzero()[0]
        index += shift.repeat(points_by_column(marked))
        return index if elements is None else elements.take(index), marked

    def _index_of_one(self, part: _TilePart) -> tuple[I64Array, BoolArray]:
        """Do the same for a tile of one projector."""
        keep, element = part.projector.in_firing_order(part.view.keep, part.encoder)
        if self._is_alone:
            index = keep.reshape(-1).nonzero()[0]
        else:
            count, slots = keep.shape
            position = np.empty(count, np.int64)
            number = self._element[:count]
            position[part.rows] = number
            keep = keep.take(position, axis=0)
            index = keep.reshape(-1).nonzero()[0]
            position -= number
            position *= slots
            index += position.repeat(points_by_column(keep))
        return index if element is None else element.take(index), keep

    def _write_dense(self, index: I64Array, out: ScanBuffer, first_row: int) -> None:
        """Copy the tile elements at `index` to rows from `first_row`.

        No index is out of bounds; of the modes of `take`, "wrap" is the fastest.
        """
        tile = self._tile
        rows = slice(first_row, first_row + len(index))
        # Four float32 move as one element of 16 bytes.
        points = tile.point.view(np.complex128).reshape(-1)
        points.take(index, out=out.point[rows].view(np.complex128).reshape(-1), mode="wrap")
        labels = tile.label.view(np.uint64)
        labels.take(index, out=out.label[rows].view(np.uint64), mode="wrap")
        if "range_m" in self._extras:
            tile.range_m.take(index, out=out.range_m[rows], mode="wrap")
        if "reflectivity" in self._extras:
            tile.reflectivity.take(index, out=out.reflectivity[rows], mode="wrap")

    def _write_organized(
        self,
        parts: Sequence[_TilePart],
        columns: WindowColumns,
        number: I64Array,
        out: ScanBuffer,
    ) -> int:
        """Write a tile to rows `number` (n,), empty slots included; return its points."""
        points = 0
        for part in parts:
            view = part.view
            points += int(np.count_nonzero(view.keep))
            rows = number[part.rows]
            slots = part.projector.slots
            if slots < out.point.shape[1]:
                out.clear(rows)
                out.label["lidar_id"][rows] = (columns.sensor[part.rows] + self._first_sensor)[
                    :, None
                ]
            self._empty(view, columns.sensor[part.rows])
            # Whole rows, since to choose points costs more than to move the empty slots.
            element = part.projector.slot_elements()
            own = (rows, slice(slots)) if slots < out.point.shape[1] else rows
            pairs: list[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = [
                (view.point.view(np.complex128)[..., 0], out.point.view(np.complex128)[..., 0]),
                (view.label.view(np.uint64), out.label.view(np.uint64)),
                (view.reflectivity, out.reflectivity),
                (view.range_m, out.range_m),
            ]
            for values, target in pairs:
                target[own] = values if element is None else values.take(element, axis=1)
        return points

    def _empty(self, view: TileView, sensor: I64Array) -> None:
        """Empty the slots without a point of columns (n,), as `ScanBuffer.clear`."""
        empty = ~view.keep
        lidar_id = (sensor + self._first_sensor).astype(np.uint64) << _LIDAR_ID_BIT
        np.copyto(view.point.view(np.complex128)[..., 0], _NO_POINT, where=empty)
        np.copyto(view.label.view(np.uint64), lidar_id[:, None], where=empty)
        np.copyto(view.reflectivity, np.uint16(0), where=empty)
        is_unknown = empty if "range_m" in self._extras else True
        np.copyto(view.range_m, np.float32("nan"), where=is_unknown)
