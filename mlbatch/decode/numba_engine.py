"""The engine `numba`: decodes groups of sensors by compiled kernels.

The kernels do the float32 operations of `projector.py` in the same order, column by column instead
of array by array (`kernels/_columns_source.py`). A call passes the addresses of tables and arrays
in a frame of int64 words (`kernels/frame.py`).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, I64Array
from mlbatch.decode.coverage import ColumnStatistics, ColumnStats
from mlbatch.decode.engine import EngineSetup
from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels.native import has_features, load
from mlbatch.decode.numpy_engine import NumpyEngine
from mlbatch.decode.projector import Extras, Projector
from mlbatch.decode.scan_buffer import ScanBuffer, WindowColumns
from mlbatch.lidar.geometry import SECTORS, Tabled, Turning, rotor_angles
from mlbatch.lidar.interface import Lidar
from mlbatch.lidar.pixel_table import BitField, PixelTable, ReturnLayout

AnyArray: TypeAlias = npt.NDArray[np.generic]

_COLUMNS_SOURCE = "mlbatch.decode.kernels._columns_source"
_ANGLES_SOURCE = "mlbatch.decode.kernels._angles_source"
_INTERLEAVE_SOURCE = "mlbatch.decode.kernels._relay_source"
_PARTS_SOURCE = "mlbatch.decode.kernels._parts_source"
_STATISTICS_SOURCE = "mlbatch.decode.kernels._outline_source"

# CPU features for packing a register of eight lanes by a mask.
_LANES = 8
_PACKING_FEATURES = ("avx512f", "avx512bw", "avx512vl", "bmi2", "popcnt")
# Channels that kernels are compiled for: powers of two.
LEAST_PAD = 16
_MOST_PAD = 256
_MOST_RETURNS = 3
_WORD_BYTES = 4
# A pixel of 2 bytes of distance and 1 of intensity.
_READING_BYTES = 3
# Codes of `Lidar.typed_by`, and the bits of the return type in a label.
_TYPED_BY = {"": 0, "order": 1, "level": 2}
_TYPE_BITS = np.uint64(0xFF << 48)


class NumbaEngine:
    """Decodes all sensors by groups; numpy decodes those without a kernel."""

    def __init__(self, setup: EngineSetup) -> None:
        projectors = setup.projectors
        self._groups: list[SensorGroup | NumpyEngine] = []
        self._interleaver: GroupInterleaver | None = None
        if not any(is_compiled(projector) for projector in projectors):
            self._groups = [NumpyEngine(setup)]
            return
        group_of_sensor = np.empty(len(setup.seat), np.int64)
        slots = []
        for number, indices in enumerate(_indices_by_group(projectors)):
            members = _members(projectors, indices, setup.seat)
            own = [projectors[index] for index in indices]
            group_of_sensor[members >= 0] = number
            slots.append(own[0].slots)
            if is_compiled(own[0]):
                group = SensorGroup(own, members, setup.extras, setup.organized_slots)
                self._groups.append(group)
            else:
                seat = np.stack([np.minimum(members, 0), members], axis=1)
                self._groups.append(NumpyEngine(replace(setup, projectors=own, seat=seat)))
        if len(self._groups) > 1 and not setup.organized_slots:
            parts = [
                NumpyGroup(group, count, setup) if isinstance(group, NumpyEngine) else group
                for group, count in zip(self._groups, slots, strict=True)
            ]
            has_numpy = any(isinstance(part, NumpyGroup) for part in parts)
            most = setup.tile_columns if has_numpy else None
            self._interleaver = GroupInterleaver(parts, group_of_sensor, most)

    def column_statistics(self, positions: Sequence[int | None]) -> ColumnStatistics:
        """See `Engine`."""
        return CompiledColumnStatistics(positions)

    def decode(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> int:
        """See `Engine`."""
        if self._interleaver is not None:
            return self._interleaver.decode(columns, start_ns, first_number, out)
        return sum(group.decode(columns, start_ns, first_number, out) for group in self._groups)


class SensorGroup:
    """Sensors that one call of a kernel decodes, from raw columns to points in their final rows."""

    def __init__(
        self,
        projectors: Sequence[Projector],
        member: I64Array,
        extras: Extras,
        organized_slots: int,
    ) -> None:
        """projectors: with equal `group_key`; member: (sensors,) member of the group, else -1.

        extras, organized_slots: as in `EngineSetup`.
        """
        lidar = projectors[0].lidar
        projection = projectors[0].projection
        table = lidar.pixels
        if table is None:
            raise ValueError(f"no kernel for {lidar.model}")
        self._rings = [source.ring for one in projectors for source in one.sources]
        self._pieces: list[AnyArray] = []
        self._counters = [counts for one in projectors for counts in one.counts]
        self._slots = projectors[0].slots
        self._has_rotor_words = isinstance(projection, Turning)
        self._extras = extras
        self._member = member
        self.kernel = load(
            _COLUMNS_SOURCE,
            table.returns[0].distance.word,
            table.step,
            padded(lidar.channels),
            lidar.returns,
            "tabled" if isinstance(projection, Tabled) else "turning",
            _LANES if has_features(*_PACKING_FEATURES) else 1,
        )
        self._tables = group_tables(projectors, table, organized_slots)
        self.frame = self._tables.frame
        # By member: columns, returns, returns without duplicates, in range, outside of boxes.
        self._counts = np.zeros((len(self._counters), 5), np.int64)
        self._tables.set({at.MEMBER: member, at.COUNTS: self._counts})

    def decode(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> int:
        """Decode the columns of this group's sensors; otherwise as `Engine.decode`."""
        self.prepare(columns, start_ns, first_number, out)
        count = self.kernel(self.frame)
        self.add_counts()
        return count

    def prepare(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> None:
        """Write the arguments of `decode` to the frame of the kernel."""
        tables = self._tables
        tables.set_numbers(
            {
                at.BEGIN: 0,
                at.END: len(columns),
                at.ROW: 0,
                at.NUMBER: 0,
                at.START_NS: start_ns,
                at.FIRST_NUMBER: first_number,
            }
        )
        tables.set(
            {
                at.STAMP_NS: np.asarray(columns.stamp_ns, np.int64),
                at.SENSOR: np.asarray(columns.sensor, np.int64),
                at.PLACE: np.asarray(columns.ring_index, np.int64),
                at.ENCODER: np.asarray(columns.encoder, np.int64),
            }
        )
        if self._has_rotor_words:
            self._set_angles(columns)
        # References are kept until the kernel returns: another thread may let a ring grow.
        self._pieces = [ring.pieces for ring in self._rings]
        tables.set({at.RINGS: _addresses(self._pieces)})
        _set_outputs(tables, out, self._extras)
        self._counts[:] = 0

    def _set_angles(self, columns: WindowColumns) -> None:
        own = columns.encoder
        if (self._member < 0).any():
            own = own[self._member[columns.sensor] >= 0]
        cosine, sine = compiled_angles(own)
        self._tables.set({at.COSINE: cosine, at.SINE: sine})

    def add_counts(self) -> None:
        """Add the counts of the kernel since `prepare` to the point counters."""
        slots = self._slots
        for counts, row in zip(self._counters, self._counts.tolist(), strict=True):
            columns, found, distinct, in_range, outside = row
            counts.slots += columns * slots
            counts.no_return += columns * slots - found
            counts.repeated += found - distinct
            counts.range += distinct - in_range
            counts.box += in_range - outside
            counts.written += outside


class NumpyGroup:
    """Sensors that numpy decodes between groups with kernels; the interface of `SensorGroup`."""

    def __init__(self, engine: NumpyEngine, slots: int, setup: EngineSetup) -> None:
        """slots: slots of a column."""
        columns = setup.tile_columns
        self.kernel = load(_PARTS_SOURCE)
        self._engine = engine
        self._extras = setup.extras
        self._decoded = ScanBuffer(columns * slots, None)
        self._points = np.zeros(columns, np.int64)
        self._tables = Tables(at.SIZE)
        self.frame = self._tables.frame
        self._tables.set(
            {
                # The interleaver looks for no records of these sensors.
                at.MEMBER: np.full(len(setup.seat), -1),
                at.POINTS: self._points,
                at.PART_POINT: self._decoded.point,
                at.PART_LABEL: self._decoded.label,
                at.PART_RANGE: self._decoded.range_m,
                at.PART_REFLECTIVITY: self._decoded.reflectivity,
            }
        )

    def prepare(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> None:
        """Decode the columns to a buffer, and set the frame so that the kernel copies them."""
        points = self._points[: len(columns)]
        self._engine.decode(columns, start_ns, first_number, self._decoded, points)
        self._tables.set_numbers({at.NUMBER: 0, at.FIRST_NUMBER: first_number})
        self._tables.set({at.SENSOR: columns.sensor})
        _set_outputs(self._tables, out, self._extras)

    def add_counts(self) -> None:
        """Do nothing: the projectors count."""


class GroupInterleaver:
    """Decodes dense scans of several groups, whose kernels are called in column order."""

    def __init__(
        self,
        groups: Sequence[SensorGroup | NumpyGroup],
        group_of_sensor: I64Array,
        most_columns: int | None,
    ) -> None:
        """most_columns: columns of one pass; None: all of a window."""
        self._groups = groups
        self._most_columns = most_columns
        self._kernel = load(_INTERLEAVE_SOURCE)
        self._tables = Tables(at.RELAY_SIZE)
        addresses = [(group.kernel.address, group.frame.ctypes.data) for group in groups]
        self._tables.set(
            {at.RELAY_KIND: group_of_sensor, at.RELAY_KERNELS: np.array(addresses, np.int64)}
        )

    def decode(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> int:
        """See `Engine.decode`."""
        tables = self._tables
        most = self._most_columns or max(len(columns), 1)
        row = 0
        for begin in range(0, len(columns), most):
            some = columns.take(slice(begin, begin + most))
            for group in self._groups:
                group.prepare(some, start_ns, first_number + begin, out)
            tables.set({at.RELAY_SENSOR: np.asarray(some.sensor, np.int64)})
            tables.set_numbers({at.RELAYED: len(some), at.RELAY_ROW: row})
            row = self._kernel(tables.frame)
            for group in self._groups:
                group.add_counts()
        return row


class CompiledColumnStatistics(ColumnStatistics):
    """Column statistics of every sensor, by a kernel in one pass."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        super().__init__(positions)
        self._kernel = load(_STATISTICS_SOURCE, SECTORS)
        self._figures = np.zeros((len(positions), at.OUTLINE_FIGURES), np.int64)
        self._tables = Tables(at.OUTLINE_SIZE)
        self._tables.set_numbers({at.OUTLINE_SENSORS: len(positions)})
        self._tables.set(
            {
                at.OUTLINE_POSITIONS: np.array([one or 0 for one in positions], np.int64),
                at.OUTLINE_PASSES: np.zeros((len(positions), SECTORS), np.int64),
                at.OUTLINE_FOUND: self._figures,
            }
        )

    def measure(self, columns: WindowColumns) -> list[ColumnStats]:
        """See `ColumnStatistics`; numpy measures if a position is beyond the revolution."""
        self._tables.set_numbers({at.OUTLINED: len(columns)})
        self._tables.set(
            {
                at.OUTLINE_STAMP_NS: np.asarray(columns.stamp_ns, np.int64),
                at.OUTLINE_SENSOR: np.asarray(columns.sensor, np.int64),
                at.OUTLINE_ENCODER: np.asarray(columns.encoder, np.int64),
            }
        )
        if self._kernel(self._tables.frame):
            return super().measure(columns)
        return [
            ColumnStats(count, gap_ns, passed / SECTORS, passed_again / SECTORS)
            for count, gap_ns, passed, passed_again, *_ in self._figures.tolist()
        ]


def compiled_angles(words: I64Array) -> tuple[F32Array, F32Array]:
    """Return the result of `rotor_angles` for rotor words (n,), equal to the last bit."""
    words = np.ascontiguousarray(words)
    cosine, sine = np.empty((2, len(words)), np.float32)
    tables = Tables(at.ANGLE_SIZE)
    tables.set_numbers({at.ANGLES: len(words)})
    tables.set({at.ANGLE_WORDS: words, at.ANGLE_COSINE: cosine, at.ANGLE_SINE: sine})
    if load(_ANGLES_SOURCE)(tables.frame):
        # NaN where the kernel is not sure of the last bit.
        unsure = np.isnan(cosine)
        cosine[unsure], sine[unsure] = rotor_angles(words[unsure])
    return cosine, sine


# -- which sensors kernels decode, and in which groups --------------------------------------------


def is_compiled(projector: Projector) -> bool:
    """Return whether there is a kernel for the sensors of a projector."""
    lidar = projector.lidar
    projection = projector.projection
    if isinstance(projection, Tabled):
        is_known = projection.origin.shape[2] == 1
    else:
        is_known = isinstance(projection, Turning)
    fits = lidar.returns <= _MOST_RETURNS and padded(lidar.channels) <= _MOST_PAD
    # numpy raises an error for a slot beyond the row; a kernel would write there.
    fits &= int(projector.number.max()) < projector.slots
    return is_known and fits and lidar.pixels is not None and _is_readable(lidar, lidar.pixels)


def _is_readable(lidar: Lidar, table: PixelTable) -> bool:
    """Return whether kernels know the shape of the pixels, and all are inside of the records."""
    if any(channel >= lidar.channels for channel in table.dark):
        return False
    return all(_is_readable_return(lidar, table, layout) for layout in table.returns)


def _is_readable_return(lidar: Lidar, table: PixelTable, layout: ReturnLayout) -> bool:
    records = lidar.records
    fields = [layout.distance, layout.intensity]
    if layout.reflectivity is not None:
        fields.append(layout.reflectivity)
    ends = [run.first_byte + run.channels * table.step for run in layout.runs]
    if layout.distance.word == "<u4":
        begins = (records.start, records.stride, records.step, layout.runs[0].first_byte)
        is_aligned = all(number % _WORD_BYTES == 0 for number in (*begins, table.step))
        is_known = (
            is_aligned
            and len(layout.runs) == 1
            and not table.dark
            and all(
                field.word == "<u4" and field.first + _WORD_BYTES <= table.step for field in fields
            )
        )
    else:
        is_known = (
            layout.distance.first == 0
            and layout.intensity == BitField(2, "u1")
            and layout.reflectivity is None
        )
        ends = [end - table.step + _READING_BYTES for end in ends]
    has_channels = all(run.channel + run.channels <= lidar.channels for run in layout.runs)
    return is_known and has_channels and max(ends) <= records.size


def padded(channels: int) -> int:
    """Return the number of channels that a kernel is compiled for."""
    return max(LEAST_PAD, 1 << (channels - 1).bit_length())


def _indices_by_group(projectors: Sequence[Projector]) -> list[list[int]]:
    """Return the projectors of each group; one without a kernel has a group of its own."""
    groups: dict[Hashable, list[int]] = {}
    for number, projector in enumerate(projectors):
        has_kernel = is_compiled(projector)
        key = group_key(projector) if has_kernel else number
        groups.setdefault((has_kernel, key), []).append(number)
    return list(groups.values())


def group_key(projector: Projector) -> Hashable:
    """Return a key that is equal for projectors whose sensors can share a frame.

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


# -- frames: addresses of tables and arrays, by the constants of `kernels/frame.py` ---------------


class Tables:
    """A frame, and references to the arrays whose addresses it contains."""

    def __init__(self, size: int) -> None:
        self.frame = np.zeros(size, np.int64)
        self._arrays: dict[int, AnyArray] = {}

    def set(self, arrays: Mapping[int, AnyArray]) -> None:
        """Write the addresses of arrays to their indices; they are kept until replaced."""
        for index, values in arrays.items():
            # Often the same array as in the last call.
            if self._arrays.get(index) is not values:
                array = np.ascontiguousarray(values)
                self._arrays[index] = array
                self.frame[index] = array.ctypes.data

    def set_numbers(self, numbers: Mapping[int, int]) -> None:
        """Write numbers to their indices."""
        for index, number in numbers.items():
            self.frame[index] = number


def group_tables(
    projectors: Sequence[Projector], table: PixelTable, organized_slots: int
) -> Tables:
    """Return the tables that are equal for all windows; arguments: see `SensorGroup`."""
    first = projectors[0]
    pad = padded(first.lidar.channels)
    tables = Tables(at.SIZE)
    _set_pixels(tables, first, table)
    rotors = [one.projection for one in projectors if isinstance(one.projection, Turning)]
    if isinstance(first.projection, Tabled):
        _set_angle_table(tables, first, first.projection, pad)
    elif rotors:
        _set_rotors(tables, first.lidar.channels, rotors, pad)
    _set_slots(tables, first, pad)
    _set_labels(tables, projectors, pad)
    if any(one.is_limited for one in projectors):
        tables.set({at.LIMITS: np.concatenate([one.limits_m for one in projectors])})
    tables.set({at.BOXES: first.boxes_m})
    tables.set_numbers({at.BOX_COUNT: len(first.boxes_m), at.WIDTH: organized_slots})
    return tables


def _set_outputs(tables: Tables, out: ScanBuffer, extras: Extras) -> None:
    """Set the arrays that receive points; organized rows are always written as a whole."""
    tables.set({at.POINT: out.point, at.LABEL: out.label})
    if out.is_organized or "range_m" in extras:
        tables.set({at.RANGE: out.range_m})
    if out.is_organized or "reflectivity" in extras:
        tables.set({at.REFLECTIVITY: out.reflectivity})
    if "column" in extras and not out.is_organized:
        tables.set({at.COLUMN: out.column})


def _addresses(pieces: Sequence[AnyArray]) -> I64Array:
    """Return address, shape and strides of two-dimensional arrays: (k, 5)."""
    rows = [(one.ctypes.data, *one.shape, *one.strides) for one in pieces]
    return np.array(rows, np.int64)


def _set_pixels(tables: Tables, projector: Projector, table: PixelTable) -> None:
    lidar = projector.lidar
    runs = [
        [(run.first_byte, run.channel, run.channels) for run in layout.runs]
        for layout in table.returns
    ]
    fields = [
        [
            *_bit_field(layout.distance),
            *_bit_field(layout.intensity),
            *_bit_field(layout.reflectivity),
        ]
        for layout in table.returns
    ]
    has_reflectivity = (
        lidar.has_reflectivity
        and "reflectivity" in projector.extras
        and table.returns[0].reflectivity is not None
    )
    tables.set(
        {
            at.RUNS: np.array(runs, np.int64),
            at.FIELDS: np.array(fields, np.int64),
            at.SCALE: np.array([table.factor, table.divisor], np.float32),
            at.DARK: np.array(table.dark, np.int64),
        }
    )
    tables.set_numbers(
        {
            at.SLOTS: projector.slots,
            at.RECORD_BYTES: lidar.records.size,
            at.RUN_COUNT: len(runs[0]),
            at.SILENT: table.silent,
            at.DARK_COUNT: len(table.dark),
            at.HAS_REFLECTIVITY: has_reflectivity,
        }
    )


def _set_angle_table(tables: Tables, projector: Projector, projection: Tabled, pad: int) -> None:
    shape = (len(projector.sources), projector.lidar.channels)
    tables.set(
        {
            at.DIRECTION: _padded_beams(projection.direction, pad),
            at.ORIGIN: projection.origin,
            at.FIRST_ROW: projection.first_position,
            at.REACH: _padded_beams(np.broadcast_to(projection.reaches_m, shape), pad),
        }
    )
    tables.set_numbers({at.ROWS: len(projection.direction), at.TABLES: 1})


def _set_rotors(tables: Tables, channels: int, members: Sequence[Turning], pad: int) -> None:
    first = members[0]
    tables.set(
        {
            at.DIRECTION: _padded_beams(np.stack([one.direction for one in members]), pad),
            at.ORIGIN: _padded_beams(np.stack([one.origin for one in members]), pad),
            at.VECTORS: np.array([_nonzero_vectors(one) for one in members], np.int64),
        }
    )
    tables.set_numbers({at.TABLES: len(first.firing_ns)})
    if first.has_reach:
        reaches_m = [np.broadcast_to(one.reach_m, (channels,)) for one in members]
        tables.set({at.REACH: _padded_beams(np.stack(reaches_m), pad)})
    if not first.fires_at_once:
        firing_ns = np.concatenate([one.firing_ns for one in members])
        tables.set({at.FIRING: _padded_beams(firing_ns, pad)})


def _nonzero_vectors(projection: Turning) -> int:
    """Return bits of the vectors that are not zero, by axis; see `at.VECTORS`."""
    bits = _nonzero_axes(projection.direction[:2])
    bits |= _nonzero_axes(projection.direction[2:]) << 3
    if projection.origin_turns:
        bits |= _nonzero_axes(projection.origin[:2]) << 6
    bits |= _nonzero_axes(projection.origin[2:]) << 9
    return bits


def _nonzero_axes(vectors: F32Array) -> int:
    """Return bits of the axes in which (k, 3, B) vectors are not zero for all beams."""
    return sum(1 << axis for axis in range(3) if vectors[:, axis].any())


def _set_slots(tables: Tables, projector: Projector, pad: int) -> None:
    lidar = projector.lidar
    element = _elements(projector, pad)
    number = np.zeros(lidar.returns * pad, np.int64)
    number[element] = projector.number
    tables.set({at.SLOT: number})
    if projector.order is not None:
        tables.set({at.ORDER: element[projector.order]})
    elif lidar.returns > 1:
        tables.set({at.ORDER: element})
    has_orders = projector.order is not None and len(projector.order) > 1
    tables.set_numbers(
        {
            at.ORDER_STEP: projector.slots if has_orders else 0,
            at.TYPED: _typed_by(lidar),
            at.SENT_TWICE: lidar.sends_twice,
            at.DROPS_REPEATED: projector.drops_duplicates,
        }
    )


def _set_labels(tables: Tables, projectors: Sequence[Projector], pad: int) -> None:
    first = projectors[0]
    words = np.concatenate([one.labels for one in projectors])
    if _typed_by(first.lidar):
        # The kernel adds the types of dual returns.
        words &= ~_TYPE_BITS
    labels = np.zeros((len(words), first.lidar.returns * pad), np.int64)
    labels[:, _elements(first, pad)] = words.view(np.int64)
    tables.set({at.LABELS: labels})


def _elements(projector: Projector, pad: int) -> I64Array:
    """Return the kernel's element of each slot: its arrays are returns x padded channels."""
    slot = np.arange(projector.slots)
    returns = projector.lidar.returns
    return slot % returns * pad + slot // returns


def _typed_by(lidar: Lidar) -> int:
    return _TYPED_BY[lidar.typed_by] if lidar.returns == 2 else 0


def _bit_field(field: BitField | None) -> tuple[int, int, int]:
    """Return word, shift and mask of a field in a pixel of words."""
    return (0, 0, 0) if field is None else (field.first // _WORD_BYTES, field.shift, field.mask)


def _padded_beams(values: F32Array, pad: int) -> F32Array:
    """Pad the last axis with zeros to `pad` beams."""
    missing = pad - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)]) if missing else values
