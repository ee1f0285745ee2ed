"""Headers of Ouster lidar packets, many packets at once.

Source: docs/sources/ouster.md sections 2, 5 and 10.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.lidar.headers import StampedColumns
from mlbatch.sensors.crc import crc64
from mlbatch.sensors.ouster.profiles import (
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

# The measurement id follows the stamp in the columns of all layouts.
_ID_OFFSET = 8
_STATUS_OFFSET = 10
# Frame id in the columns of LEGACY packets, 2 bytes.
_LEGACY_FRAME = 10
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


def column_bytes(packets: U8Array, layout: PacketLayout) -> U8Array:
    """All columns of all packets: (P, C, record size), a view."""
    size = layout.record_size
    end = layout.record_start + layout.columns * size
    return packets[:, layout.record_start : end].reshape(len(packets), layout.columns, size)


class LegacyHeaders(NamedTuple):
    """LEGACY packets: no header, only columns; no serial number, no checksum."""

    layout: PacketLayout
    columns_per_frame: int

    def table(self, frames: int, rank: I64Array, packets_per_frame: int) -> StampedColumns:
        """Layout for compiled loops; arguments: as in StampedColumns."""
        size = self.layout.record_size
        return StampedColumns(
            packet_bytes=self.layout.packet_size,
            columns=self.layout.columns,
            first_column=self.layout.record_start,
            column_bytes=size,
            position_at=_ID_OFFSET,
            status_at=size - LEGACY_STATUS.itemsize,
            positions=self.columns_per_frame,
            form_count=0,
            forms=np.zeros((0, 3, 2), np.int64),
            packet_type=0,
            serial=0,
            frame_at=_LEGACY_FRAME,
            frames=frames,
            rank_count=len(rank),
            rank=rank,
            packets_per_frame=packets_per_frame,
        )

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


class PacketHeaders(NamedTuple):
    """Packets with a header of the layout `header`, according to the metadata.

    Manuals and firmware disagree on the layout of STANDARD: if the serial number is found at the
    offset of the other layout, the other layout is used.
    """

    layout: PacketLayout
    columns_per_frame: int
    header: str
    serial: int

    def table(self, frames: int, rank: I64Array, packets_per_frame: int) -> StampedColumns:
        """Layout for compiled loops; arguments: as in StampedColumns."""
        other = FUSA if self.header == STANDARD else STANDARD
        headers = [HEADERS[name] for name in (self.header, other)]
        return StampedColumns(
            packet_bytes=self.layout.packet_size,
            columns=self.layout.columns,
            first_column=self.layout.record_start,
            column_bytes=self.layout.record_size,
            position_at=_ID_OFFSET,
            status_at=_STATUS_OFFSET,
            positions=self.columns_per_frame,
            form_count=len(headers),
            forms=np.array([(one.packet_type, one.serial, one.frame_id) for one in headers]),
            packet_type=LIDAR_PACKET,
            serial=self.serial,
            frame_at=-1,
            frames=frames,
            rank_count=len(rank),
            rank=rank,
            packets_per_frame=packets_per_frame,
        )

    def frame_ids(self, packets: U8Array) -> I64Array:
        """(P,) frame id."""
        return self._read(packets, "frame_id")

    def init_ids(self, packets: U8Array) -> I64Array:
        """(P,) initialization id."""
        return self._read(packets, "init_id")

    def serials(self, packets: U8Array) -> I64Array:
        """(P,) serial number."""
        return self._read(packets, "serial")

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


def _header_field(packets: U8Array, header: HeaderLayout, field: str) -> I64Array:
    field_bytes: tuple[int, int] = getattr(header, field)
    return unsigned(packets, field_bytes)


def wrong_crc(packets: U8Array) -> BoolArray:
    """(P,) whether the checksum of packets with a STANDARD header is wrong.

    Those of early firmware have none.
    """
    stated = np.ascontiguousarray(packets[:, -CRC_SIZE:]).view("<u8")[:, 0]
    has_crc = ~np.isin(stated, np.array(_NO_CRC, np.uint64))
    return np.asarray(has_crc & (crc64(packets[:, :-CRC_SIZE]) != stated))


Headers = LegacyHeaders | PacketHeaders
