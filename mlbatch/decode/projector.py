"""Raw columns of sensors of one kind to points in the body frame: every pixel is read once.

Work is done in tiles of columns, whose planes are few and reused. The formulas are those of
`geometry.py`; what a pixel holds is the sensor's own business (`Lidar.read`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F32Array, F64Array, I64Array, U8Array, U16Array
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.decode.scan_buffer import LABEL, Labels
from mlbatch.lidar.geometry import Projection, Tabled, Turning, blocks, read_rotor_words
from mlbatch.lidar.interface import Lidar
from mlbatch.report.ledger import PointCounts
from mlbatch.types import Pixels

# Enough work for a call to be cheap, little enough for the planes to stay in the caches.
TILE_SLOTS = 3 << 15
_NONE = np.float32(0)
_ONLY, _FIRST_STRONG, _BOTH = np.uint8(7), np.uint8(3), np.uint8(9)
_MOST_OF_A_BYTE = 255
Extras: TypeAlias = frozenset[str]
Counts: TypeAlias = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(slots=True)
class Source:
    """A sensor, its raw packets, and what of its points is wanted; ranges in m, 0 and inf: all."""

    lidar: Lidar
    ring: PacketRing
    body_from_sensor: F64Array
    ring_base: int
    min_range_m: float = 0.0
    max_range_m: float = float("inf")
    keep_repeated: bool = False

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

    def part(self, begin: int, count: int, slots: int) -> TileView:
        """`count` columns of `slots` slots each, from element `begin` on."""
        place, shape = slice(begin, begin + count * slots), (count, slots)
        return TileView(
            self.point[place].reshape(*shape, 4),
            self.range_m[place].reshape(shape),
            self.reflectivity[place].reshape(shape),
            self.label[place].reshape(shape),
            self.keep[place].reshape(shape),
        )


@dataclass(slots=True)
class TileView:
    """The part of one sensor in a tile: (n, slots) views, `point` (n, slots, 4)."""

    point: F32Array
    range_m: F32Array
    reflectivity: U16Array
    label: Labels
    keep: BoolArray


class Projector:
    """Sensors whose pixels decode alike: from places in their rings to points in the body frame.

    They are decoded together, one after the other; `counts` has one ledger for each. Slots of a
    column are beams, in the order of the wire, times returns; `firing_order` and `number` tell
    where they belong.

    labels: what the points of a column are, a row for each sensor or firing table; order: slots in
    the order of firing, (tables, slots), None if that is the order of the wire; limits_m: of each
    sensor.
    """

    def __init__(
        self, members: Sequence[tuple[int, Source]], columns: int, boxes_m: F64Array, extras: Extras
    ) -> None:
        """members: number of each sensor in the scan, and how to read it.

        columns: the most that are projected at once.
        """
        sources = [source for _, source in members]
        self.counts = [PointCounts() for _ in sources]
        self.slots = sources[0].slots
        self.extras = extras
        self.sources = sources
        self.lidar = lidar = sources[0].lidar
        self.boxes_m = boxes_m.astype(np.float32)
        self.projection = _projection(sources, columns)
        labels = [_labels(source, number) for number, source in members]
        self.labels = np.concatenate(labels).view(np.uint64)
        self._tables = len(lidar.firing_ns)
        # Those of sensors that fire alike differ by one number for all slots.
        steps = self.labels - self.labels[0]
        self._label_steps = steps[:, 0].copy()
        self._repeated_labels: npt.NDArray[np.uint64] | None = None
        if self._tables == 1 and bool((steps == steps[:, :1]).all()):
            self._repeated_labels = self.labels[:1].repeat(columns, axis=0)
        self.order = _firing_order(lidar)
        self._elements = np.arange(columns * self.slots)
        if self.order is not None and self._tables == 1:
            self._elements = self._ordered(np.zeros(columns, np.int64)).reshape(-1)
        channel = lidar.channel if lidar.channel.ndim == 1 else np.arange(lidar.channels)
        number = channel[:, None] * lidar.returns + np.arange(lidar.returns)
        self.number: I64Array = number.reshape(-1)
        limits = [(source.min_range_m, source.max_range_m) for source in sources]
        self.limits_m = np.array(limits, np.float32)
        self.is_limited = any(low > 0 or high < float("inf") for low, high in limits)
        self._needs_range = "range_m" in extras or self.is_limited
        self.drops_repeated = lidar.sends_twice and not sources[0].keep_repeated
        self._records = np.empty((columns, lidar.records.size), np.uint8)
        self._range_m = np.empty((lidar.returns, columns, lidar.channels), np.float32)
        self._has_reflectivity = lidar.has_reflectivity and "reflectivity" in extras

    def project(
        self,
        member: I64Array,
        place: I64Array,
        encoder: I64Array,
        offset_ns: I64Array,
        part: TileView,
    ) -> None:
        """Decode the columns at `place` into `part`, and mark the wanted points.

        member: (n,) which of the sensors each column is of, rising; place, encoder: as in Columns;
        offset_ns: (n,) stamp minus start of the scan.
        """
        lidar = self.lidar
        own = blocks(member, len(self.sources))
        records = self._gathered(own, place)
        self.projection.prepare(member, encoder)
        for which in range(lidar.returns):
            slots = slice(which, None, lidar.returns)
            # One return fills its plane in one piece; of several, each is every n-th slot.
            range_m = part.range_m if lidar.returns == 1 else self._range_m[which, : len(place)]
            reflectivity = part.reflectivity[:, slots] if self._has_reflectivity else None
            lidar.read(records, which, Pixels(range_m, part.point[:, slots, 3], reflectivity))
            self.projection.project(range_m, part.point[:, slots, :3])
            if lidar.returns > 1 and self._needs_range:
                part.range_m[:, slots] = range_m
        if not lidar.has_reflectivity:
            part.reflectivity[:] = 0
        self._label(member, encoder, offset_ns, part)
        if lidar.returns == 2:
            self._type_returns(part)
        self._keep(own, part)

    def _label(
        self, member: I64Array, encoder: I64Array, offset_ns: I64Array, part: TileView
    ) -> None:
        """What the points are, their times included."""
        words, offset = part.label.view(np.uint64), offset_ns.astype(np.uint64)
        if self._repeated_labels is None:
            self.labels.take(self._row(member, encoder), axis=0, out=words, mode="clip")
            words += offset[:, None]
            return
        # A sum of whole planes costs less than one that repeats a row.
        np.copyto(words, (offset + self._label_steps[member])[:, None])
        words += self._repeated_labels[: len(words)]

    def in_firing_order(
        self, keep: BoolArray, encoder: I64Array
    ) -> tuple[BoolArray, I64Array | None]:
        """Wanted slots (n, slots) in the order of firing, and the elements where they lie.

        (n * slots,); None where the order of the wire is that of firing.
        """
        if self.order is None:
            return keep, None
        if self._tables == 1:
            return keep.take(self.order[0], axis=1), self._elements[: keep.size]
        _, _, table = read_rotor_words(encoder)
        order = self.order[table]
        return np.take_along_axis(keep, order, axis=1), self._ordered(table).reshape(-1)

    def _ordered(self, table: I64Array) -> I64Array:
        """Elements of a tile of these columns, each column in the order of firing."""
        order = np.arange(self.slots)[None] if self.order is None else self.order[table]
        return order + np.arange(len(table))[:, None] * self.slots

    def _row(self, member: I64Array, encoder: I64Array) -> I64Array:
        if self._tables == 1:
            return member
        return member * self._tables + read_rotor_words(encoder)[2]

    def _gathered(self, blocks: Sequence[slice], place: I64Array) -> U8Array:
        """Records of all columns, in their order."""
        for source, own in zip(self.sources, blocks, strict=True):
            source.ring.gather(place[own], self._records[own])
        return self._records[: len(place)]

    def _type_returns(self, part: TileView) -> None:
        """Numbering of facts/outputs.md section 3, by which of two returns is nearer and stronger.

        3 and 4: strongest, first and last; 5 and 6: weak, first and last; 7: there is only one.
        """
        lidar = self.lidar
        if not lidar.typed_by:
            return
        types = part.label["return_type"]
        first, second = self._range_m[:, : len(types)]
        # The types of two returns that differ add up to 9.
        kind = np.add(first > second, _FIRST_STRONG, dtype=np.uint8)
        if lidar.typed_by == "level":
            weaker = part.point[:, 0::2, 3] < part.point[:, 1::2, 3]
            kind += np.left_shift(weaker.view(np.uint8), np.uint8(1))
        alone = (first == 0) | (second == 0)
        if lidar.sends_twice:
            alone |= first == second
        # All bits of 3 to 6 are bits of 7, so that it wins by a plain "or".
        only = alone.view(np.uint8) * _ONLY
        np.bitwise_or(kind, only, out=types[:, 0::2])
        np.bitwise_or(np.subtract(_BOTH, kind, out=kind), only, out=types[:, 1::2])

    def _keep(self, blocks: Sequence[slice], part: TileView) -> None:
        """Mark the points that are wanted, and count the others under their reason."""
        keep = part.keep
        found, left = self._mark(blocks, part)
        for counts, own, points, wanted in zip(self.counts, blocks, found, left, strict=True):
            slots = (own.stop - own.start) * self.slots
            counts.slots += slots
            counts.no_return += slots - points
            counts.repeated += points - wanted
        if self.is_limited:
            for own, (low, high) in zip(blocks, self.limits_m, strict=True):
                keep[own] &= part.range_m[own] >= low
                keep[own] &= part.range_m[own] <= high
            left = self._drop("range", blocks, keep, left)
        if len(self.boxes_m):
            self._cut_boxes(part.point[..., :3], keep)
            left = self._drop("box", blocks, keep, left)
        for counts, points in zip(self.counts, left, strict=True):
            counts.written += points

    def _drop(
        self, reason: str, blocks: Sequence[slice], keep: BoolArray, before: list[int]
    ) -> list[int]:
        left = _left(blocks, keep)
        for counts, had, has in zip(self.counts, before, left, strict=True):
            setattr(counts, reason, getattr(counts, reason) + had - has)
        return left

    def _mark(self, blocks: Sequence[slice], part: TileView) -> tuple[list[int], list[int]]:
        """Mark the slots with a return; how many there are, and how many equal no earlier one.

        Both for each sensor. A return that equals an earlier one of the same shot is not marked.
        """
        keep, returns = part.keep, self.lidar.returns
        if returns == 1:
            np.greater(part.range_m, _NONE, out=keep)
            found = _left(blocks, keep)
            return found, found
        ranges_m = self._range_m[:, : len(keep)]
        found, left = [0] * len(self.sources), [0] * len(self.sources)
        for which, range_m in enumerate(ranges_m):
            own = range_m > _NONE
            found = list(map(int.__add__, found, _left(blocks, own)))
            if self.drops_repeated:
                for earlier in ranges_m[:which]:
                    own &= range_m != earlier
            left = list(map(int.__add__, left, _left(blocks, own)))
            keep[:, which::returns] = own
        return found, left

    def _cut_boxes(self, xyz: F32Array, keep: BoolArray) -> None:
        for box in self.boxes_m:
            inside = (xyz >= box[:3]) & (xyz <= box[3:])
            keep &= ~inside.all(axis=2)


def _left(blocks: Sequence[slice], keep: BoolArray) -> list[int]:
    """Points that are still wanted, of each sensor."""
    return [int(np.count_nonzero(keep[own])) for own in blocks]


def wanted_points(keep: BoolArray) -> Counts:
    """How many points of each column (n, slots) are wanted: (n,)."""
    # Short rows are where sums along an axis cost most; einsum's cost least.
    narrow = np.uint8 if keep.shape[1] <= _MOST_OF_A_BYTE else np.uint16
    return np.asarray(np.einsum("ij->i", keep.view(np.uint8), dtype=narrow))


def _projection(sources: Sequence[Source], columns: int) -> Projection:
    """How the ranges of these sensors become points in the body frame."""
    lidar, pose = sources[0].lidar, sources[0].body_from_sensor
    own = lidar.projection(pose, columns)
    if own is not None:
        return own
    tables = [source.lidar.beams.moved(source.body_from_sensor) for source in sources]
    if lidar.beams.angle_rad is None:
        return Turning(tables[0], np.maximum(lidar.firing_ns, 0), columns, tables[1:])
    return Tabled(tables, columns)


def _firing_order(lidar: Lidar) -> I64Array | None:
    """Slots in the order of firing, channel, return: (T, slots); None if it is that of the wire."""
    firing_ns = np.maximum(lidar.firing_ns, 0)
    channels = np.broadcast_to(lidar.channel, firing_ns.shape)
    beams = [np.lexsort(keys) for keys in zip(channels, firing_ns, strict=True)]
    order = np.stack(beams)[:, :, None] * lidar.returns + np.arange(lidar.returns)
    order = order.reshape(len(beams), -1)
    return None if bool((order == np.arange(order.shape[1])).all()) else order


def _labels(source: Source, lidar_id: int) -> Labels:
    """What the points of a column are, apart from its own time: (T, slots)."""
    lidar = source.lidar
    slot = np.arange(source.slots)
    beam = slot // lidar.returns
    label = np.zeros((len(lidar.firing_ns), source.slots), LABEL)
    label["time_ns"] = np.maximum(lidar.firing_ns, 0)[:, beam]
    label["ring"] = (
        source.ring_base + np.broadcast_to(lidar.channel, lidar.firing_ns.shape)[:, beam]
    )
    label["return_type"] = np.array(lidar.return_types, np.uint8)[slot % lidar.returns]
    label["lidar_id"] = lidar_id
    return label
