"""The engine `numpy`: decodes a window tile by tile, by passes over arrays that fit the caches.

The columns of a tile are decoded projector by projector, each in one call (`projector.py`), in
the order of the scan or, where a projector needs it, by sensor; the index by which points are
copied out of the tile has the order of the scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I64Array, U64Array
from mlbatch.decode.engine import EngineSetup
from mlbatch.decode.projector import Counts, Projector, Tile, TileView, move
from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.types import RecordLayout, WindowColumns

# Four NaN of float32 in one number.
_NO_POINT = np.full(4, np.nan, np.float32).view(np.complex128)
# The sensor in a label.
_LIDAR_ID_BIT = np.uint64(56)


class _TilePart(NamedTuple):
    """Columns of a tile that one projector decoded.

    rows: (n,) their positions in the tile's share of the scan; begin: first element in the arrays
    of the tile; encoder: (n,); points: (n,), of each column.
    """

    projector: Projector
    view: TileView
    rows: I64Array
    begin: int
    encoder: I64Array
    points: Counts


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
        if len(projectors) == 1:
            projectors[0].label_once(self._tile)
        self._keep = np.zeros((self._columns, self._slots), np.bool_)
        self._element = np.arange(self._columns * self._slots)
        self._is_ordered = any(projector.order is not None for projector in projectors)
        # Columns are sorted by key: the projector, and the member where that needs it.
        keys = [len(one.sources) if one.is_sorted else 1 for one in projectors]
        self._ends = np.cumsum(keys)
        self._is_alone = int(self._ends[-1]) == 1
        # By sensor; skipped sensors come after all others.
        self._is_partial = bool((seat < 0).any())
        self._skipped = int(self._ends[-1])
        first = np.array([0, *self._ends])[seat[:, 0]]
        within = np.array([one.is_sorted for one in projectors])[seat[:, 0]] * seat[:, 1]
        self._key = np.where(seat[:, 0] < 0, self._skipped, first + within).astype(np.uint8)
        # Rows of an organized scan in the order of tiles can be tiles themselves.
        self._is_in_place = (
            self._is_alone
            and not self._is_partial
            and setup.organized_slots == self._slots
            and projectors[0].slot_elements() is None
        )
        self._member = np.maximum(seat[:, 1], 0)
        self._label_step = np.array(
            [projectors[which].label_steps[member] for which, member in seat], np.uint64
        )

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
        all_shared = self._column_labels(columns, start_ns)
        for begin, end in pairwise(bounds):
            number: I64Array = np.arange(first_number + begin, first_number + end)
            some = columns.take(slice(begin, end))
            shared = all_shared[begin:end]
            own: I64Array | None = None
            if self._is_partial:
                own = (self._key[some.sensor] < self._skipped).nonzero()[0]
                some = some.take(own)
                number = number[own]
                shared = shared[own]
            if not len(some):
                continue
            if self._is_in_place:
                count += self._write_in_place(some, shared, first_number + begin, out)
                continue
            parts = self._project(some)
            if out.is_organized:
                count += self._write_organized(parts, some, number, shared, out)
                continue
            index, by_column = self._index(parts, len(some))
            self._write_dense(index, shared.repeat(by_column), out, count)
            if points is not None:
                points[begin:end][slice(None) if own is None else own] = by_column
            elif "column" in self._extras:
                out.column[count : count + len(index)] = number.repeat(by_column)
            count += len(index)
        return count

    def _project(self, columns: WindowColumns) -> list[_TilePart]:
        """Decode the columns of one tile, projector by projector."""
        rows = self._element[: len(columns)]
        bounds = [len(columns)]
        if not self._is_alone:
            key = self._key[columns.sensor]
            rows = key.argsort(kind="stable")
            columns = columns.take(rows)
            bounds = np.searchsorted(key[rows], self._ends).tolist()
        member = self._member[columns.sensor]
        parts: list[_TilePart] = []
        element = 0
        begin = 0
        for projector, end in zip(self._projectors, bounds, strict=True):
            if begin == end:
                continue
            own = slice(begin, end)
            view = self._tile.view(element, end - begin, projector.slots)
            encoder = columns.encoder[own]
            points = projector.project(member[own], columns.ring_index[own], encoder, view)
            if columns.moves is not None:
                # After the filters, whose boxes are in the body frame of each column.
                move(view.point, columns.moves[own])
            parts.append(_TilePart(projector, view, rows[own], element, encoder, points))
            element += (end - begin) * projector.slots
            begin = end
        return parts

    def _index(self, parts: Sequence[_TilePart], columns: int) -> tuple[I64Array, Counts]:
        """Return tile elements of the points in scan order, and points by column (columns,)."""
        if len(parts) == 1:
            return self._index_of_one(parts[0])
        marked = self._keep[:columns]
        points = np.empty(columns, np.uint16)
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
            points[part.rows] = part.points
            shift[part.rows] = self._element[part.begin : part.begin + count * slots : slots]
        shift -= self._element[: columns * self._slots : self._slots]
        index = marked.reshape(-1).nonzero()[0]
        index += shift.repeat(points)
        return index if elements is None else elements.take(index), points

    def _index_of_one(self, part: _TilePart) -> tuple[I64Array, Counts]:
        """Do the same for a tile of one projector."""
        keep, element = part.projector.in_firing_order(part.view.keep, part.encoder)
        points = part.points
        if self._is_alone:
            index = keep.reshape(-1).nonzero()[0]
        else:
            count, slots = keep.shape
            position = np.empty(count, np.int64)
            number = self._element[:count]
            position[part.rows] = number
            keep = keep.take(position, axis=0)
            points = points[position]
            index = keep.reshape(-1).nonzero()[0]
            position -= number
            position *= slots
            index += position.repeat(points)
        return index if element is None else element.take(index), points

    def _column_labels(self, columns: WindowColumns, start_ns: int) -> U64Array:
        """Return what all labels of a column share (n,): its time, and the step of its sensor."""
        words: U64Array = (columns.stamp_ns - start_ns).view(np.uint64)
        words += self._label_step.take(columns.sensor)
        return words

    def _write_dense(
        self, index: I64Array, shared: U64Array, out: ScanBuffer, first_row: int
    ) -> None:
        """Copy the tile elements at `index` to rows from `first_row`.

        shared: (points,), added to labels. No index is out of bounds; of the modes of `take`,
        "wrap" is the fastest.
        """
        tile = self._tile
        rows = slice(first_row, first_row + len(index))
        # Four float32 move as one element of 16 bytes.
        points = tile.point.view(np.complex128).reshape(-1)
        points.take(index, out=out.point[rows].view(np.complex128).reshape(-1), mode="wrap")
        labels = out.label[rows].view(np.uint64)
        tile.label.view(np.uint64).take(index, out=labels, mode="wrap")
        labels += shared
        if "range_m" in self._extras:
            tile.range_m.take(index, out=out.range_m[rows], mode="wrap")
        if "reflectivity" in self._extras:
            tile.reflectivity.take(index, out=out.reflectivity[rows], mode="wrap")

    def _write_organized(
        self,
        parts: Sequence[_TilePart],
        columns: WindowColumns,
        number: I64Array,
        shared: U64Array,
        out: ScanBuffer,
    ) -> int:
        """Write a tile to rows `number` (n,), empty slots included; return its points.

        shared: (n,), of `_column_labels`.
        """
        points = 0
        for part in parts:
            view = part.view
            points += int(part.points.sum())
            rows = number[part.rows]
            slots = part.projector.slots
            if slots < out.point.shape[1]:
                out.clear(rows)
                out.label["lidar_id"][rows] = (columns.sensor[part.rows] + self._first_sensor)[
                    :, None
                ]
            label = view.label.view(np.uint64) + shared[part.rows][:, None]
            self._empty(view, label, columns.sensor[part.rows])
            # Whole rows, since to choose points costs more than to move the empty slots.
            element = part.projector.slot_elements()
            own = (rows, slice(slots)) if slots < out.point.shape[1] else rows
            pairs: list[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = [
                (view.point.view(np.complex128)[..., 0], out.point.view(np.complex128)[..., 0]),
                (label, out.label.view(np.uint64)),
                (view.reflectivity, out.reflectivity),
                (view.range_m, out.range_m),
            ]
            for values, target in pairs:
                target[own] = values if element is None else values.take(element, axis=1)
        return points

    def _write_in_place(
        self, columns: WindowColumns, shared: U64Array, first_row: int, out: ScanBuffer
    ) -> int:
        """Decode a tile to the rows of an organized scan from `first_row`; return its points.

        shared: (n,), of `_column_labels`.
        """
        (projector,) = self._projectors
        scratch = self._tile.view(0, len(columns), self._slots)
        rows = slice(first_row, first_row + len(columns))
        view = scratch._replace(
            point=out.point[rows],
            range_m=out.range_m[rows],
            reflectivity=out.reflectivity[rows],
        )
        member = self._member[columns.sensor]
        points = projector.project(member, columns.ring_index, columns.encoder, view)
        if columns.moves is not None:
            move(view.point, columns.moves)
        label = out.label[rows].view(np.uint64)
        np.add(scratch.label.view(np.uint64), shared[:, None], out=label)
        self._empty(view, label, columns.sensor)
        return int(points.sum())

    def _empty(self, view: TileView, label: U64Array, sensor: I64Array) -> None:
        """Empty the slots without a point of columns (n,), as `ScanBuffer.clear`."""
        empty = ~view.keep
        lidar_id = (sensor + self._first_sensor).astype(np.uint64) << _LIDAR_ID_BIT
        np.copyto(view.point.view(np.complex128)[..., 0], _NO_POINT, where=empty)
        np.copyto(label, lidar_id[:, None], where=empty)
        np.copyto(view.reflectivity, np.uint16(0), where=empty)
        is_unknown = empty if "range_m" in self._extras else True
        np.copyto(view.range_m, np.float32("nan"), where=is_unknown)
