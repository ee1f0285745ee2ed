"""Headers of Ouster lidar packets, many packets at once.

Source: docs/sources/ouster.md sections 2, 5 and 10.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.lidar.header_table import FixedNumber, StampedColumns
from mlbatch.lidar.interface import FAULTS
from mlbatch.sensors.crc import crc64
from mlbatch.sensors.ouster.profiles import (
    COLUMN,
    CRC_SIZE,
    FUSA,
    HEADERS,
    LEGACY_COLUMN,
    LEGACY_STATUS,
    LIDAR_PACKET,
    STANDARD,
    HeaderLayout,
    PacketLayout,
)
from mlbatch.types import ColumnHeaders

BAD_HEADER = FAULTS.index("bad_header")
BAD_CRC = FAULTS.index("bad_crc")
# The measurement id follows the stamp in the columns of all layouts.
_ID_OFFSET = 8
_ID_BYTES = 2
_STATUS_OFFSET = 10
# Frame id in the columns of LEGACY packets: first byte, bytes.
_LEGACY_FRAME = (10, 2)
# Firmware before 2.3 leaves the footer empty, 2.3 and 2.4 write DE C0 00 00 EF BE AD DE.
_NO_CRC = (0, 0xDEADBEEF0000C0DE)
# Smallest integer type for a number of so many bytes.
_WORDS = [np.dtype(f"<u{size}") for size in (1, 1, 2, 4, 4, 8, 8, 8)]


def unsigned(packets: U8Array, field_bytes: tuple[int, int]) -> I64Array:
    """(P,) little-endian number at `field_bytes` (first byte, bytes)."""
    first, size = field_bytes
    word = _WORDS[size]
    if first + word.itemsize <= packets.shape[1]:
        words = packets[:, first : first + word.itemsize].view(word)[:, 0].astype(np.int64)
        return words if word.itemsize == size else words & ((1 << 8 * size) - 1)
    value = np.zeros(len(packets), np.int64)
    for byte in reversed(range(size)):
        value <<= 8
        value |= packets[:, first + byte]
    return value


def first_measurement_ids(packets: U8Array, layout: PacketLayout) -> I64Array:
    """(P,) measurement id of the first column."""
    return unsigned(packets, (layout.record_start + _ID_OFFSET, _ID_BYTES))


def column_starts(layout: PacketLayout) -> I64Array:
    """(C,) first bytes of the columns."""
    return layout.record_start + np.arange(layout.columns) * layout.record_size


def _ranges(starts: I64Array, size: int) -> I64Array:
    return np.stack([starts, np.full(len(starts), size)], axis=1)


def column_bytes(packets: U8Array, layout: PacketLayout) -> U8Array:
    """All columns of all packets: (P, C, record size), a view."""
    size = layout.record_size
    end = layout.record_start + layout.columns * size
    return packets[:, layout.record_start : end].reshape(len(packets), layout.columns, size)


class LegacyHeaders(NamedTuple):
    """LEGACY packets: no header, only columns; no serial number, no checksum."""

    layout: PacketLayout
    columns_per_frame: int

    def column_headers(self, packets: U8Array) -> ColumnHeaders:
        """Timestamps, measurement ids and validity of all columns."""
        columns = self._columns(packets)
        mid = columns["measurement_id"].astype(np.int64)
        valid = self._measured(packets) & (mid < self.columns_per_frame)
        return ColumnHeaders(columns["stamp_ns"].astype(np.int64), mid, valid)

    def read_bytes(self) -> I64Array:
        """(k, 2) first byte and number of bytes of all that is read here."""
        ends = column_starts(self.layout) + self.layout.record_size - LEGACY_STATUS.itemsize
        return np.concatenate(
            [
                _ranges(column_starts(self.layout), LEGACY_COLUMN.itemsize),
                _ranges(ends, LEGACY_STATUS.itemsize),
            ]
        )

    def table(self, frames: int, rank: I64Array, packets_per_frame: int) -> StampedColumns | None:
        """Layout for compiled loops; arguments: as in StampedColumns."""
        size = self.layout.record_size
        return StampedColumns(
            columns=self.layout.columns,
            first_column=self.layout.record_start,
            column_bytes=size,
            position_at=_ID_OFFSET,
            status_at=size - LEGACY_STATUS.itemsize,
            positions=self.columns_per_frame,
            frame_field=_LEGACY_FRAME,
            frames=frames,
            frames_in_columns=True,
            rank=rank,
            packets_per_frame=packets_per_frame,
            fixed=(),
        )

    def sent_by_me(self, packets: U8Array) -> BoolArray:
        """(P,) True: packets carry no serial number."""
        return np.ones(len(packets), np.bool_)

    def faults(self, packets: U8Array) -> U8Array:
        """`bad_header` unless the valid columns of a packet are neighbours in one frame."""
        columns = self._columns(packets)
        measured = self._measured(packets)
        frame = columns["frame_id"].astype(np.int64)
        block = columns["measurement_id"].astype(np.int64) // self.layout.columns
        first = measured.argmax(axis=1)[:, None]
        same = (frame == np.take_along_axis(frame, first, 1)) & (
            block == np.take_along_axis(block, first, 1)
        )
        bad = (measured & ~same).any(axis=1)
        bad |= _are_beyond(columns["measurement_id"], measured, self.columns_per_frame)
        return np.where(bad, BAD_HEADER, 0).astype(np.uint8)

    def frame_ids(self, packets: U8Array) -> I64Array:
        """(P,) frame id."""
        return self._columns(packets)["frame_id"][:, 0].astype(np.int64)

    def encoders(self, packets: U8Array) -> I64Array:
        """(P, C) rotor position of each column, in ticks."""
        return self._columns(packets)["encoder"].astype(np.int64)

    def init_ids(self, packets: U8Array) -> I64Array:
        """(P,) 0: packets carry none."""
        return np.zeros(len(packets), np.int64)

    def serials(self, packets: U8Array) -> I64Array:
        """(P,) 0: packets carry none."""
        return np.zeros(len(packets), np.int64)

    def _columns(self, packets: U8Array) -> np.ndarray[tuple[int, ...], np.dtype[np.void]]:
        raw = column_bytes(packets, self.layout)[:, :, : LEGACY_COLUMN.itemsize]
        return np.ascontiguousarray(raw).view(LEGACY_COLUMN)[..., 0]

    def _measured(self, packets: U8Array) -> BoolArray:
        raw = column_bytes(packets, self.layout)[:, :, -LEGACY_STATUS.itemsize :]
        measured: BoolArray = (raw[:, :, 0] & 1) != 0
        return measured


class PacketHeaders(NamedTuple):
    """Packets with a header of the layout `header`, according to the metadata.

    Manuals and firmware disagree on the layout of STANDARD: if the serial number is found at the
    offset of the other layout, the other layout is used.
    """

    layout: PacketLayout
    columns_per_frame: int
    header: str
    serial: int
    check_crc: bool = False

    def column_headers(self, packets: U8Array) -> ColumnHeaders:
        """Timestamps, measurement ids and validity of all columns."""
        columns = self._columns(packets)
        mid = columns["measurement_id"].astype(np.int64)
        valid = ((columns["status"] & 1) != 0) & (mid < self.columns_per_frame)
        return ColumnHeaders(columns["stamp_ns"].astype(np.int64), mid, valid)

    def read_bytes(self) -> I64Array:
        """(k, 2) first byte and number of bytes of all that is read here."""
        if self.check_crc and self.header == STANDARD:
            return np.array([[0, self.layout.packet_size]])
        header = np.array([[0, self.layout.record_start]])
        return np.concatenate([header, _ranges(column_starts(self.layout), COLUMN.itemsize)])

    def table(self, frames: int, rank: I64Array, packets_per_frame: int) -> StampedColumns | None:
        """Layout for compiled loops; arguments: as in StampedColumns."""
        if self.check_crc and self.header == STANDARD:
            return None
        header = HEADERS[self.header]
        fixed = [FixedNumber(*header.packet_type, LIDAR_PACKET)]
        if self.serial:
            fixed.append(FixedNumber(*header.serial, self.serial))
        return StampedColumns(
            columns=self.layout.columns,
            first_column=self.layout.record_start,
            column_bytes=self.layout.record_size,
            position_at=_ID_OFFSET,
            status_at=_STATUS_OFFSET,
            positions=self.columns_per_frame,
            frame_field=header.frame_id,
            frames=frames,
            frames_in_columns=False,
            rank=rank,
            packets_per_frame=packets_per_frame,
            fixed=tuple(fixed),
        )

    def sent_by_me(self, packets: U8Array) -> BoolArray:
        """(P,) whether the serial number is the sensor's; 0 on either side matches all."""
        found = self.serials(packets)
        owned: BoolArray = found == self.serial
        if owned.all():
            return owned
        return np.asarray(owned | (found == 0) | (self.serial == 0))

    def faults(self, packets: U8Array) -> U8Array:
        """(P,) `bad_header` for other packets, `bad_crc` for changed ones if `check_crc`."""
        columns = self._columns(packets)
        measured = (columns["status"] & 1) != 0
        bad = _are_beyond(columns["measurement_id"], measured, self.columns_per_frame)
        bad |= self._read(packets, "packet_type") != LIDAR_PACKET
        verdict: U8Array = bad * np.uint8(BAD_HEADER)
        if self.check_crc and self.header == STANDARD:
            # Only packets with STANDARD headers have a checksum, and not of early firmware.
            stated = np.ascontiguousarray(packets[:, -CRC_SIZE:]).view("<u8")[:, 0]
            wrong = (crc64(packets[:, :-CRC_SIZE]) != stated) & ~np.isin(stated, _no_crc())
            verdict[wrong & ~bad] = BAD_CRC
        return verdict

    def frame_ids(self, packets: U8Array) -> I64Array:
        """(P,) frame id."""
        return self._read(packets, "frame_id")

    def init_ids(self, packets: U8Array) -> I64Array:
        """(P,) initialization id."""
        return self._read(packets, "init_id")

    def serials(self, packets: U8Array) -> I64Array:
        """(P,) serial number."""
        return self._read(packets, "serial")

    def _columns(self, packets: U8Array) -> np.ndarray[tuple[int, ...], np.dtype[np.void]]:
        raw = column_bytes(packets, self.layout)[:, :, : COLUMN.itemsize]
        return np.ascontiguousarray(raw).view(COLUMN)[..., 0]

    def _read(self, packets: U8Array, field: str) -> I64Array:
        value = _header_field(packets, HEADERS[self.header], field)
        if self.serial == 0:
            return value
        serial = (
            value if field == "serial" else _header_field(packets, HEADERS[self.header], "serial")
        )
        here = serial == self.serial
        if here.all():
            return value
        other = FUSA if self.header == STANDARD else STANDARD
        moved = ~here & (_header_field(packets, HEADERS[other], "serial") == self.serial)
        return np.where(moved, _header_field(packets, HEADERS[other], field), value)


def _are_beyond(mid: I64Array, measured: BoolArray, columns_per_frame: int) -> BoolArray:
    """(P,) True for packets of another mode: no valid column (P, C) is within the frame."""
    within = (measured & (mid < columns_per_frame)).any(axis=1)
    result: BoolArray = np.asarray(~within & measured.any(axis=1), np.bool_)
    return result


def _header_field(packets: U8Array, header: HeaderLayout, field: str) -> I64Array:
    field_bytes: tuple[int, int] = getattr(header, field)
    return unsigned(packets, field_bytes)


def _no_crc() -> npt.NDArray[np.uint64]:
    return np.array(_NO_CRC, np.uint64)


Headers = LegacyHeaders | PacketHeaders
