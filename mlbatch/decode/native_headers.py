"""Headers of packets by compiled loops (`native/headers.c`)."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.lidar.geometry import SPEED_PER_HZ
from mlbatch.lidar.header_table import HeaderTable, PacedBlocks, SingleColumns, StampedColumns
from mlbatch.native.library import Check, PacedLayout, StampedLayout, address, library
from mlbatch.types import ColumnHeaders
from mlbatch.units import NS_PER_S

# As in `headers.c`.
_MOST_GROUPS = 16


class HeaderLoops:
    """Reads the headers of packets that are as usual: good, complete, in order."""

    def __init__(self, table: HeaderTable) -> None:
        self._library = library()
        self._arrays: list[Any] = []
        self._columns = table.columns
        self._single: SingleColumns | None = None
        self._layout: StampedLayout | PacedLayout | None = None
        if isinstance(table, SingleColumns):
            self._single = table
            self._factors = self._kept(table.hash_factors)
        elif isinstance(table, StampedColumns):
            self._layout = self._stamped(table)
        else:
            self._layout = self._paced(table)
        self._all_valid: BoolArray = np.ones((0, table.columns), np.bool_)

    def read(
        self,
        data: U8Array,
        start: I64Array,
        size: int,
        host_ns: I64Array,
        content_key: I64Array | None = None,
    ) -> tuple[ColumnHeaders, I64Array] | None:
        """Return the columns of packets and their sequence numbers; None unless all are as usual.

        data, start: as in `PacketBatch`; size: of a packet; host_ns: (P,) receive times;
        content_key: (P,) hashes, None: not known. Of columns as usual all are valid, and timestamps
        never decrease.
        """
        count = len(start)
        if not count or int(start.min()) < 0 or int(start.max()) + size > len(data):
            return None
        start = np.ascontiguousarray(start)
        is_known = content_key is not None and self._single is not None
        key = content_key if is_known and content_key is not None else np.empty(count, np.int64)
        stamp_ns = np.empty((count, self._columns), np.int64)
        encoder = np.empty((count, self._columns), np.int64)
        arrays = (key, stamp_ns, encoder)
        place = address(data)
        layout = None if self._layout is None else ctypes.addressof(self._layout)
        if self._single is not None:
            encoder.fill(0)
            good = self._library.mlbatch_single(
                place,
                count,
                address(start),
                self._single.packet_bytes,
                self._single.first_word,
                self._single.stamp_at,
                None if is_known else self._factors,
                address(key),
                address(stamp_ns),
            )
        elif isinstance(self._layout, StampedLayout):
            good = self._library.mlbatch_stamped(
                layout, place, count, address(start), *map(address, arrays)
            )
        else:
            host_ns = np.ascontiguousarray(host_ns)
            good = self._library.mlbatch_paced(
                layout, place, count, address(start), address(host_ns), *map(address, arrays)
            )
        if good < count:
            return None
        return ColumnHeaders(stamp_ns, encoder, self._valid(count)), key

    def _valid(self, count: int) -> BoolArray:
        """Return (count, columns) True, an array that later calls share."""
        if count > len(self._all_valid):
            self._all_valid = np.ones((2 * count, self._columns), np.bool_)
            self._all_valid.flags.writeable = False
        return self._all_valid[:count]

    def _kept(self, array: npt.NDArray[Any]) -> int:
        """Return the address of an array that lives as long as this object."""
        array = np.ascontiguousarray(array)
        self._arrays.append(array)
        return address(array)

    def _stamped(self, table: StampedColumns) -> StampedLayout:
        if len(table.rank) * table.columns < table.positions:
            raise ValueError("expected a rank for each position")
        checks = (Check * len(table.fixed))(*(Check(*one) for one in table.fixed))
        self._arrays.append(checks)
        return StampedLayout(
            columns=table.columns,
            first_column=table.first_column,
            column_bytes=table.column_bytes,
            position_at=table.position_at,
            positions=table.positions,
            status_at=table.status_at,
            frame_at=table.frame_field[0],
            frame_bytes=table.frame_field[1],
            frames=table.frames,
            has_frames=table.frames_in_columns,
            rank=self._kept(table.rank),
            packets_per_frame=table.packets_per_frame,
            check_count=len(table.fixed),
            checks=ctypes.addressof(checks),
        )

    def _paced(self, table: PacedBlocks) -> PacedLayout:
        if table.groups > _MOST_GROUPS or len(table.hash_factors) != table.packet_bytes // 8:
            raise ValueError("expected fewer groups of blocks, and a factor for each word")
        modes = None if table.modes is None else self._kept(table.modes.view(np.uint8))
        return PacedLayout(
            columns=table.columns,
            groups=table.groups,
            blocks_per_group=len(table.flags) // table.groups,
            block_count=len(table.flags),
            block_bytes=table.block_bytes,
            flags=self._kept(table.flags),
            circle=table.circle,
            widest=table.widest,
            stamp_at=table.stamp_at,
            period_ns=table.period_ns,
            offset_ns=table.clock_offset_ns,
            mode_at=table.mode_at,
            modes=modes,
            packet_bytes=table.packet_bytes,
            odd=self._kept(table.hash_factors),
            start_ns=self._kept(table.start_ns),
            ahead_ns=self._kept(table.ahead_ns),
            group_ns=table.group_ns,
            known_speed=table.known_speed,
            per_s=NS_PER_S / table.circle,
            steps_per_hz=SPEED_PER_HZ,
            follows_rotor=table.follows_rotor,
        )
