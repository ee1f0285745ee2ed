"""Sensors that the compiled loops decode alike, as the structs that `native/decode.c` reads."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.decode.scan_buffer import LABEL
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import (
    BeamTable,
    Coordinates,
    CorrectedRanges,
    Mirrors,
    OffAxis,
    PlacedPoints,
)
from mlbatch.lidar.interface import BitField, Lidar, PixelTable, ReturnLayout
from mlbatch.native.library import Field, Group, Ring
from mlbatch.reports.ledger import PointCounts

# As in `native.h`.
TABLED, TURNING, PLACED, CORRECTED, MIRRORED, COORDINATES = range(6)
_TYPED_BY = {"": 0, "order": 1, "level": 2}
_MOST_BEAMS = 256
_MOST_RETURNS = 3
_MOST_WORDS = 3
_WORD_BYTES = 4
_COUNTS = 5
# Beams of a plane are a multiple of this.
_BEAMS_TOGETHER = 16
_FIELD_BITS = {"u1": 8, "<u2": 16, ">u2": 16, "<u4": 32}
# Bits of all vectors of directions; `used` of a Group.
_ALL_DIRECTIONS = 0o77
# The return type in a label.
_TYPE_BITS = np.uint64(0xFF << 48)
_REVOLUTION = 2 * np.pi

Geometry: TypeAlias = BeamTable | OffAxis | CorrectedRanges | Mirrors | PlacedPoints | Coordinates


@dataclass(slots=True)
class Source:
    """Lidar, raw packets, pose and limits of a sensor.

    body_from_sensor: (4, 4) float64, m; ring_base: number of its first channel in the output;
    keep_repeated: keep duplicate returns.
    """

    lidar: Lidar
    ring: PacketRing
    body_from_sensor: F64Array
    ring_base: int
    min_range_m: float = 0.0
    max_range_m: float = float("inf")
    keep_repeated: bool = False

    @property
    def slots(self) -> int:
        """Slots of a column: channels times returns."""
        return self.lidar.channels * self.lidar.returns


class SensorGroup:
    """Sensors that are decoded alike (the members), and the arrays that their struct points to."""

    def __init__(
        self,
        members: Sequence[tuple[int, Source]],
        struct: Group,
        *,
        has_reflectivity: bool,
    ) -> None:
        """members: with equal `group_key`, index in the scan and source of each; struct: to fill.

        has_reflectivity: the scan has an array of them.
        """
        self.struct = struct
        self.counts = [PointCounts() for _ in members]
        self._sources = [source for _, source in members]
        self._lidar = self._sources[0].lidar
        self._slots = self._sources[0].slots
        self._rings = [source.ring for source in self._sources]
        self._width = _width(self._lidar)
        # Of the last call; None: before the first.
        self._pieces: list[npt.NDArray[np.void] | None] = [None] * len(members)
        self._ring_structs = (Ring * len(members))()
        self._counts = np.zeros((len(members), _COUNTS), np.int64)
        geometries = [geometry(source) for source in self._sources]
        struct.rings = self._ring_structs
        struct.beams = self._lidar.channels
        struct.width = self._width
        struct.returns = self._lidar.returns
        struct.slots = self._slots
        struct.counts = self._counts
        self._order = _firing_order(self._lidar)
        table = self._lidar.pixels
        if table is not None:
            _require_inside(self._lidar, table)
            self._set_pixels(table, has_reflectivity)
        self._set_geometry(geometries)
        self._set_slots()
        self._set_labels(members)
        limits = [(source.min_range_m, source.max_range_m) for source in self._sources]
        if any(low > 0 or high < float("inf") for low, high in limits):
            struct.limits_m = np.array(limits, np.float32)

    def mirror_angles(self, angle_rad: F64Array) -> F32Array:
        """Return cosine and sine (2, n) of twice the angle past the start of the mirror, (n,)."""
        mirrors = geometry(self._sources[0])
        if not isinstance(mirrors, Mirrors):
            raise TypeError(f"{self._lidar.model} has no mirrors")
        past = np.minimum.reduce([(angle_rad - start) % _REVOLUTION for start in mirrors.start_rad])
        return np.stack([np.cos(2 * past), np.sin(2 * past)]).astype(np.float32)

    def use_rings(self) -> None:
        """Point the struct to the rings as they are, and keep their arrays."""
        self._counts.fill(0)
        for number, ring in enumerate(self._rings):
            # Columns (rows, columns of a row).
            pieces, origin = ring.view
            if pieces is not self._pieces[number]:
                self._pieces[number] = pieces
                self._ring_structs[number] = Ring(
                    pieces.ctypes.data, *pieces.shape, *pieces.strides, origin
                )

    def add_counts(self) -> None:
        """Add the counts since `use_rings` to the point counters."""
        slots = self._slots
        for counts, row in zip(self.counts, self._counts.tolist(), strict=True):
            columns, found, distinct, in_range, outside = row
            if not columns:
                continue
            counts.slots += columns * slots
            counts.no_return += columns * slots - found
            counts.repeated += found - distinct
            counts.range += distinct - in_range
            counts.box += in_range - outside
            counts.written += outside

    # -- pixels --

    def _set_pixels(self, table: PixelTable, has_reflectivity: bool) -> None:
        runs = [
            [(run.first_byte, run.channel, run.channels) for run in layout.runs]
            for layout in table.returns
        ]
        layouts = [_fields(layout) for layout in table.returns]
        fields = [field for _, own in layouts for field in own]
        struct = self.struct
        struct.step = table.step
        struct.run_count = len(runs[0])
        struct.runs = np.array(runs, np.int64)
        # Returns with fewer words read their first one again.
        most = max(len(words) for words, _ in layouts)
        words = [[*own, *own[:1] * (most - len(own))] for own, _ in layouts]
        struct.word_count = most
        struct.word_bytes = np.array(words, np.int64)
        struct.fields = (Field * len(fields))(*(Field(*field) for field in fields))
        struct.scale = np.array([table.factor, table.divisor], np.float32)
        struct.silent = table.silent
        is_dark = np.ones(self._lidar.channels, np.bool_)
        for run in table.returns[0].runs:
            is_dark[run.channel : run.channel + run.channels] = False
        is_dark[list(table.dark)] = True
        dark = is_dark.nonzero()[0]
        struct.dark_count = len(dark)
        struct.dark = dark
        struct.has_reflectivity = (
            self._lidar.has_reflectivity
            and has_reflectivity
            and table.returns[0].reflectivity is not None
        )

    # -- geometry --

    def _set_geometry(self, geometries: Sequence[Geometry]) -> None:
        first = geometries[0]
        struct = self.struct
        tables = [one for one in geometries if isinstance(one, BeamTable)]
        if isinstance(first, PlacedPoints):
            struct.kind = PLACED
            # Bytes of a slot, for prefetches.
            struct.step = self._lidar.records.size // self._slots
            runs = [first.first_byte, first.labels_at, self._slots]
            struct.runs = np.array(runs, np.int64)
            struct.direction = np.ascontiguousarray(first.rotation)
            struct.origin = np.ascontiguousarray(first.translation_m)
            if first.origin_m is not None:
                struct.axis_m = np.ascontiguousarray(first.origin_m)
            struct.tables = len(self._lidar.firing_ns)
        elif isinstance(first, Coordinates):
            struct.kind = COORDINATES
            struct.step = first.return_bytes
            struct.runs = np.array([first.intensity_at], np.int64)
            struct.coordinates = first.form
            struct.pose_f8 = np.ascontiguousarray(first.pose)
            struct.sines = np.ascontiguousarray(first.sines)
            struct.tables = len(self._lidar.firing_ns)
        elif isinstance(first, CorrectedRanges):
            self._set_rotor_planes(CORRECTED, first)
        elif isinstance(first, Mirrors):
            self._set_rotor_planes(MIRRORED, first)
            struct.steps = first.azimuth.shape[1]
            struct.azimuth_value, struct.azimuth_slope = np.ascontiguousarray(first.azimuth)
            struct.elevation_value, struct.elevation_slope = np.ascontiguousarray(first.elevation)
        elif isinstance(first, OffAxis):
            self._set_rotors([first.beams])
            struct.miss_m2 = self._beams(first.miss_m2)
            struct.axis_m = np.ascontiguousarray(first.axis_m)
        elif first.angle_rad is None:
            self._set_rotors(tables)
        else:
            self._set_angle_table(tables)

    def _set_rotor_planes(self, kind: int, own: CorrectedRanges | Mirrors) -> None:
        struct = self.struct
        struct.kind = kind
        struct.planes = self._beams(own.planes)
        struct.pose = np.ascontiguousarray(own.pose)
        struct.tables = len(self._lidar.firing_ns)
        struct.firing_ns = self._beams(self._firing_ns())

    def _set_angle_table(self, tables: Sequence[BeamTable]) -> None:
        if any(table.origin.shape[1] != 1 for table in tables):
            raise RigError(
                f"{self._lidar.model}: expected one origin for all beams of a sensor with an angle "
                "table, found one for each beam; give it rotor words instead"
            )
        rotors = [table.rotor() for table in tables]
        vectors = np.stack([table.vectors() for table in tables])
        origin = np.concatenate([table.origins() for table in tables])
        reach_m = np.stack(
            [np.broadcast_to(one.reach_m, (self._lidar.channels,)) for one in tables]
        ).astype(np.float32)
        rows = [len(cosine) for cosine, _ in rotors]
        struct = self.struct
        struct.kind = TABLED
        struct.direction = self._beams(vectors)
        struct.cosine = np.concatenate([cosine for cosine, _ in rotors])
        struct.sine = np.concatenate([sine for _, sine in rotors])
        struct.origin = origin
        struct.first_row = np.cumsum([0, *rows[:-1]]).astype(np.int64)
        struct.used = _used_by_table(vectors, origin)
        struct.rows = sum(rows)
        struct.reach = self._beams(reach_m)
        struct.tables = 1

    def _set_rotors(self, tables: Sequence[BeamTable]) -> None:
        channels = self._lidar.channels
        struct = self.struct
        struct.kind = TURNING
        directions = [_vectors(one.direction, channels) for one in tables]
        origins = [_vectors(one.origin, channels) for one in tables]
        used = [
            _used_vectors(direction, origin, bool(one.origin[:2].any()))
            for direction, origin, one in zip(directions, origins, tables, strict=True)
        ]
        struct.direction = self._beams(np.stack(directions))
        struct.origin = self._beams(np.stack(origins))
        struct.used = np.array(used, np.int64)
        struct.tables = len(self._lidar.firing_ns)
        if any(bool(one.reach_m.any()) for one in tables):
            reaches_m = [np.broadcast_to(one.reach_m, (channels,)) for one in tables]
            struct.reach = self._beams(np.stack(reaches_m).astype(np.float32))
        if self._firing_ns().any():
            firing_ns = np.concatenate([self._firing_ns(source) for source in self._sources])
            struct.firing_ns = self._beams(firing_ns)

    def _firing_ns(self, source: Source | None = None) -> F32Array:
        """Return firing times (T, B), ns; beams that do not fire (-1) have no points."""
        lidar = self._lidar if source is None else source.lidar
        return np.maximum(lidar.firing_ns, 0).astype(np.float32)

    def _beams(self, values: F32Array) -> F32Array:
        """Return values by beam (the last axis), padded to planes."""
        missing = self._width - values.shape[-1]
        return np.ascontiguousarray(np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)]))

    # -- slots and labels --

    def _set_slots(self) -> None:
        lidar = self._lidar
        struct = self.struct
        element = self._elements()
        slot = slot_numbers(lidar)
        if sorted(slot.tolist()) != list(range(self._slots)):
            raise RigError(
                f"{lidar.model}: expected each channel once, found {lidar.channel.tolist()}"
            )
        number = np.zeros(lidar.returns * self._width, np.int64)
        number[element] = slot
        struct.slot = None if np.array_equal(slot, element) else number
        if self._order is not None:
            struct.order = element[self._order]
        elif lidar.returns > 1:
            struct.order = element
        has_orders = self._order is not None and len(self._order) > 1
        struct.order_step = self._slots if has_orders else 0
        struct.typed = self._typed_by
        struct.sends_twice = lidar.sends_twice
        is_repeated = lidar.sends_twice and lidar.returns > 1
        struct.drops_repeated = is_repeated and not self._sources[0].keep_repeated

    def _set_labels(self, members: Sequence[tuple[int, Source]]) -> None:
        """Set words of labels of columns at time 0, (members * T, E)."""
        tables = self.struct.tables
        words = np.concatenate(
            [_labels(source, number)[:tables] for number, source in members]
        ).view(np.uint64)
        if self._typed_by:
            # The loops add the types of dual returns.
            words &= ~_TYPE_BITS
        labels = np.zeros((len(words), self._lidar.returns * self._width), np.int64)
        labels[:, self._elements()] = words.view(np.int64)
        self.struct.labels = labels

    def _elements(self) -> I64Array:
        """Return the element of each slot: `return * width + beam`."""
        slot = np.arange(self._slots)
        returns = self._lidar.returns
        return slot % returns * self._width + slot // returns

    @property
    def _typed_by(self) -> int:
        return _TYPED_BY[self._lidar.typed_by] if self._lidar.returns == 2 else 0


def geometry(source: Source) -> Geometry:
    """Return the beams of a sensor in the body frame, or what it has instead."""
    projection = source.lidar.projection(source.body_from_sensor)
    return source.lidar.beams.moved(source.body_from_sensor) if projection is None else projection


def group_key(source: Source, number: int) -> Hashable:
    """Return a key that is equal for sensors that can share a struct.

    Directions, labels and limits are stored by member; all else is shared and is in the key.
    number: of the sensor.
    """
    lidar = source.lidar
    own = geometry(source)
    if not isinstance(own, BeamTable):
        return number
    is_tabled = own.angle_rad is not None
    order = _firing_order(lidar)
    firing_ns = np.maximum(lidar.firing_ns, 0)
    return (
        is_tabled,
        lidar.pixels,
        lidar.records,
        lidar.channels,
        lidar.returns,
        lidar.has_reflectivity,
        lidar.typed_by,
        lidar.sends_twice,
        lidar.sends_twice and not source.keep_repeated,
        is_tabled or bool(own.reach_m.any()),
        bool(firing_ns.any()),
        len(firing_ns),
        None if order is None else order.tobytes(),
        slot_numbers(lidar).tobytes(),
    )


def slot_numbers(lidar: Lidar) -> I64Array:
    """Return the output slot of each slot of a column: (slots,)."""
    channel = lidar.channel if lidar.channel.ndim == 1 else np.arange(lidar.channels)
    numbers: I64Array = channel[:, None] * lidar.returns + np.arange(lidar.returns)
    return numbers.reshape(-1)


def _firing_order(lidar: Lidar) -> I64Array | None:
    """Return slots by firing time, channel, return: (T, slots); None if that is wire order."""
    firing_ns = np.maximum(lidar.firing_ns, 0)
    channels = np.broadcast_to(lidar.channel, firing_ns.shape)
    beams = [np.lexsort(keys) for keys in zip(channels, firing_ns, strict=True)]
    order = np.stack(beams)[:, :, None] * lidar.returns + np.arange(lidar.returns)
    order = order.reshape(len(beams), -1)
    return None if bool((order == np.arange(order.shape[1])).all()) else order


def _labels(source: Source, lidar_id: int) -> npt.NDArray[np.void]:
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


def _require_inside(lidar: Lidar, table: PixelTable) -> None:
    """Raise RigError unless pixels are in records, of known channels, and not too many or large."""
    runs = {tuple((run.channel, run.channels) for run in layout.runs) for layout in table.returns}
    is_known = (
        len(table.returns) == lidar.returns <= _MOST_RETURNS
        and _width(lidar) <= _MOST_BEAMS
        and len(runs) == 1
        and all(channel < lidar.channels for channel in table.dark)
        and all(len(_fields(one)[0]) <= _MOST_WORDS for one in table.returns)
        and all(_is_inside(lidar, table, layout) for layout in table.returns)
    )
    if not is_known:
        raise RigError(
            f"{lidar.model}: expected a table of pixels inside the records of {lidar.records.size} "
            f"bytes, for {lidar.channels} channels (at most {_MOST_BEAMS}) and {lidar.returns} "
            f"returns (at most {_MOST_RETURNS}), found another"
        )


def _is_inside(lidar: Lidar, table: PixelTable, layout: ReturnLayout) -> bool:
    fields = [layout.distance, layout.intensity]
    if layout.reflectivity is not None:
        fields.append(layout.reflectivity)
    last = max(field.first + _FIELD_BITS[field.word] // 8 for field in fields)
    return all(
        run.first_byte + (run.channels - 1) * table.step + last <= lidar.records.size
        and run.channel + run.channels <= lidar.channels
        for run in layout.runs
    )


def _fields(layout: ReturnLayout) -> tuple[list[int], list[tuple[int, int, int, bool]]]:
    """Return the words to read from a pixel, by first byte, and each field in them, as `Field`."""
    words: list[int] = []
    fields = []
    for field in (layout.distance, layout.intensity, layout.reflectivity):
        if field is None:
            fields.append((0, 0, 0, False))
            continue
        number = next(
            (number for number, first in enumerate(words) if _is_in_word(field, first)), len(words)
        )
        if number == len(words):
            words.append(field.first)
        bits = _FIELD_BITS[field.word]
        shift = 8 * (field.first - words[number]) + field.shift
        is_big = field.word[0] == ">"
        if is_big and field.shift:
            raise ValueError("expected no shift in a big-endian field")
        # Of a field that is narrower than the word, the other bits are another field's.
        mask = field.mask & ((1 << bits) - 1) >> field.shift
        fields.append((number, shift, mask, is_big))
    return words, fields


def _is_in_word(field: BitField, first: int) -> bool:
    end = field.first + _FIELD_BITS[field.word] // 8
    return first <= field.first and end <= first + _WORD_BYTES


def _width(lidar: Lidar) -> int:
    """Return the beams of a plane."""
    return -(-lidar.channels // _BEAMS_TOGETHER) * _BEAMS_TOGETHER


def _vectors(vectors: F64Array, beams: int) -> F32Array:
    """Return vectors (3, B or 1, 3) of the beams by axis: (3 vectors, 3 axes, B)."""
    wide = np.broadcast_to(vectors, (3, beams, 3)).transpose(0, 2, 1)
    by_axis: F32Array = wide.astype(np.float32, order="C")
    return by_axis


def _used_vectors(direction: F32Array, origin: F32Array, origin_turns: bool) -> int:
    """Return bits of the vectors that are not zero, by axis; `used` of a Group."""
    bits = _nonzero_axes(direction[:2])
    bits |= _nonzero_axes(direction[2:]) << 3
    if origin_turns:
        bits |= _nonzero_axes(origin[:2]) << 6
    bits |= _nonzero_axes(origin[2:]) << 9
    return bits


def _used_by_table(vectors: F32Array, origin: F32Array) -> I64Array:
    """Return bits of the vectors that the coordinates depend on, (sensors,); `used` of a Group.

    A term of zero changes a coordinate only from -0 to 0, which no origin other than -0 leaves.
    """
    if bool((np.signbit(origin) & (origin == 0)).any()):
        return np.full(len(vectors), _ALL_DIRECTIONS)
    bits = [_nonzero_axes(one[:2]) | _nonzero_axes(one[2:]) << 3 for one in vectors]
    return np.array(bits, np.int64)


def _nonzero_axes(vectors: F32Array) -> int:
    """Return bits of the axes in which vectors (k, 3, B) are not zero for all beams."""
    return sum(1 << axis for axis in range(3) if vectors[:, axis].any())
