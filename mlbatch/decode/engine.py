"""Decode the columns of a window by the compiled loops (`native/decode.c`), in one call."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.decode.groups import CORRECTED, MIRRORED, TURNING, SensorGroup, Source, group_key
from mlbatch.decode.records import RecordPacker
from mlbatch.decode.scan_buffer import ScanBuffer
from mlbatch.lidar.geometry import angles_rad, rotor_angles
from mlbatch.native.library import Group, Scan, address, library
from mlbatch.reports.ledger import PointCounts
from mlbatch.types import PACKED_ROOM, PackedTotals, RecordLayout, WindowColumns

# Columns of an organized scan that are packed together: slots of several columns are adjacent in
# the output, and all of them fit into the second-level cache.
_NEAR_COLUMNS = 16
# As in `native.h`.
_SPARE_SLOTS = 4
# Points after a column that the loops may overwrite.
_SPARE_POINTS = 4


class Engine:
    """Decodes all sensors of a scan; its record layout, if there is one, is packed as well."""

    def __init__(
        self,
        sources: Sequence[Source],
        boxes_m: F64Array,
        extras: frozenset[str],
        *,
        first_sensor: int = 0,
        organized_slots: int = 0,
        record: RecordLayout | None = None,
        timescale: str = "",
    ) -> None:
        """boxes_m: (k, 6); extras: optional arrays of the scan that some sensor has.

        first_sensor: index of the first source in the scan; organized_slots: slots of a row of an
        organized scan, 0: scans are dense; record: layout of the records that the output takes,
        None: it takes arrays; timescale: of the stamps.
        """
        self.record = record
        self._timescale = timescale
        self._packer: RecordPacker | None = None
        self._library = library()
        self._extras = extras
        # Of the last call; None: before the first.
        self._out: ScanBuffer | None = None
        self._group_of = np.zeros(len(sources), np.int64)
        self._member_of = np.zeros(len(sources), np.int64)
        by_key: dict[Hashable, list[int]] = {}
        for number, source in enumerate(sources):
            by_key.setdefault(group_key(source, number), []).append(number)
        self._structs = (Group * len(by_key))()
        self._groups: list[SensorGroup] = []
        for which, numbers in enumerate(by_key.values()):
            group = SensorGroup(
                [(first_sensor + number, sources[number]) for number in numbers],
                self._structs[which],
                has_reflectivity="reflectivity" in extras,
            )
            self._groups.append(group)
            self._group_of[numbers] = which
            self._member_of[numbers] = np.arange(len(numbers))
        kinds = np.array([struct.kind for struct in self._structs])[self._group_of]
        self._turns = np.isin(kinds, (TURNING, CORRECTED))
        self._is_mirrored = kinds == MIRRORED
        self._scan = Scan(
            group_of=self._group_of,
            member_of=self._member_of,
            group_count=len(by_key),
            groups=self._structs,
            box_count=len(boxes_m),
            boxes_m=np.ascontiguousarray(boxes_m, np.float32),
            row_slots=organized_slots,
        )
        if record is not None:
            self._set_record(record, max(source.slots for source in sources))

    @property
    def counts(self) -> list[PointCounts]:
        """Point counters of each sensor."""
        return [
            self._groups[group].counts[member]
            for group, member in zip(self._group_of, self._member_of, strict=True)
        ]

    @property
    def totals(self) -> PackedTotals | None:
        """Totals of the points of the last call; None if records are not packed."""
        return None if self._packer is None else self._packer.totals

    def decode(
        self, columns: WindowColumns, start_ns: int, first_number: int, out: ScanBuffer
    ) -> int:
        """Write the points of a window to `out`, from its first row; return their number.

        start_ns: start of the scan; first_number: number of the first column in the scan.
        """
        scan = self._scan
        # The structs keep the arrays: another thread may let a ring grow.
        for group in self._groups:
            group.use_rings()
        self._use_outputs(out)
        self._use_columns(columns)
        if self._packer is not None:
            self._packer.start(scan, start_ns, self._timescale)
        scan.start_ns = start_ns
        scan.first_number = first_number
        scan.first_row = 0
        points = int(self._library.mlbatch_decode(scan))
        for group in self._groups:
            group.add_counts()
        return points

    def _set_record(self, record: RecordLayout, slots: int) -> None:
        """Have records packed from scratch arrays; slots: most of a column."""
        is_organized = bool(self._scan.row_slots)
        near = _NEAR_COLUMNS if is_organized else 1
        packer = RecordPacker(record, has_reflectivity="reflectivity" in self._extras)
        packer.describe(self._scan)
        self._packer = packer
        if is_organized:
            self._near = ScanBuffer(near, self._scan.row_slots + _SPARE_SLOTS)
        else:
            self._near = ScanBuffer(slots + _SPARE_POINTS, None)
        self._scan.near_columns = near
        has_reflectivity = not packer.kinds.isdisjoint({"reflectivity", "las"})
        self._set_arrays(
            *(self._near, "range_mm_u4" in packer.kinds),
            has_reflectivity and "reflectivity" in self._extras,
        )

    def _use_columns(self, columns: WindowColumns) -> None:
        """Point the struct to the columns."""
        scan = self._scan
        scan.columns = len(columns)
        for name in ("stamp_ns", "sensor", "ring_index", "encoder"):
            setattr(scan, name, np.ascontiguousarray(getattr(columns, name), np.int64))
        moves = columns.moves
        scan.moves = None if moves is None else np.ascontiguousarray(moves, np.float32)
        if self._turns.any() or self._is_mirrored.any():
            angles = self._angles(columns.sensor, columns.encoder)
            for group in self._groups:
                if group.struct.kind in (TURNING, CORRECTED, MIRRORED):
                    group.struct.cosine, group.struct.sine = angles

    def _angles(self, sensor: I64Array, encoder: I64Array) -> list[F32Array]:
        """Return cosines and sines of all columns; undefined for sensors without rotor words."""
        if self._turns.all():
            return list(rotor_angles(encoder))
        angles = np.zeros((2, len(encoder)), np.float32)
        turning = self._turns[sensor]
        angles[:, turning] = rotor_angles(encoder[turning])
        for number in self._is_mirrored.nonzero()[0]:
            own = sensor == number
            angles[:, own] = self._groups[self._group_of[number]].mirror_angles(
                angles_rad(encoder[own])
            )
        return [angles[0], angles[1]]

    def _use_outputs(self, out: ScanBuffer) -> None:
        """Point the struct to the arrays of a scan; organized rows are written as a whole."""
        if out is self._out:
            return
        self._out = out
        extras = self._extras
        if self.record is not None:
            self._scan.records = address(out.packed) + PACKED_ROOM
            return
        self._set_arrays(out, "range_m" in extras, "reflectivity" in extras)
        wants_column = "column" in extras and not out.is_organized
        self._scan.column = out.column if wants_column else None

    def _set_arrays(self, out: ScanBuffer, wants_range: bool, wants_reflectivity: bool) -> None:
        scan = self._scan
        scan.point = out.point
        scan.label = out.label
        scan.range_m = out.range_m if wants_range else None
        scan.reflectivity = out.reflectivity if wants_reflectivity else None
