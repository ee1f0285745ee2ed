"""The engine `native`: decodes groups of sensors by compiled loops (`native/decode.c`).

The loops do the float32 operations of `projector.py` in the same order, column by column instead
of array by array. Sensors without a pixel layout for them are decoded by numpy and copied.
"""

from __future__ import annotations

import ctypes
from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, I64Array
from mlbatch.decode.engine import EngineSetup
from mlbatch.decode.projector import Projector
from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.lidar.geometry import Tabled, Turning, rotor_angles
from mlbatch.lidar.interface import Lidar
from mlbatch.lidar.pixel_table import BitField, PixelTable, ReturnLayout
from mlbatch.lidar.placed import PlacedPoints
from mlbatch.native.library import Field, Group, Piece, Ring, Scan, address, library
from mlbatch.types import PACKED_ROOM, RECORD_KINDS, RecordLayout, WindowColumns

if TYPE_CHECKING:
    from mlbatch.decode.numpy_engine import NumpyEngine

# As in `native.h`.
_TABLED, _TURNING, _COPIED, _PLACED = range(4)
_TYPED_BY = {"": 0, "order": 1, "level": 2}
_MOST_BEAMS = 256
_MOST_RETURNS = 3
_MOST_WORDS = 3
_WORD_BYTES = 4
# Beams of a plane are a multiple of this.
_BEAMS_TOGETHER = 16
_BEAMS_OF_FOUR = 4
_COUNTS = 5
_UNSURE = np.float32(2)
_FIELD_BITS = {"u1": 8, "<u2": 16, ">u2": 16, "<u4": 32}
# Columns of an organized scan that are packed together: slots of several columns are adjacent in
# the output, and all of them fit into the second-level cache.
_NEAR_COLUMNS = 16
# As in `native.h`.
_SPARE_SLOTS = 4
# Points beyond those of a column that the loops may overwrite.
_SPARE_POINTS = 4
# Bits of all vectors of directions; `Group.used`.
_ALL_DIRECTIONS = 0o77
# The return type in a label.
_TYPE_BITS = np.uint64(0xFF << 48)


class NativeEngine:
    """Decodes all sensors in one call a window."""

    def __init__(self, setup: EngineSetup) -> None:
        self._library = library()
        self._extras = setup.extras
        self._copies: list[_CopiedGroup] = []
        self._groups: list[_DecodedGroup] = []
        self._organized_numpy: list[NumpyEngine] = []
        # Of the last call; None: before the first.
        self._out: ScanBuffer | None = None
        sensors = len(setup.seat)
        self._group_of = np.full(sensors, -1, np.int64)
        self._member_of = np.zeros(sensors, np.int64)
        by_group = _indices_by_group(setup.projectors)
        self._structs = (Group * len(by_group))()
        for number, indices in enumerate(by_group):
            own = [setup.projectors[index] for index in indices]
            members = _members(setup.projectors, indices, setup.seat)
            if is_decoded(own[0]):
                is_dense = not setup.organized_slots
                self._groups.append(_DecodedGroup(own, self._structs[number], is_dense=is_dense))
            else:
                from mlbatch.decode.numpy_engine import NumpyEngine

                seat = np.stack([np.minimum(members, 0), members], axis=1)
                engine = NumpyEngine(setup._replace(projectors=own, seat=seat))
                if setup.organized_slots:
                    # numpy writes its rows itself.
                    self._organized_numpy.append(engine)
                    continue
                copied = _CopiedGroup(
                    engine, own[0].slots, setup.tile_columns, self._structs[number]
                )
                self._copies.append(copied)
            self._group_of[members >= 0] = number
            self._member_of[members >= 0] = members[members >= 0]
        self._turning = self._turning_sensors()
        boxes_m = setup.projectors[0].boxes_m
        self._arrays = (self._group_of, self._member_of, np.ascontiguousarray(boxes_m))
        self._scan = Scan(
            group_of=address(self._group_of),
            member_of=address(self._member_of),
            group_count=len(by_group),
            groups=ctypes.addressof(self._structs),
            box_count=len(boxes_m),
            boxes_m=address(self._arrays[2]),
            row_slots=setup.organized_slots,
        )
        # numpy writes its rows of organized scans to arrays.
        self.record = None if self._organized_numpy else setup.record
        if self.record is not None:
            self._set_record(self.record, max(one.slots for one in setup.projectors))
        # Columns in one call: what numpy decodes is copied from a buffer.
        self._most_columns = setup.tile_columns if self._copies else None

    def decode(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> int:
        """See `Engine.decode`."""
        scan = self._scan
        # The arrays are kept until the call returns: another thread may let a ring grow.
        for group in self._groups:
            group.use_rings()
        self._use_outputs(out)
        kept: list[list[npt.NDArray[Any]]] = []
        scan.start_ns = start_ns
        most = self._most_columns or max(len(columns), 1)
        row = 0
        for begin in range(0, len(columns), most):
            some = columns.take(slice(begin, begin + most)) if most < len(columns) else columns
            kept.append(self._use_columns(some))
            scan.first_number = first_number + begin
            scan.first_row = row
            for copied in self._copies:
                copied.decode(some, start_ns, scan.first_number)
            row = self._library.mlbatch_decode(ctypes.byref(scan))
        for group in self._groups:
            group.add_counts()
        for engine in self._organized_numpy:
            row += engine.decode(columns, start_ns, first_number, out)
        return row

    def _set_record(self, record: RecordLayout, slots: int) -> None:
        """Have records packed from scratch arrays; slots: most of a column."""
        is_organized = bool(self._scan.row_slots)
        near = _NEAR_COLUMNS if is_organized else 1
        pieces = [
            Piece(RECORD_KINDS.index(one.kind), one.offset, one.source, one.bytes)
            for one in record.pieces
            # Without a sensor that has them, reflectivities are not decoded: they stay 0.
            if one.kind != "reflectivity" or "reflectivity" in self._extras
        ]
        self._pieces = (Piece * len(pieces))(*pieces)
        if is_organized:
            self._near = ScanBuffer(near, self._scan.row_slots + _SPARE_SLOTS)
        else:
            self._near = ScanBuffer(slots + _SPARE_POINTS, None)
        scan = self._scan
        scan.record_bytes = record.step
        scan.piece_count = len(pieces)
        scan.pieces = ctypes.addressof(self._pieces)
        scan.near_columns = near
        kinds = [RECORD_KINDS[piece.kind] for piece in pieces]
        self._set_arrays(self._near, "range_mm_u4" in kinds, "reflectivity" in kinds)

    def _use_columns(self, columns: WindowColumns) -> list[npt.NDArray[Any]]:
        """Point the struct to the columns; return the arrays to keep."""
        kept: list[npt.NDArray[Any]] = []
        arrays: list[npt.NDArray[Any]] = [
            np.ascontiguousarray(array, np.int64)
            for array in (columns.stamp_ns, columns.sensor, columns.ring_index, columns.encoder)
        ]
        scan = self._scan
        scan.columns = len(columns)
        scan.stamp_ns, scan.sensor, scan.ring_index, scan.encoder = map(address, arrays)
        scan.moves = None
        if columns.moves is not None:
            moves = np.ascontiguousarray(columns.moves, np.float32)
            scan.moves = address(moves)
            kept.append(moves)
        kept += arrays
        if self._turning is not None:
            angles = self._angles(arrays[1], arrays[3])
            for group in self._groups:
                if group.struct.kind == _TURNING:
                    group.struct.cosine, group.struct.sine = map(address, angles)
            kept += angles
        return kept

    def _angles(self, sensor: I64Array, encoder: I64Array) -> list[npt.NDArray[Any]]:
        """Return cosines and sines of all columns; undefined for sensors without rotor words."""
        if self._turning is None or self._turning.all():
            return list(native_angles(encoder))
        own = self._turning[sensor]
        angles = np.zeros((2, len(encoder)), np.float32)
        angles[:, own] = native_angles(encoder[own])
        return [angles[0], angles[1]]

    def _turning_sensors(self) -> npt.NDArray[np.bool_] | None:
        """Mask of the sensors with rotor words that the loops decode; None if there are none."""
        kinds = np.array([struct.kind for struct in self._structs] + [_COPIED])
        turning = np.asarray(kinds[self._group_of] == _TURNING)
        return turning if turning.any() else None

    def _use_outputs(self, out: ScanBuffer) -> None:
        """Point the struct to the arrays of a scan; organized rows are written as a whole."""
        if out is self._out:
            return
        self._out = out
        extras = self._extras
        if self.record is not None:
            self._scan.records = address(out.packed) + PACKED_ROOM
            return
        self._set_arrays(
            out,
            "range_m" in extras,
            "reflectivity" in extras,
        )
        wants_column = "column" in extras and not out.is_organized
        self._scan.column = address(out.column) if wants_column else None

    def _set_arrays(self, out: ScanBuffer, wants_range: bool, wants_reflectivity: bool) -> None:
        scan = self._scan
        scan.point = address(out.point)
        scan.label = address(out.label)
        scan.range_m = address(out.range_m) if wants_range else None
        scan.reflectivity = address(out.reflectivity) if wants_reflectivity else None


class _DecodedGroup:
    """Sensors that the loops decode, and the arrays that their struct points to."""

    def __init__(self, projectors: Sequence[Projector], struct: Group, *, is_dense: bool) -> None:
        """projectors: with equal `_group_key`; struct: to be filled; is_dense: of dense scans."""
        lidar = projectors[0].lidar
        table = lidar.pixels
        projection = projectors[0].projection
        if table is None and not isinstance(projection, PlacedPoints):
            raise ValueError(f"no pixel layout for {lidar.model}")
        self._rings = [source.ring for one in projectors for source in one.sources]
        self._counters = [counts for one in projectors for counts in one.counts]
        self._slots = projectors[0].slots
        self._counts = np.zeros((len(self._counters), _COUNTS), np.int64)
        self._arrays: list[Any] = []
        # Of the last call; None: before the first.
        self._pieces: list[npt.NDArray[np.void] | None] = [None] * len(self._rings)
        self._ring_structs = (Ring * len(self._rings))()
        self.struct = struct
        struct.rings = ctypes.addressof(self._ring_structs)
        struct.beams = lidar.channels
        struct.width = _width(lidar)
        struct.returns = lidar.returns
        struct.slots = self._slots
        struct.counts = self._kept(self._counts)
        # Of the pixels of a column, in order of output; None: beams are in wire order.
        self._places = _places(projectors[0], table) if is_dense and table is not None else None
        if table is not None:
            self._set_pixels(projectors[0], table)
            struct.fits_fours = self._places is not None or _fits_fours(projectors[0], table)
        if self._places is not None:
            struct.places = self._kept(self._places)
        if isinstance(projection, PlacedPoints):
            self._set_places(projectors[0], projection)
        elif isinstance(projection, Tabled):
            self._set_angle_table(projectors[0], projection)
        else:
            rotors = [one.projection for one in projectors]
            self._set_rotors([one for one in rotors if isinstance(one, Turning)], projectors[0])
        self._set_slots(projectors[0])
        self._set_labels(projectors)
        if any(one.is_limited for one in projectors):
            limits_m = np.concatenate([one.limits_m for one in projectors])
            self.struct.limits_m = self._kept(limits_m)

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
        for counts, row in zip(self._counters, self._counts.tolist(), strict=True):
            columns, found, distinct, in_range, outside = row
            if not columns:
                continue
            counts.slots += columns * slots
            counts.no_return += columns * slots - found
            counts.repeated += found - distinct
            counts.range += distinct - in_range
            counts.box += in_range - outside
            counts.written += outside

    def _kept(self, array: npt.NDArray[Any]) -> int:
        """Return the address of an array that lives as long as the group."""
        array = np.ascontiguousarray(array)
        self._arrays.append(array)
        return address(array)

    def _set_pixels(self, projector: Projector, table: PixelTable) -> None:
        lidar = projector.lidar
        runs = [
            [(run.first_byte, run.channel, run.channels) for run in layout.runs]
            for layout in table.returns
        ]
        layouts = [_fields(layout) for layout in table.returns]
        fields = [field for _, own in layouts for field in own]
        structs = (Field * len(fields))(*(Field(*field) for field in fields))
        self._arrays.append(structs)
        struct = self.struct
        struct.step = table.step
        struct.run_count = len(runs[0])
        struct.runs = self._kept(np.array(runs, np.int64))
        # Returns with fewer words read their first one again.
        most = max(len(words) for words, _ in layouts)
        words = [[*own, *own[:1] * (most - len(own))] for own, _ in layouts]
        struct.word_count = most
        struct.word_bytes = self._kept(np.array(words, np.int64))
        struct.fields = ctypes.addressof(structs)
        struct.scale = self._kept(np.array([table.factor, table.divisor], np.float32))
        struct.silent = table.silent
        struct.dark_count = len(table.dark)
        struct.dark = self._kept(np.array(table.dark, np.int64))
        struct.has_reflectivity = (
            lidar.has_reflectivity
            and "reflectivity" in projector.extras
            and table.returns[0].reflectivity is not None
        )

    def _set_places(self, projector: Projector, projection: PlacedPoints) -> None:
        struct = self.struct
        struct.kind = _PLACED
        # Bytes of a slot, for prefetches.
        struct.step = projector.lidar.records.size // projector.slots
        struct.runs = self._kept(np.array([projection.first_byte, 0, projector.slots], np.int64))
        struct.direction = self._kept(projection.rotation)
        struct.origin = self._kept(projection.translation_m)
        struct.tables = len(projector.lidar.firing_ns)

    def _beams(self, projector: Projector, values: F32Array) -> F32Array:
        """Return values by beam (the last axis) in the order of the loops, padded to planes."""
        if self._places is not None and projector.order is not None:
            values = values.take(projector.order[0], axis=-1)
        return _padded(values, self.struct.width)

    def _set_angle_table(self, projector: Projector, projection: Tabled) -> None:
        shape = (len(projector.sources), projector.lidar.channels)
        struct = self.struct
        struct.kind = _TABLED
        struct.direction = self._kept(self._beams(projector, projection.vectors))
        struct.cosine = self._kept(projection.cosine)
        struct.sine = self._kept(projection.sine)
        struct.origin = self._kept(projection.origin)
        struct.first_row = self._kept(projection.first_position)
        struct.used = self._kept(_used_by_table(projection))
        struct.rows = len(projection.cosine)
        reach_m = np.broadcast_to(projection.reaches_m, shape)
        struct.reach = self._kept(self._beams(projector, reach_m))
        struct.tables = 1

    def _set_rotors(self, members: Sequence[Turning], projector: Projector) -> None:
        first = members[0]
        struct = self.struct
        struct.kind = _TURNING
        directions = np.stack([one.direction for one in members])
        struct.direction = self._kept(self._beams(projector, directions))
        origins = np.stack([one.origin for one in members])
        struct.origin = self._kept(self._beams(projector, origins))
        struct.used = self._kept(np.array([_used_vectors(one) for one in members], np.int64))
        struct.tables = len(first.firing_ns)
        if first.has_reach:
            channels = projector.lidar.channels
            reaches_m = [np.broadcast_to(one.reach_m, (channels,)) for one in members]
            struct.reach = self._kept(self._beams(projector, np.stack(reaches_m)))
        if not first.fires_at_once:
            firing_ns = np.concatenate([one.firing_ns for one in members])
            struct.firing_ns = self._kept(self._beams(projector, firing_ns))

    def _set_slots(self, projector: Projector) -> None:
        lidar = projector.lidar
        struct = self.struct
        element = _elements(projector)
        number = np.zeros(lidar.returns * struct.width, np.int64)
        number[element] = projector.number
        # Slots that are beams are written by fours.
        table = lidar.pixels
        fits = table is not None and _fits_fours(projector, table)
        is_beam = fits and np.array_equal(projector.number, element)
        struct.slot = None if is_beam else self._kept(number)
        if self._places is not None:
            struct.order = None
        elif projector.order is not None:
            struct.order = self._kept(element[projector.order])
        elif lidar.returns > 1:
            struct.order = self._kept(element)
        has_orders = projector.order is not None and len(projector.order) > 1
        struct.order_step = projector.slots if has_orders else 0
        struct.typed = _typed_by(lidar)
        struct.sends_twice = lidar.sends_twice
        struct.drops_repeated = projector.drops_duplicates

    def _set_labels(self, projectors: Sequence[Projector]) -> None:
        first = projectors[0]
        words = np.concatenate([one.labels for one in projectors])
        if _typed_by(first.lidar):
            # The loops add the types of dual returns.
            words &= ~_TYPE_BITS
        if self._places is not None and first.order is not None:
            words = words.take(first.order[0], axis=1)
        labels = np.zeros((len(words), first.lidar.returns * self.struct.width), np.int64)
        labels[:, _elements(first)] = words.view(np.int64)
        self.struct.labels = self._kept(labels)


class _CopiedGroup:
    """Sensors that numpy decodes to a buffer, from which the loops copy."""

    def __init__(self, engine: NumpyEngine, slots: int, columns: int, struct: Group) -> None:
        """slots: of a column; columns: most in one call; struct: to be filled."""
        self._engine = engine
        self._decoded = ScanBuffer(columns * slots, None)
        self._points = np.zeros(columns, np.int64)
        self._cursor = np.zeros(1, np.int64)
        decoded = self._decoded
        struct.kind = _COPIED
        struct.points = address(self._points)
        struct.cursor = address(self._cursor)
        struct.copied_point = address(decoded.point)
        struct.copied_label = address(decoded.label)
        struct.copied_range = address(decoded.range_m)
        struct.copied_reflectivity = address(decoded.reflectivity)

    def decode(self, columns: WindowColumns, start_ns: int, first_number: int) -> None:
        """Decode the own ones of some columns to the buffer."""
        self._cursor[0] = 0
        points = self._points[: len(columns)]
        points[:] = 0
        self._engine.decode(columns, start_ns, first_number, self._decoded, points)


def native_angles(words: I64Array) -> tuple[F32Array, F32Array]:
    """Return the result of `rotor_angles` for rotor words (n,), equal to the last bit."""
    words = np.ascontiguousarray(words)
    cosine, sine = np.empty((2, len(words)), np.float32)
    if library().mlbatch_angles(len(words), address(words), address(cosine), address(sine)):
        unsure = cosine == _UNSURE
        cosine[unsure], sine[unsure] = rotor_angles(words[unsure])
    return cosine, sine


# -- which sensors the loops decode, and in which groups ------------------------------------------


def is_decoded(projector: Projector) -> bool:
    """Return whether the loops can decode the sensors of a projector."""
    lidar = projector.lidar
    projection = projector.projection
    if isinstance(projection, PlacedPoints):
        # A projector of one sensor, whose columns are whole packets.
        return lidar.channels <= _MOST_BEAMS and not lidar.has_reflectivity
    if isinstance(projection, Tabled):
        is_known = projection.origin.shape[2] == 1
    else:
        is_known = isinstance(projection, Turning)
    fits = lidar.returns <= _MOST_RETURNS and _width(lidar) <= _MOST_BEAMS
    # numpy raises an error for a slot beyond the row; the loops would write there.
    fits &= int(projector.number.max()) < projector.slots
    return is_known and fits and lidar.pixels is not None and _is_inside(lidar, lidar.pixels)


def _is_inside(lidar: Lidar, table: PixelTable) -> bool:
    """Return whether all pixels are inside of the records and of the channels."""
    if any(channel >= lidar.channels for channel in table.dark):
        return False
    runs = {len(layout.runs) for layout in table.returns}
    if len(runs) != 1 or any(len(_fields(one)[0]) > _MOST_WORDS for one in table.returns):
        return False
    return all(_is_inside_return(lidar, table, layout) for layout in table.returns)


def _is_inside_return(lidar: Lidar, table: PixelTable, layout: ReturnLayout) -> bool:
    fields = [layout.distance, layout.intensity]
    if layout.reflectivity is not None:
        fields.append(layout.reflectivity)
    last = max(field.first + _FIELD_BITS[field.word] // 8 for field in fields)
    return all(
        run.first_byte + (run.channels - 1) * table.step + last <= lidar.records.size
        and run.channel + run.channels <= lidar.channels
        for run in layout.runs
    )


def _fits_fours(projector: Projector, table: PixelTable) -> bool:
    """Return whether the beams of a column can be decoded four at a time, in wire order."""
    lidar = projector.lidar
    if lidar.returns > 1 or projector.order is not None or table.dark:
        return False
    channel = 0
    for run in table.returns[0].runs:
        if run.channel != channel or run.channels % _BEAMS_OF_FOUR:
            return False
        channel += run.channels
    return channel == lidar.channels == projector.slots


def _places(projector: Projector, table: PixelTable) -> I64Array | None:
    """Return first bytes of the pixels of a column in order of output: (slots,); `Group.places`.

    None for wire order, and where the loops decode columns in passes.
    """
    lidar = projector.lidar
    order = projector.order
    if lidar.returns > 1 or order is None or len(order) > 1 or table.dark:
        return None
    if lidar.has_reflectivity or projector.slots % _BEAMS_OF_FOUR:
        return None
    place = np.full(lidar.channels, -1, np.int64)
    for run in table.returns[0].runs:
        pixels = np.arange(run.channels)
        place[run.channel + pixels] = run.first_byte + pixels * table.step
    return place[order[0]] if bool((place >= 0).all()) else None


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


def _indices_by_group(projectors: Sequence[Projector]) -> list[list[int]]:
    """Return the projectors of each group; one that numpy decodes has a group of its own."""
    groups: dict[Hashable, list[int]] = {}
    for number, projector in enumerate(projectors):
        is_native = is_decoded(projector)
        key = _group_key(projector) if is_native else number
        groups.setdefault((is_native, key), []).append(number)
    return list(groups.values())


def _group_key(projector: Projector) -> Hashable:
    """Return a key that is equal for projectors whose sensors can share a struct.

    With rotor words, directions, labels and limits are stored by member; all else is shared and
    is in the key.
    """
    lidar = projector.lidar
    projection = projector.projection
    if not isinstance(projection, Turning):
        return id(projector)
    return (
        lidar.pixels,
        lidar.records,
        lidar.channels,
        lidar.returns,
        lidar.has_reflectivity,
        lidar.typed_by,
        lidar.sends_twice,
        projector.drops_duplicates,
        projection.has_reach,
        projection.fires_at_once,
        len(projection.firing_ns),
        None if projector.order is None else projector.order.tobytes(),
        projector.number.tobytes(),
    )


def _members(projectors: Sequence[Projector], indices: Sequence[int], seat: I64Array) -> I64Array:
    """Return the member of the group of some projectors by sensor: (sensors,), -1 for others."""
    member = np.full(len(seat), -1)
    count = 0
    for index in indices:
        own = seat[:, 0] == index
        member[own] = seat[own, 1] + count
        count += len(projectors[index].sources)
    return member


def _used_vectors(projection: Turning) -> int:
    """Return bits of the vectors that are not zero, by axis; `Group.used`."""
    bits = _nonzero_axes(projection.direction[:2])
    bits |= _nonzero_axes(projection.direction[2:]) << 3
    if projection.origin_turns:
        bits |= _nonzero_axes(projection.origin[:2]) << 6
    bits |= _nonzero_axes(projection.origin[2:]) << 9
    return bits


def _used_by_table(projection: Tabled) -> I64Array:
    """Return bits of the vectors that the coordinates depend on, (sensors,); `Group.used`.

    A term of zero changes a coordinate only from -0 to 0, which no origin other than -0 leaves.
    """
    if bool((np.signbit(projection.origin) & (projection.origin == 0)).any()):
        return np.full(len(projection.vectors), _ALL_DIRECTIONS)
    own = [_nonzero_axes(one[:2]) | _nonzero_axes(one[2:]) << 3 for one in projection.vectors]
    return np.array(own, np.int64)


def _nonzero_axes(vectors: F32Array) -> int:
    """Return bits of the axes in which vectors (k, 3, B) are not zero for all beams."""
    return sum(1 << axis for axis in range(3) if vectors[:, axis].any())


def _elements(projector: Projector) -> I64Array:
    """Return the element of each slot: `return * width + beam`."""
    slot = np.arange(projector.slots)
    returns = projector.lidar.returns
    return slot % returns * _width(projector.lidar) + slot // returns


def _typed_by(lidar: Lidar) -> int:
    return _TYPED_BY[lidar.typed_by] if lidar.returns == 2 else 0


def _padded(values: F32Array, width: int) -> F32Array:
    """Pad the last axis with zeros to `width` beams."""
    missing = width - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)]) if missing else values
