"""The engine `numba`: kinds of sensors whose columns compiled kernels decode.

The kernels do what `projection.py` does, in the same order of float32 operations, column by column
instead of pass by pass (`kernels/_columns_source.py`). A call names tables and arrays by their
addresses in a frame (`kernels/frame.py`).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F32Array, I64Array
from mlbatch.decode.coverage import ColumnStatistics, ColumnStats
from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels.native import has_features, load
from mlbatch.decode.numpy_engine import NumpyEngine
from mlbatch.decode.projector import Extras, Projector
from mlbatch.decode.scan_buffer import ScanBuffer, WindowColumns
from mlbatch.lidar.geometry import SECTORS, Tabled, Turning, rotor_angles
from mlbatch.lidar.interface import Lidar
from mlbatch.lidar.pixel_table import BitField, PixelTable

# Abilities of CPUs that pack eight lanes of a register by a mask.
_LANES, _PACKS = 8, ("avx512f", "avx512bw", "avx512vl", "bmi2", "popcnt")
_COLUMNS_SOURCE = "mlbatch.decode.kernels._columns_source"
_ANGLES_SOURCE = "mlbatch.decode.kernels._angles_source"
_RELAY_SOURCE, _PARTS_SOURCE = (
    "mlbatch.decode.kernels._relay_source",
    "mlbatch.decode.kernels._parts_source",
)


class SensorGroup:
    """Sensors of one kind, from raw columns to points in their final rows."""

    def __init__(
        self, projectors: Sequence[Projector], seat: I64Array, extras: Extras, wide: int
    ) -> None:
        """projectors: as many as are alike.

        seat: (sensors,) number of each among those of the kind, else -1; extras: those that the
        scan has, of any sensor; wide: slots of a row of organized scans; 0: scans are dense.
        """
        lidar, projection = projectors[0].lidar, projectors[0].projection
        table = lidar.pixels
        if table is None:
            raise ValueError(f"no kernel for {lidar.model}")
        self._pieces: list[AnyArray] = []
        self._rings = [source.ring for own in projectors for source in own.sources]
        self._ledgers = [counts for own in projectors for counts in own.counts]
        self._slots = projectors[0].slots
        self._turns = isinstance(projection, Turning)
        self._extras = extras
        self._seat = seat
        word = table.returns[0].distance.word
        kind = "tabled" if isinstance(projection, Tabled) else "turning"
        lanes = _LANES if has_features(*_PACKS) else 1
        self.kernel = load(
            *(_COLUMNS_SOURCE, word, table.step, padded(lidar.channels), lidar.returns, kind, lanes)
        )
        self._tables = described(projectors, table, wide)
        self.frame = self._tables.frame
        self._tables.set(at.MEMBER, seat)
        self._counts = np.zeros((len(self._ledgers), 5), np.int64)
        self._tables.set(at.COUNTS, self._counts)

    def decode(self, due: WindowColumns, start_ns: int, first: int, out: ScanBuffer) -> int:
        """Decode those of the columns that are of this kind, from the buffer's first row on.

        first: number of the first column. Gives the number of points.
        """
        self.prepare(due, start_ns, first, out)
        count = self.kernel(self.frame)
        self.account()
        return count

    def prepare(self, due: WindowColumns, start_ns: int, first: int, out: ScanBuffer) -> None:
        """What the kernel needs for `decode` goes into its frame."""
        tables = self._tables
        tables.set_numbers({at.BEGIN: 0, at.END: len(due), at.ROW: 0, at.NUMBER: 0})
        tables.set_numbers({at.START_NS: start_ns, at.FIRST_NUMBER: first})
        for place, values in (
            (at.STAMP_NS, due.stamp_ns),
            (at.SENSOR, due.sensor),
            (at.PLACE, due.place),
            (at.ENCODER, due.encoder),
        ):
            tables.set(place, np.asarray(values, np.int64))
        self._aim(due)
        # Held until the kernel is done: another thread may put larger ones in their place.
        self._pieces = [ring.pieces for ring in self._rings]
        tables.set(at.RINGS, _places(self._pieces))
        _put_outputs(tables, out, self._extras)
        self._counts[:] = 0

    def _aim(self, due: WindowColumns) -> None:
        if not self._turns:
            return
        own = due.encoder
        if (self._seat < 0).any():
            own = own[self._seat[due.sensor] >= 0]
        cosine, sine = compiled_angles(own)
        self._tables.set(at.COSINE, cosine)
        self._tables.set(at.SINE, sine)

    def account(self) -> None:
        """Add to the ledgers what the kernel counted since `prepare`."""
        slots = self._slots
        for counts, row in zip(self._ledgers, self._counts.tolist(), strict=True):
            columns, found, single, in_range, outside = row
            counts.slots += columns * slots
            counts.no_return += columns * slots - found
            counts.repeated += found - single
            counts.range += single - in_range
            counts.box += in_range - outside
            counts.written += outside


def compiled_angles(words: I64Array) -> tuple[F32Array, F32Array]:
    """What `rotor_angles` gives for rotor words (n,), to the last bit."""
    words = np.ascontiguousarray(words)
    cosine, sine = np.empty((2, len(words)), np.float32)
    tables = Tables(at.ANGLE_SIZE)
    tables.set_numbers({at.ANGLES: len(words)})
    for place, values in (
        (at.ANGLE_WORDS, words),
        (at.ANGLE_COSINE, cosine),
        (at.ANGLE_SINE, sine),
    ):
        tables.set(place, values)
    if load(_ANGLES_SOURCE)(tables.frame):
        unsure = np.isnan(cosine)
        cosine[unsure], sine[unsure] = rotor_angles(words[unsure])
    return cosine, sine


class NumpyGroup:
    """Sensors of one kind that numpy decodes, where others have kernels: as SensorGroup."""

    def __init__(
        self, tiles: NumpyEngine, slots: int, columns: int, sensors: int, extras: Extras
    ) -> None:
        """slots: of a column; columns: the most that are decoded at once; sensors: of the rig."""
        self.kernel = load(_PARTS_SOURCE)
        self._tiles = tiles
        self._extras = extras
        self._part = part = ScanBuffer(columns * slots, None)
        self._points = np.zeros(columns, np.int64)
        self._tables = Tables(at.SIZE)
        self.frame = self._tables.frame
        # Nobody is to look for records.
        self._tables.set(at.MEMBER, np.full(sensors, -1))
        for place, values in (
            (at.POINTS, self._points),
            (at.PART_POINT, part.point),
            (at.PART_LABEL, part.label),
            (at.PART_RANGE, part.range_m),
            (at.PART_REFLECTIVITY, part.reflectivity),
        ):
            self._tables.set(place, values)

    def prepare(self, due: WindowColumns, start_ns: int, first: int, out: ScanBuffer) -> None:
        """Decode the columns of the kind; what has to be copied goes into the kernel's frame."""
        self._tiles.decode(due, start_ns, first, self._part, self._points[: len(due)])
        self._tables.set_numbers({at.NUMBER: 0, at.FIRST_NUMBER: first})
        self._tables.set(at.SENSOR, due.sensor)
        _put_outputs(self._tables, out, self._extras)

    def account(self) -> None:
        """Nothing: numpy keeps ledgers of its own."""


class GroupInterleaver:
    """Decodes dense scans of several kinds of sensors, whose kernels take turns."""

    def __init__(
        self, kinds: Sequence[SensorGroup | NumpyGroup], kind: I64Array, most: int | None
    ) -> None:
        """kind: (sensors,) of each; most: columns that are decoded at once, None for all."""
        self._kinds = kinds
        self._most = most
        self._kernel = load(_RELAY_SOURCE)
        self._tables = Tables(at.RELAY_SIZE)
        addresses = [(one.kernel.address, one.frame.ctypes.data) for one in kinds]
        self._tables.set(at.RELAY_KIND, kind)
        self._tables.set(at.RELAY_KERNELS, np.array(addresses, np.int64))

    def decode(self, due: WindowColumns, start_ns: int, first: int, out: ScanBuffer) -> int:
        """As `SensorGroup.decode`, of all sensors."""
        tables, row, most = self._tables, 0, self._most or max(len(due), 1)
        for begin in range(0, len(due), most):
            some = due.part(slice(begin, begin + most))
            for kind in self._kinds:
                kind.prepare(some, start_ns, first + begin, out)
            tables.set(at.RELAY_SENSOR, np.asarray(some.sensor, np.int64))
            tables.set_numbers({at.RELAYED: len(some), at.RELAY_ROW: row})
            row = self._kernel(tables.frame)
            for kind in self._kinds:
                kind.account()
        return row


class NumbaEngine:
    """All kinds of sensors of a rig, as `tiles.NumpyEngine`; numpy decodes what has no kernel."""

    def __init__(
        self,
        projectors: Sequence[Projector],
        seat: I64Array,
        columns: int,
        first_sensor: int,
        extras: Extras,
        wide: int,
    ) -> None:
        """wide: see SensorGroup; all else as of NumpyEngine."""
        self._kinds: list[SensorGroup | NumpyEngine] = []
        self._relay: GroupInterleaver | None = None
        if not any(is_compiled(projector) for projector in projectors):
            self._kinds = [NumpyEngine(projectors, seat, columns, first_sensor, extras)]
            return
        kind, slots = np.empty(len(seat), np.int64), []
        for number, group in enumerate(_alike(projectors)):
            member = _members(projectors, group, seat)
            alike = [projectors[which] for which in group]
            kind[member >= 0] = number
            slots.append(alike[0].slots)
            if is_compiled(alike[0]):
                self._kinds.append(SensorGroup(alike, member, extras, wide))
            else:
                own = np.stack([np.minimum(member, 0), member], axis=1)
                self._kinds.append(NumpyEngine(alike, own, columns, first_sensor, extras))
        if len(self._kinds) > 1 and not wide:
            parts = [
                NumpyGroup(one, count, columns, len(seat), extras)
                if isinstance(one, NumpyEngine)
                else one
                for one, count in zip(self._kinds, slots, strict=True)
            ]
            has_copies = any(isinstance(part, NumpyGroup) for part in parts)
            self._relay = GroupInterleaver(parts, kind, columns if has_copies else None)

    def decode(self, due: WindowColumns, start_ns: int, first: int, out: ScanBuffer) -> int:
        """As `SensorGroup.decode`, of all sensors."""
        if self._relay is not None:
            return self._relay.decode(due, start_ns, first, out)
        return sum(kind.decode(due, start_ns, first, out) for kind in self._kinds)


def _alike(projectors: Sequence[Projector]) -> list[list[int]]:
    """Numbers of the projectors, grouped by kinds; without a kernel each is one of its own."""
    groups: dict[Hashable, list[int]] = {}
    for number, projector in enumerate(projectors):
        key = likeness(projector) if is_compiled(projector) else number
        groups.setdefault((is_compiled(projector), key), []).append(number)
    return list(groups.values())


def _members(projectors: Sequence[Projector], group: Sequence[int], seat: I64Array) -> I64Array:
    """(sensors,) number of each among those of all projectors of a group, -1 for others."""
    member, count = np.full(len(seat), -1), 0
    for which in group:
        own = seat[:, 0] == which
        member[own] = seat[own, 1] + count
        count += len(projectors[which].sources)
    return member


def _places(pieces: Sequence[AnyArray]) -> I64Array:
    return np.array(
        [
            (one.ctypes.data, one.shape[0], one.shape[1], one.strides[0], one.strides[1])
            for one in pieces
        ],
        np.int64,
    )


def _put_outputs(tables: Tables, out: ScanBuffer, extras: Extras) -> None:
    """Where points go; rows of organized scans are always whole."""
    tables.set(at.POINT, out.point)
    tables.set(at.LABEL, out.label)
    for place, name, values in (
        (at.RANGE, "range_m", out.range_m),
        (at.REFLECTIVITY, "reflectivity", out.reflectivity),
    ):
        if out.is_organized or name in extras:
            tables.set(place, values)
    if "column" in extras and not out.is_organized:
        tables.set(at.COLUMN, out.column)


# Tables of a kind of sensors, laid out for the kernels once (`kernels/frame.py`).

AnyArray = npt.NDArray[np.generic]

_LEAST_PAD, _MOST_PAD, _MOST_RETURNS = 16, 256, 3
_TYPED = {"": 0, "order": 1, "level": 2}
_TYPE_BITS = np.uint64(0xFF << 48)
_WORD_BYTES = 4
# Of a pixel of two bytes of distance, and one of level.
_READING_BYTES = 3


class Tables:
    """A frame, and the arrays whose addresses stand in it."""

    def __init__(self, size: int) -> None:
        self.frame = np.zeros(size, np.int64)
        self._held: dict[int, AnyArray] = {}

    def set(self, place: int, values: AnyArray) -> None:
        """Put the address of an array there; it is kept until another one takes its place."""
        # Arrays do not move, and the same ones are often used again.
        if self._held.get(place) is values:
            return
        held = np.ascontiguousarray(values)
        self._held[place] = held
        self.frame[place] = held.ctypes.data

    def set_numbers(self, numbers: dict[int, int]) -> None:
        """Put numbers there."""
        for place, number in numbers.items():
            self.frame[place] = number


def is_compiled(projector: Projector) -> bool:
    """Whether there is a kernel for sensors of this kind."""
    lidar, projection = projector.lidar, projector.projection
    known = isinstance(projection, Turning) or (
        isinstance(projection, Tabled) and projection.origin.shape[2] == 1
    )
    fits = lidar.returns <= _MOST_RETURNS and padded(lidar.channels) <= _MOST_PAD
    # What numpy would refuse as an index, a kernel would write beyond a row.
    fits &= int(projector.number.max()) < projector.slots
    return known and fits and lidar.pixels is not None and _is_read(lidar, lidar.pixels)


def _is_read(lidar: Lidar, table: PixelTable) -> bool:
    """Whether the pixels are of the shapes that kernels read, and inside of the records."""
    records = lidar.records
    if any(channel >= lidar.channels for channel in table.dark):
        return False
    for one in table.returns:
        fields = [one for one in (one.distance, one.intensity, one.reflectivity) if one]
        ends = [run.first_byte + run.channels * table.step for run in one.runs]
        if one.distance.word == "<u4":
            begins = (records.start, records.stride, records.step, one.runs[0].first_byte)
            aligned = all(number % _WORD_BYTES == 0 for number in (*begins, table.step))
            good = aligned and len(one.runs) == 1 and not table.dark
            good &= all(
                one.word == "<u4" and one.first + _WORD_BYTES <= table.step for one in fields
            )
        else:
            level = BitField(2, "u1")
            good = one.distance.first == 0 and one.intensity == level and len(fields) == 2
            ends = [end - table.step + _READING_BYTES for end in ends]
        good &= all(run.channel + run.channels <= lidar.channels for run in one.runs)
        if not good or max(ends) > records.size:
            return False
    return True


def padded(channels: int) -> int:
    """The number of channels that a kernel is compiled for."""
    return max(_LEAST_PAD, 1 << (channels - 1).bit_length())


def likeness(projector: Projector) -> Hashable:
    """Equal where the sensors of several projectors can be members of one frame.

    Of those that turn, directions, labels and limits are of each member, the rest is of them all.
    """
    lidar, projection = projector.lidar, projector.projection
    if not isinstance(projection, Turning):
        return id(projector)
    pixels = lidar.pixels, lidar.records, lidar.channels, lidar.returns, lidar.has_reflectivity
    types = lidar.typed_by, lidar.sends_twice, projector.drops_repeated
    turns = projection.has_reach, projection.fires_at_once, len(projection.firing_ns)
    order = None if projector.order is None else projector.order.tobytes()
    return pixels, types, turns, order, projector.number.tobytes()


def described(projectors: Sequence[Projector], table: PixelTable, wide: int) -> Tables:
    """All that stays the same from window to window; wide: see `compiled.SensorGroup`.

    projectors: as many as are alike.
    """
    one = projectors[0]
    tables, pad = Tables(at.SIZE), padded(one.lidar.channels)
    _put_pixels(tables, one, table)
    turning = [own.projection for own in projectors if isinstance(own.projection, Turning)]
    if isinstance(one.projection, Tabled):
        _put_tabled(tables, one, one.projection, pad)
    elif turning:
        _put_turning(tables, one.lidar.channels, turning, pad)
    _put_slots(tables, one, pad)
    _put_labels(tables, projectors, pad)
    if any(own.is_limited for own in projectors):
        tables.set(at.LIMITS, np.concatenate([own.limits_m for own in projectors]))
    tables.set(at.BOXES, one.boxes_m)
    tables.set_numbers({at.BOX_COUNT: len(one.boxes_m), at.WIDTH: wide})
    return tables


def _put_pixels(tables: Tables, projector: Projector, table: PixelTable) -> None:
    lidar = projector.lidar
    runs = [
        [(run.first_byte, run.channel, run.channels) for run in one.runs] for one in table.returns
    ]
    fields = [
        [*_field(one.distance), *_field(one.intensity), *_field(one.reflectivity)]
        for one in table.returns
    ]
    tables.set(at.RUNS, np.array(runs, np.int64))
    tables.set(at.FIELDS, np.array(fields, np.int64))
    tables.set(at.SCALE, np.array([table.factor, table.divisor], np.float32))
    tables.set(at.DARK, np.array(table.dark, np.int64))
    wanted = lidar.has_reflectivity and "reflectivity" in projector.extras
    tables.set_numbers(
        {
            at.SLOTS: projector.slots,
            at.RECORD_BYTES: lidar.records.size,
            at.RUN_COUNT: len(runs[0]),
            at.SILENT: table.silent,
            at.DARK_COUNT: len(table.dark),
            at.HAS_REFLECTIVITY: wanted and table.returns[0].reflectivity is not None,
        }
    )


def _put_tabled(tables: Tables, projector: Projector, projection: Tabled, pad: int) -> None:
    shape = len(projector.sources), projector.lidar.channels
    tables.set(at.DIRECTION, _wide(projection.direction, pad))
    tables.set(at.ORIGIN, projection.origin)
    tables.set(at.FIRST_ROW, projection.first_position)
    tables.set(at.REACH, _wide(np.broadcast_to(projection.reaches_m, shape), pad))
    tables.set_numbers({at.ROWS: len(projection.direction), at.TABLES: 1})


def _put_turning(tables: Tables, channels: int, members: Sequence[Turning], pad: int) -> None:
    one = members[0]
    tables.set(at.DIRECTION, _wide(np.stack([own.direction for own in members]), pad))
    tables.set(at.ORIGIN, _wide(np.stack([own.origin for own in members]), pad))
    tables.set(at.VECTORS, np.array([_vectors(own) for own in members], np.int64))
    tables.set_numbers({at.TABLES: len(one.firing_ns)})
    if one.has_reach:
        reaches_m = [np.broadcast_to(own.reach_m, (channels,)) for own in members]
        tables.set(at.REACH, _wide(np.stack(reaches_m), pad))
    if not one.fires_at_once:
        tables.set(at.FIRING, _wide(np.concatenate([own.firing_ns for own in members]), pad))


def _vectors(projection: Turning) -> int:
    """Bits of the vectors that count."""
    flags = _axes(projection.direction[:2]) | _axes(projection.direction[2:]) << 3
    flags |= _axes(projection.origin[2:]) << 9
    if projection.origin_turns:
        flags |= _axes(projection.origin[:2]) << 6
    return flags


def _put_slots(tables: Tables, projector: Projector, pad: int) -> None:
    lidar, returns = projector.lidar, projector.lidar.returns
    element = _elements(projector, pad)
    place = np.zeros(returns * pad, np.int64)
    place[element] = projector.number
    tables.set(at.SLOT, place)
    if projector.order is not None:
        tables.set(at.ORDER, element[projector.order])
    elif returns > 1:
        tables.set(at.ORDER, element)
    several = projector.order is not None and len(projector.order) > 1
    tables.set_numbers(
        {
            at.ORDER_STEP: projector.slots if several else 0,
            at.TYPED: _typed(lidar),
            at.SENT_TWICE: lidar.sends_twice,
            at.DROPS_REPEATED: projector.drops_repeated,
        }
    )


def _put_labels(tables: Tables, projectors: Sequence[Projector], pad: int) -> None:
    one = projectors[0]
    words = np.concatenate([own.labels for own in projectors])
    if _typed(one.lidar):
        # Types that the kernel tells stand in no table.
        words &= ~_TYPE_BITS
    labels = np.zeros((len(words), one.lidar.returns * pad), np.int64)
    labels[:, _elements(one, pad)] = words.view(np.int64)
    tables.set(at.LABELS, labels)


def _elements(projector: Projector, pad: int) -> I64Array:
    """The element of each slot."""
    slot, returns = np.arange(projector.slots), projector.lidar.returns
    return slot % returns * pad + slot // returns


def _typed(lidar: Lidar) -> int:
    return _TYPED[lidar.typed_by] if lidar.returns == 2 else 0


def _field(field: BitField | None) -> tuple[int, int, int]:
    return (0, 0, 0) if field is None else (field.first // _WORD_BYTES, field.shift, field.mask)


def _axes(vectors: F32Array) -> int:
    """Bits of the axes in which (k, 3, B) vectors are not zero for all beams."""
    return sum(1 << axis for axis in range(3) if vectors[:, axis].any())


def _wide(values: F32Array, pad: int) -> F32Array:
    """Planes (..., B) as (..., P)."""
    missing = pad - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)]) if missing else values


# Outlines of scans by a compiled loop: what `outline.py` tells, in one pass.

_SOURCE = "mlbatch.decode.kernels._outline_source"


class CompiledColumnStatistics(ColumnStatistics):
    """The same; numpy tells where a position lies beyond the turn."""

    def __init__(self, positions: Sequence[int | None]) -> None:
        super().__init__(positions)
        self._kernel = load(_SOURCE, SECTORS)
        self._figures = np.zeros((len(positions), at.OUTLINE_FIGURES), np.int64)
        self._tables = tables = Tables(at.OUTLINE_SIZE)
        tables.set_numbers({at.OUTLINE_SENSORS: len(positions)})
        for place, values in (
            (at.OUTLINE_POSITIONS, np.array([one or 0 for one in positions], np.int64)),
            (at.OUTLINE_PASSES, np.zeros((len(positions), SECTORS), np.int64)),
            (at.OUTLINE_FOUND, self._figures),
        ):
            tables.set(place, values)

    def measure(self, due: WindowColumns) -> list[ColumnStats]:
        """Of each sensor."""
        self._tables.set_numbers({at.OUTLINED: len(due)})
        for place, values in (
            (at.OUTLINE_STAMP_NS, due.stamp_ns),
            (at.OUTLINE_SENSOR, due.sensor),
            (at.OUTLINE_ENCODER, due.encoder),
        ):
            self._tables.set(place, np.asarray(values, np.int64))
        if self._kernel(self._tables.frame):
            return super().measure(due)
        return [
            ColumnStats(columns, gap_ns, once / SECTORS, again / SECTORS)
            for columns, gap_ns, once, again, *_ in self._figures.tolist()
        ]
