"""The engine `numba`: kinds of sensors whose columns compiled kernels decode.

The kernels do what `projection.py` does, in the same order of float32 operations, column by column
instead of pass by pass (`kernels/_columns_source.py`). A call names tables and arrays by their
addresses in a frame (`kernels/frame.py`).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from mlbatch._compiled_tables import (
    AnyArray,
    Tables,
    described,
    is_compiled,
    likeness,
    padded,
)
from mlbatch.buffers import Buffer, Due
from mlbatch.geometry import Tabled, Turning, rotor_angles
from mlbatch.kernels import frame as at
from mlbatch.kernels.native import has_features, load
from mlbatch.projection import Extras, Projector
from mlbatch.tiles import Tiles
from mlbatch.types import F32Array, I64Array

# Abilities of CPUs that pack eight lanes of a register by a mask.
_LANES, _PACKS = 8, ("avx512f", "avx512bw", "avx512vl", "bmi2", "popcnt")
_COLUMNS_SOURCE = "mlbatch.kernels._columns_source"
_ANGLES_SOURCE = "mlbatch.kernels._angles_source"
_RELAY_SOURCE, _PARTS_SOURCE = "mlbatch.kernels._relay_source", "mlbatch.kernels._parts_source"


class CompiledKind:
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
        word = table.echoes[0].distance.word
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

    def decode(self, due: Due, start_ns: int, first: int, out: Buffer) -> int:
        """Decode those of the columns that are of this kind, from the buffer's first row on.

        first: number of the first column. Gives the number of points.
        """
        self.prepare(due, start_ns, first, out)
        count = self.kernel(self.frame)
        self.account()
        return count

    def prepare(self, due: Due, start_ns: int, first: int, out: Buffer) -> None:
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

    def _aim(self, due: Due) -> None:
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


class CopiedKind:
    """Sensors of one kind that numpy decodes, where others have kernels: as CompiledKind."""

    def __init__(
        self, tiles: Tiles, slots: int, columns: int, sensors: int, extras: Extras
    ) -> None:
        """slots: of a column; columns: the most that are decoded at once; sensors: of the rig."""
        self.kernel = load(_PARTS_SOURCE)
        self._tiles = tiles
        self._extras = extras
        self._part = part = Buffer(columns * slots, None)
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

    def prepare(self, due: Due, start_ns: int, first: int, out: Buffer) -> None:
        """Decode the columns of the kind; what has to be copied goes into the kernel's frame."""
        self._tiles.decode(due, start_ns, first, self._part, self._points[: len(due)])
        self._tables.set_numbers({at.NUMBER: 0, at.FIRST_NUMBER: first})
        self._tables.set(at.SENSOR, due.sensor)
        _put_outputs(self._tables, out, self._extras)

    def account(self) -> None:
        """Nothing: numpy keeps ledgers of its own."""


class Relay:
    """Decodes dense scans of several kinds of sensors, whose kernels take turns."""

    def __init__(
        self, kinds: Sequence[CompiledKind | CopiedKind], kind: I64Array, most: int | None
    ) -> None:
        """kind: (sensors,) of each; most: columns that are decoded at once, None for all."""
        self._kinds = kinds
        self._most = most
        self._kernel = load(_RELAY_SOURCE)
        self._tables = Tables(at.RELAY_SIZE)
        addresses = [(one.kernel.address, one.frame.ctypes.data) for one in kinds]
        self._tables.set(at.RELAY_KIND, kind)
        self._tables.set(at.RELAY_KERNELS, np.array(addresses, np.int64))

    def decode(self, due: Due, start_ns: int, first: int, out: Buffer) -> int:
        """As `CompiledKind.decode`, of all sensors."""
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


class Kinds:
    """All kinds of sensors of a rig, as `tiles.Tiles`; numpy decodes what has no kernel."""

    def __init__(
        self,
        projectors: Sequence[Projector],
        seat: I64Array,
        columns: int,
        first_sensor: int,
        extras: Extras,
        wide: int,
    ) -> None:
        """wide: see CompiledKind; all else as of Tiles."""
        self._kinds: list[CompiledKind | Tiles] = []
        self._relay: Relay | None = None
        if not any(is_compiled(projector) for projector in projectors):
            self._kinds = [Tiles(projectors, seat, columns, first_sensor, extras)]
            return
        kind, slots = np.empty(len(seat), np.int64), []
        for number, group in enumerate(_alike(projectors)):
            member = _members(projectors, group, seat)
            alike = [projectors[which] for which in group]
            kind[member >= 0] = number
            slots.append(alike[0].slots)
            if is_compiled(alike[0]):
                self._kinds.append(CompiledKind(alike, member, extras, wide))
            else:
                own = np.stack([np.minimum(member, 0), member], axis=1)
                self._kinds.append(Tiles(alike, own, columns, first_sensor, extras))
        if len(self._kinds) > 1 and not wide:
            parts = [
                CopiedKind(one, count, columns, len(seat), extras)
                if isinstance(one, Tiles)
                else one
                for one, count in zip(self._kinds, slots, strict=True)
            ]
            has_copies = any(isinstance(part, CopiedKind) for part in parts)
            self._relay = Relay(parts, kind, columns if has_copies else None)

    def decode(self, due: Due, start_ns: int, first: int, out: Buffer) -> int:
        """As `CompiledKind.decode`, of all sensors."""
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


def _put_outputs(tables: Tables, out: Buffer, extras: Extras) -> None:
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
