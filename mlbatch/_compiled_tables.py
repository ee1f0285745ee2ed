"""Tables of a kind of sensors, laid out for the kernels once (`kernels/frame.py`)."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import numpy.typing as npt

from mlbatch.geometry import Tabled, Turning
from mlbatch.kernels import frame as at
from mlbatch.lidar import Lidar
from mlbatch.pixels import Bits, PixelTable
from mlbatch.projection import Projector
from mlbatch.types import F32Array, I64Array

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
    for echo in table.echoes:
        fields = [one for one in (echo.distance, echo.intensity, echo.reflectivity) if one]
        ends = [run.first_byte + run.channels * table.step for run in echo.runs]
        if echo.distance.word == "<u4":
            begins = (records.start, records.stride, records.step, echo.runs[0].first_byte)
            aligned = all(number % _WORD_BYTES == 0 for number in (*begins, table.step))
            good = aligned and len(echo.runs) == 1 and not table.dark
            good &= all(
                one.word == "<u4" and one.first + _WORD_BYTES <= table.step for one in fields
            )
        else:
            level = Bits(2, "u1")
            good = echo.distance.first == 0 and echo.intensity == level and len(fields) == 2
            ends = [end - table.step + _READING_BYTES for end in ends]
        good &= all(run.channel + run.channels <= lidar.channels for run in echo.runs)
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
    """All that stays the same from window to window; wide: see `compiled.CompiledKind`.

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
        [(run.first_byte, run.channel, run.channels) for run in echo.runs] for echo in table.echoes
    ]
    fields = [
        [*_field(echo.distance), *_field(echo.intensity), *_field(echo.reflectivity)]
        for echo in table.echoes
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
            at.HAS_REFLECTIVITY: wanted and table.echoes[0].reflectivity is not None,
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


def _field(field: Bits | None) -> tuple[int, int, int]:
    return (0, 0, 0) if field is None else (field.first // _WORD_BYTES, field.shift, field.mask)


def _axes(vectors: F32Array) -> int:
    """Bits of the axes in which (k, 3, B) vectors are not zero for all beams."""
    return sum(1 << axis for axis in range(3) if vectors[:, axis].any())


def _wide(values: F32Array, pad: int) -> F32Array:
    """Planes (..., B) as (..., P)."""
    missing = pad - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, missing)]) if missing else values
