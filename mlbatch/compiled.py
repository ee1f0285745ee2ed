"""The engine `numba`: kinds of sensors whose columns compiled kernels decode.

The kernels do what `projection.py` does, in the same order of float32 operations, column by column
instead of pass by pass (`kernels/_columns_source.py`). A call names tables and arrays by their
addresses in a frame (`kernels/frame.py`).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from mlbatch._compiled_tables import AnyArray, Tables, described, is_compiled, likeness, padded
from mlbatch.buffers import Buffer, Due
from mlbatch.geometry import Tabled, Turning, rotor_angles
from mlbatch.kernels import frame as at
from mlbatch.kernels.native import has_features, load
from mlbatch.projection import Extras, Projector
from mlbatch.tiles import Tiles
from mlbatch.types import I64Array

# Abilities of CPUs that pack eight lanes of a register by a mask.
_LANES, _PACKS = 8, ("avx512f", "avx512bw", "avx512vl", "bmi2", "popcnt")
_COLUMNS_SOURCE, _MERGE_SOURCE = "mlbatch.kernels._columns_source", "mlbatch.kernels._merge_source"


class CompiledKind:
    """Sensors of one kind, from raw columns to points in their final rows."""

    def __init__(
        self, projectors: Sequence[Projector], seat: I64Array, extras: Extras, wide: int
    ) -> None:
        """projectors: as many as are alike; seat: (sensors,) number of each among those of the
        kind, else -1.

        extras: those that the scan has, of any sensor; wide: slots of a row of organized scans; 0:
        scans are dense.
        """
        lidar, projection = projectors[0].lidar, projectors[0].projection
        table = lidar.pixels
        if table is None:
            raise ValueError(f"no kernel for {lidar.model}")
        self._rings = [source.ring for own in projectors for source in own.sources]
        self._ledgers = [counts for own in projectors for counts in own.counts]
        self._slots = projectors[0].slots
        self._turns = isinstance(projection, Turning)
        self._extras = extras
        self._seat = seat
        word = table.echoes[0].distance.word
        kind = "tabled" if isinstance(projection, Tabled) else "turning"
        lanes = _LANES if has_features(*_PACKS) else 1
        self._kernel = load(
            *(_COLUMNS_SOURCE, word, table.step, padded(lidar.channels), lidar.returns, kind, lanes)
        )
        self._tables = described(projectors, table, wide)
        self._tables.set(at.MEMBER, seat)
        self._counts = np.zeros((len(self._ledgers), 5), np.int64)
        self._tables.set(at.COUNTS, self._counts)

    def decode(
        self, due: Due, start_ns: int, first: int, out: Buffer, points: I64Array | None = None
    ) -> int:
        """Decode those of the columns that are of this kind, from the buffer's first row on.

        first: number of the first column; points: (n,), what each column gave is put there. Gives
        the number of points.
        """
        tables = self._tables
        tables.set_numbers({at.COLUMNS: len(due), at.START_NS: start_ns, at.FIRST_NUMBER: first})
        for place, values in (
            (at.STAMP_NS, due.stamp_ns),
            (at.SENSOR, due.sensor),
            (at.PLACE, due.place),
            (at.ENCODER, due.encoder),
        ):
            tables.set(place, np.asarray(values, np.int64))
        self._aim(due)
        tables.set(at.RINGS, _rings([ring.pieces for ring in self._rings]))
        self._aim_at(out, points)
        self._counts[:] = 0
        count = self._kernel(tables.frame)
        self._account()
        return count

    def _aim(self, due: Due) -> None:
        if not self._turns:
            return
        own = due.encoder
        if (self._seat < 0).any():
            own = own[self._seat[due.sensor] >= 0]
        cosine, sine = rotor_angles(own)
        self._tables.set(at.COSINE, cosine)
        self._tables.set(at.SINE, sine)

    def _aim_at(self, out: Buffer, points: I64Array | None) -> None:
        extras, is_wide = self._extras, out.is_organized
        tables = self._tables
        tables.set(at.POINT, out.point)
        tables.set(at.LABEL, out.label)
        for place, name, values in (
            (at.RANGE, "range_m", out.range_m),
            (at.REFLECTIVITY, "reflectivity", out.reflectivity),
        ):
            if is_wide or name in extras:
                tables.set(place, values)
        if "column" in extras and points is None and not is_wide:
            tables.set(at.COLUMN, out.column)
        if points is not None:
            tables.set(at.POINTS, points)

    def _account(self) -> None:
        slots = self._slots
        for counts, row in zip(self._ledgers, self._counts.tolist(), strict=True):
            columns, found, single, in_range, outside = row
            counts.slots += columns * slots
            counts.no_return += columns * slots - found
            counts.repeated += found - single
            counts.range += single - in_range
            counts.box += in_range - outside
            counts.written += outside


class Merger:
    """Joins the dense points of several kinds in the order of the scan."""

    def __init__(self, kind: I64Array, extras: frozenset[str]) -> None:
        """kind: (sensors,) of each."""
        self._extras = extras
        self._kernel = load(_MERGE_SOURCE)
        self._tables = Tables(at.MERGE_SIZE)
        self._tables.set(at.MERGE_KIND, kind)

    def merge(
        self,
        sensor: I64Array,
        points: I64Array,
        parts: Sequence[Buffer],
        out: Buffer,
        row: int,
        first: int,
    ) -> int:
        """Points of columns (n,), from the buffers of all kinds to `out` from `row` on.

        points: (n,) of each column; first: number of the first column. Gives how many there are.
        """
        tables, planes = self._tables, [_planes(part) for part in parts]
        tables.set_numbers({at.MERGED: len(sensor), at.MERGE_NUMBER: first})
        tables.set(at.MERGE_SENSOR, sensor)
        tables.set(at.MERGE_POINTS, points)
        addresses = [[plane.ctypes.data for plane in planes_of] for planes_of in planes]
        tables.set(at.MERGE_PARTS, np.array(addresses, np.int64))
        tables.set(at.MERGE_POINT, out.point[row:])
        tables.set(at.MERGE_LABEL, out.label[row:])
        for place, name, values in (
            (at.MERGE_RANGE, "range_m", out.range_m),
            (at.MERGE_REFLECTIVITY, "reflectivity", out.reflectivity),
            (at.MERGE_COLUMN, "column", out.column),
        ):
            if name in self._extras:
                tables.set(place, values[row:])
        return self._kernel(tables.frame)


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
        self._columns = columns
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
        if len(slots) > 1 and not wide:
            self._merger = Merger(kind, extras)
            self._parts = [Buffer(columns * count, None) for count in slots]
            self._points = np.zeros(columns, np.int64)

    def decode(self, due: Due, start_ns: int, first: int, out: Buffer) -> int:
        """As `CompiledKind.decode`, of all sensors."""
        if out.is_organized or len(self._kinds) == 1:
            return sum(kind.decode(due, start_ns, first, out) for kind in self._kinds)
        row = 0
        for begin in range(0, len(due), self._columns):
            tile = due.part(slice(begin, begin + self._columns))
            points = self._points[: len(tile)]
            for kind, part in zip(self._kinds, self._parts, strict=True):
                kind.decode(tile, start_ns, first + begin, part, points)
            row += self._merger.merge(tile.sensor, points, self._parts, out, row, first + begin)
        return row


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


def _rings(pieces: Sequence[AnyArray]) -> I64Array:
    return np.array(
        [
            (one.ctypes.data, one.shape[0], one.shape[1], one.strides[0], one.strides[1])
            for one in pieces
        ],
        np.int64,
    )


def _planes(part: Buffer) -> tuple[AnyArray, ...]:
    return part.point, part.label, part.range_m, part.reflectivity
