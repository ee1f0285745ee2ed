"""Raw columns of sensors of one kind to points in the body frame, in numpy; pixels are read once.

Columns are processed in tiles with few, reused arrays. Formulas: `lidar/geometry.py`; contents of
a pixel: `Lidar.read`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array
from mlbatch.decode.arena_ring import ArenaRing
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.decode.scan_buffer import LABEL, Labels
from mlbatch.lidar.geometry import Projection, Tabled, Turning, read_rotor_words
from mlbatch.lidar.interface import Lidar
from mlbatch.report.ledger import PointCounts
from mlbatch.types import Pixels

# Large enough to make calls cheap, small enough for the arrays to stay in the CPU caches; columns
# with rotor words need three times as many calls.
TILE_SLOTS = 1 << 15
ROTOR_TILE_SLOTS = 3 * TILE_SLOTS
_KEPT_VIEWS = 64
_NO_RETURN_M = np.float32(0)
# Return types, docs/sources/outputs.md section 3.
_STRONGEST_FIRST = np.uint8(3)
_SINGLE = np.uint8(7)
_SUM_OF_TYPES = np.uint8(9)
_MOST_OF_A_BYTE = 255
Extras: TypeAlias = frozenset[str]
Counts: TypeAlias = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True)
class Source:
    """A sensor as decoding sees it: lidar, raw packets, pose and limits.

    body_from_sensor: (4, 4) float64, m; ring_base: number of its first channel in the output;
    keep_repeated: keep duplicate returns.
    """

    lidar: Lidar
    ring: PacketRing | ArenaRing
    body_from_sensor: F64Array
    ring_base: int
    min_range_m: float = 0.0
    max_range_m: float = float("inf")
    keep_repeated: bool = False

    @property
    def slots(self) -> int:
        """Slots of a column: channels times returns."""
        return self.lidar.channels * self.lidar.returns


def tile_columns(sources: Sequence[Source]) -> int:
    """Return the columns of a tile with columns of these sensors."""
    has_rotors = any(source.lidar.beams.angle_rad is None for source in sources)
    tile_slots = ROTOR_TILE_SLOTS if has_rotors else TILE_SLOTS
    return max(16, tile_slots // max(source.slots for source in sources))


class Tile:
    """Scratch arrays for the slots of a tile of columns, flat: one projector after the other.

    point: (size, 4) float32, x, y, z in m and intensity; range_m: float32; reflectivity: uint16;
    label: LABEL; keep: bool, whether the slot becomes a point. The order of the scan comes from
    the index by which points are copied out, so that no array is reordered.
    """

    def __init__(self, size: int) -> None:
        self.point = np.zeros((size, 4), np.float32)
        self.range_m = np.zeros(size, np.float32)
        self.reflectivity = np.zeros(size, np.uint16)
        self.label = np.zeros(size, LABEL)
        self.keep = np.zeros(size, np.bool_)
        self._views: dict[tuple[int, int, int], TileView] = {}

    def view(self, begin: int, count: int, slots: int) -> TileView:
        """Return `count` columns of `slots` slots each, from element `begin`."""
        key = (begin, count, slots)
        view = self._views.get(key)
        if view is None:
            # Most tiles are alike; those of several projectors need not be.
            if len(self._views) == _KEPT_VIEWS:
                self._views.clear()
            view = self._views[key] = self._make_view(*key)
        return view

    def _make_view(self, begin: int, count: int, slots: int) -> TileView:
        elements = slice(begin, begin + count * slots)
        shape = (count, slots)
        return TileView(
            self.point[elements].reshape(*shape, 4),
            self.range_m[elements].reshape(shape),
            self.reflectivity[elements].reshape(shape),
            self.label[elements].reshape(shape),
            self.keep[elements].reshape(shape),
        )


class TileView(NamedTuple):
    """Columns of one projector in a tile: (n, slots) views of its arrays, `point` (n, slots, 4)."""

    point: F32Array
    range_m: F32Array
    reflectivity: U16Array
    label: Labels
    keep: BoolArray


class Projector:
    """Raw columns of sensors with equal pixel layouts to points in the body frame.

    The sensors are its members. Slots of a column are beams in wire order times returns.

    counts: point counters by member; labels: (members * firing tables, slots) uint64, label words
    without the time of the column; label_steps: (members,) uint64, to be added to the labels of
    their columns, like the time; number: (slots,) output slot of each slot; order: (firing
    tables, slots), slots in firing order, None if that is wire order; limits_m: (members, 2)
    float32, minimum and maximum range.
    """

    def __init__(
        self, members: Sequence[tuple[int, Source]], columns: int, boxes_m: F64Array, extras: Extras
    ) -> None:
        """members: index in the scan and source of each sensor; columns: most in one call."""
        sources = [source for _, source in members]
        self.counts = [PointCounts() for _ in sources]
        self.slots = sources[0].slots
        self.extras = extras
        self.sources = sources
        lidar = sources[0].lidar
        self.lidar = lidar
        self.boxes_m = boxes_m.astype(np.float32)
        self.projection = _projection(sources, columns)
        labels = [_labels(source, number) for number, source in members]
        self.labels = np.concatenate(labels).view(np.uint64)
        self._tables = len(lidar.firing_ns)
        # Labels of members with equal firing tables differ by one number in all slots.
        steps = self.labels - self.labels[0]
        self._has_one_label = self._tables == 1 and bool((steps == steps[:, :1]).all())
        self._labels_stay = False
        self.label_steps = np.zeros(len(sources), np.uint64)
        if self._has_one_label:
            self.label_steps = steps[:, 0].copy()
        self.order = _firing_order(lidar)
        channel = lidar.channel if lidar.channel.ndim == 1 else np.arange(lidar.channels)
        number = channel[:, None] * lidar.returns + np.arange(lidar.returns)
        self.number: I64Array = number.reshape(-1)
        limits = [(source.min_range_m, source.max_range_m) for source in sources]
        self.limits_m = np.array(limits, np.float32)
        self.is_limited = any(low > 0 or high < float("inf") for low, high in limits)
        self._needs_range = "range_m" in extras or self.is_limited
        self.drops_duplicates = lidar.sends_twice and not sources[0].keep_repeated
        # Sensors whose rotor turns while beams fire are projected one by one.
        self.is_sorted = len(sources) > 1 and not isinstance(self.projection, Tabled)
        self._columns = columns
        self._record = np.dtype((np.void, lidar.records.size))
        self._has_reflectivity = lidar.has_reflectivity and "reflectivity" in extras

    # Arrays for the columns of a call, made when first used: compiled loops need none.

    @cached_property
    def _repeated_labels(self) -> npt.NDArray[np.uint64]:
        return self.labels[:1].repeat(self._columns, axis=0)

    @cached_property
    def _elements(self) -> I64Array:
        """Tile elements of all columns in firing order, if all have the same."""
        if self.order is None:
            return np.arange(self._columns * self.slots)
        return self._ordered(np.zeros(self._columns, np.int64)).reshape(-1)

    @cached_property
    def _records(self) -> U8Array:
        return np.empty((self._columns, self.lidar.records.size), np.uint8)

    @cached_property
    def _of_member(self) -> U8Array:
        return np.empty_like(self._records)

    @cached_property
    def _range_m(self) -> F32Array:
        return np.empty((self.lidar.returns, self._columns, self.lidar.channels), np.float32)

    def project(
        self, member: I64Array, ring_index: I64Array, encoder: I64Array, view: TileView
    ) -> Counts:
        """Decode the columns at `ring_index` into `view`; mark and count the points to keep.

        member: (n,) member of each column, ascending if `is_sorted`; ring_index, encoder: (n,), as
        in `Columns`. Labels have no `column_label` yet. Return the points of each column (n,).
        """
        lidar = self.lidar
        records = self._gather(member, ring_index)
        self.projection.prepare(member, encoder)
        for which in range(lidar.returns):
            slots = slice(which, None, lidar.returns)
            # Return i of n is every n-th slot; a single return is read directly.
            range_m = view.range_m
            if lidar.returns > 1:
                range_m = self._range_m[which, : len(ring_index)]
            reflectivity = view.reflectivity[:, slots] if self._has_reflectivity else None
            lidar.read(records, which, Pixels(range_m, view.point[:, slots, 3], reflectivity))
            self.projection.project(range_m, view.point[:, slots, :3])
            if lidar.returns > 1 and self._needs_range:
                view.range_m[:, slots] = range_m
        if not lidar.has_reflectivity:
            view.reflectivity[:] = 0
        self._label(member, encoder, view)
        if lidar.returns == 2:
            self._type_returns(view)
        return self._keep(member, view)

    def _label(self, member: I64Array, encoder: I64Array, view: TileView) -> None:
        """Write the labels but for what all slots of a column share."""
        words = view.label.view(np.uint64)
        if not self._has_one_label:
            self.labels.take(self._label_row(member, encoder), axis=0, out=words, mode="clip")
        elif not self._labels_stay:
            words[:] = self._repeated_labels[: len(words)]

    def label_once(self, tile: Tile) -> None:
        """Label a whole tile that no other projector uses; its labels stay from then on."""
        if self._has_one_label:
            tile.label.view(np.uint64)[:] = self._repeated_labels.reshape(-1)
            self._labels_stay = True

    def in_firing_order(
        self, keep: BoolArray, encoder: I64Array
    ) -> tuple[BoolArray, I64Array | None]:
        """Return `keep` (n, slots) in firing order, and the tile elements (n * slots,) in it.

        The second is None where firing order is wire order.
        """
        if self.order is None:
            return keep, None
        if self._tables == 1:
            return keep.take(self.order[0], axis=1), self._elements[: keep.size]
        table = read_rotor_words(encoder)[2]
        order = self.order[table]
        return np.take_along_axis(keep, order, axis=1), self._ordered(table).reshape(-1)

    def slot_elements(self) -> I64Array | None:
        """Return the slot of a column that each slot of an organized row has; None: its own."""
        slots = np.arange(self.slots)
        if np.array_equal(self.number, slots):
            return None
        elements = self.number.argsort()
        if not np.array_equal(self.number[elements], slots):
            raise IndexError(f"expected {self.slots} slots, each once, found {self.number}")
        return elements

    def _ordered(self, table: I64Array) -> I64Array:
        """Return tile elements (n, slots), each column in firing order; table: (n,)."""
        order = np.arange(self.slots)[None] if self.order is None else self.order[table]
        return order + np.arange(len(table))[:, None] * self.slots

    def _label_row(self, member: I64Array, encoder: I64Array) -> I64Array:
        if self._tables == 1:
            return member
        return member * self._tables + read_rotor_words(encoder)[2]

    def _gather(self, member: I64Array, ring_index: I64Array) -> U8Array:
        """Return the records (n, records.size) of all columns, in their order."""
        records = self._records[: len(ring_index)]
        if len(self.sources) == 1:
            self.sources[0].ring.gather(ring_index, records)
            return records
        for number, source in enumerate(self.sources):
            own = (member == number).nonzero()[0]
            of_member = self._of_member[: len(own)]
            source.ring.gather(ring_index[own], of_member)
            records.view(self._record)[own] = of_member.view(self._record)
        return records

    def _type_returns(self, view: TileView) -> None:
        """Write the types of dual returns, by which is nearer and which is stronger.

        3 and 4: strongest, first and last; 5 and 6: weak, first and last; 7: single return.
        Source: docs/sources/outputs.md section 3.
        """
        lidar = self.lidar
        if not lidar.typed_by:
            return
        types = view.label["return_type"]
        first, second = self._range_m[:, : len(types)]
        # The types of the two returns of a shot add up to 9.
        kind = np.add(first > second, _STRONGEST_FIRST, dtype=np.uint8)
        if lidar.typed_by == "level":
            weaker = view.point[:, 0::2, 3] < view.point[:, 1::2, 3]
            kind += np.left_shift(weaker.view(np.uint8), np.uint8(1))
        is_single = (first == 0) | (second == 0)
        if lidar.sends_twice:
            is_single |= first == second
        # 7 has all bits of 3 to 6: "or" replaces them.
        single = is_single.view(np.uint8) * _SINGLE
        np.bitwise_or(kind, single, out=types[:, 0::2])
        np.bitwise_or(np.subtract(_SUM_OF_TYPES, kind, out=kind), single, out=types[:, 1::2])

    def _keep(self, member: I64Array, view: TileView) -> Counts:
        """Mark the points to keep; count the other slots by reason; return points by column."""
        keep = view.keep
        found, distinct = self._mark(view)
        in_range = distinct
        if self.is_limited:
            low, high = self.limits_m.take(member, axis=0).T[:, :, None]
            keep &= view.range_m >= low
            keep &= view.range_m <= high
            in_range = points_by_column(keep)
        kept = in_range
        if len(self.boxes_m):
            self._cut_boxes(view.point[..., :3], keep)
            kept = points_by_column(keep)
        self._count(member, found, distinct, in_range, kept)
        return kept

    def _mark(self, view: TileView) -> tuple[Counts, Counts]:
        """Mark the slots with a return that is no duplicate.

        A duplicate equals an earlier return of the same shot. Return the number of returns by
        column, and the number without duplicates.
        """
        keep = view.keep
        returns = self.lidar.returns
        if returns == 1:
            np.greater(view.range_m, _NO_RETURN_M, out=keep)
            found = points_by_column(keep)
            return found, found
        ranges_m = self._range_m[:, : len(keep)]
        for which, range_m in enumerate(ranges_m):
            np.greater(range_m, _NO_RETURN_M, out=keep[:, which::returns])
        found = points_by_column(keep)
        if not self.drops_duplicates:
            return found, found
        for which, range_m in enumerate(ranges_m):
            for earlier in ranges_m[:which]:
                keep[:, which::returns] &= range_m != earlier
        return found, points_by_column(keep)

    def _count(self, member: I64Array, *left: Counts) -> None:
        """Count slots by reason and member; left: by column, slots left after each step."""
        members = len(self.sources)
        slots = np.bincount(member, minlength=members) * self.slots
        sums: list[list[int]] = [slots.tolist()]
        last: Counts | None = None
        for by_column in left:
            if by_column is not last:
                total = np.bincount(member, by_column, members).astype(np.int64)
                sums.append(total.tolist())
                last = by_column
            else:
                sums.append(sums[-1])
        for counts, all_slots, found, distinct, in_range, kept in zip(
            self.counts, *sums, strict=True
        ):
            counts.slots += all_slots
            counts.no_return += all_slots - found
            counts.repeated += found - distinct
            counts.range += distinct - in_range
            counts.box += in_range - kept
            counts.written += kept

    def _cut_boxes(self, xyz: F32Array, keep: BoolArray) -> None:
        for box in self.boxes_m:
            inside = (xyz >= box[:3]) & (xyz <= box[3:])
            keep &= ~inside.all(axis=2)


def move(point: F32Array, moves: F32Array) -> None:
    """Move points (n, slots, 4) by the transforms (n, 3, 4) of their columns."""
    x, y, z = (point[:, :, axis].copy() for axis in range(3))
    for axis in range(3):
        first, second, third, constant = moves[:, axis, :, None].transpose(1, 0, 2)
        # The order of the operations is that of `native/decode.c`.
        moved = x * first
        moved += y * second
        moved += z * third
        moved += constant
        point[:, :, axis] = moved


def points_by_column(keep: BoolArray) -> Counts:
    """Return the number of marked slots of each column: keep (n, slots) to (n,)."""
    # Along short rows numpy's sum costs several times what einsum does.
    narrow = np.uint8 if keep.shape[1] <= _MOST_OF_A_BYTE else np.uint16
    return np.asarray(np.einsum("ij->i", keep.view(np.uint8), dtype=narrow))


def _projection(sources: Sequence[Source], columns: int) -> Projection:
    """Return the projection of ranges of these sensors to points in the body frame."""
    lidar = sources[0].lidar
    pose = sources[0].body_from_sensor
    own = lidar.projection(pose, columns)
    if own is not None:
        return own
    tables = [source.lidar.beams.moved(source.body_from_sensor) for source in sources]
    if lidar.beams.angle_rad is None:
        return Turning(tables[0], np.maximum(lidar.firing_ns, 0), columns, tables[1:])
    return Tabled(tables, columns)


def _firing_order(lidar: Lidar) -> I64Array | None:
    """Return slots by firing time, channel, return: (T, slots); None if that is wire order."""
    firing_ns = np.maximum(lidar.firing_ns, 0)
    channels = np.broadcast_to(lidar.channel, firing_ns.shape)
    beams = [np.lexsort(keys) for keys in zip(channels, firing_ns, strict=True)]
    order = np.stack(beams)[:, :, None] * lidar.returns + np.arange(lidar.returns)
    order = order.reshape(len(beams), -1)
    return None if bool((order == np.arange(order.shape[1])).all()) else order


def _labels(source: Source, lidar_id: int) -> Labels:
    """Return labels of a column whose timestamp is 0: (T, slots); T: firing tables."""
    lidar = source.lidar
    slot = np.arange(source.slots)
    beam = slot // lidar.returns
    label = np.zeros((len(lidar.firing_ns), source.slots), LABEL)
    label["time_ns"] = np.maximum(lidar.firing_ns, 0)[:, beam]
    channel = np.broadcast_to(lidar.channel, lidar.firing_ns.shape)
    label["ring"] = source.ring_base + channel[:, beam]
    label["return_type"] = np.array(lidar.return_types, np.uint8)[slot % lidar.returns]
    label["lidar_id"] = lidar_id
    return label
