"""Headers and pixels of Ouster lidar packets.

Source: docs/sources/ouster.md sections 2, 3, 5 and 10. No field of a pixel crosses a 32-bit word;
reflectivity and signal are whole bytes in all profiles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.lidar.headers import StampedColumns
from mlbatch.lidar.interface import BitField, ChannelRun, PixelTable, ReturnLayout
from mlbatch.sensors.ouster.profiles import (
    CRC_SIZE,
    FUSA,
    HEADERS,
    LEGACY_COLUMN,
    LEGACY_STATUS,
    LIDAR_PACKET,
    STANDARD,
    Field,
    HeaderLayout,
    PacketLayout,
)
from mlbatch.sensors.packet_bytes import number
from mlbatch.units import MM_PER_M

# The measurement id follows the stamp in the columns of all layouts.
_ID_OFFSET = 8
_STATUS_OFFSET = 10
# Frame id in the columns of LEGACY packets, 2 bytes.
_LEGACY_FRAME = 10
# Firmware before 2.3 leaves the footer empty, 2.3 and 2.4 write DE C0 00 00 EF BE AD DE.
_NO_CRC = (0, 0xDEADBEEF0000C0DE)
_WORD_BITS = 32
_WORD_BYTES = 4


def column_bytes(packets: U8Array, layout: PacketLayout) -> U8Array:
    """All columns of all packets: (P, C, record size), a view."""
    size = layout.record_size
    end = layout.record_start + layout.columns * size
    return packets[:, layout.record_start : end].reshape(len(packets), layout.columns, size)


class Headers(NamedTuple):
    """Headers of the packets of a unit, as its metadata describe them.

    LEGACY packets have none, only columns: no serial number, no checksum. Manuals and firmware
    disagree on the layout of STANDARD: if the serial number is found at the offset of the other
    layout, the other layout is used.
    """

    layout: PacketLayout
    columns_per_frame: int
    header: str
    serial: int

    def table(self, frames: int, rank: I64Array, packets_per_frame: int) -> StampedColumns:
        """Layout for compiled loops; arguments: as in StampedColumns."""
        legacy = self.layout.legacy
        record_size = self.layout.record_size
        headers = () if legacy else self._headers
        forms = [(one.packet_type, one.serial, one.frame_id) for one in headers]
        return StampedColumns(
            packet_bytes=self.layout.packet_size,
            columns=self.layout.columns,
            first_column=self.layout.record_start,
            column_bytes=record_size,
            position_at=_ID_OFFSET,
            status_at=record_size - LEGACY_STATUS.itemsize if legacy else _STATUS_OFFSET,
            positions=self.columns_per_frame,
            form_count=len(forms),
            forms=np.array(forms, np.int64).reshape(-1, 3, 2),
            packet_type=0 if legacy else LIDAR_PACKET,
            serial=0 if legacy else self.serial,
            frame_at=_LEGACY_FRAME if legacy else -1,
            frames=frames,
            rank_count=len(rank),
            rank=rank,
            packets_per_frame=packets_per_frame,
        )

    def encoders(self, packets: U8Array) -> I64Array:
        """(P, C) rotor position of each column of LEGACY packets, in ticks."""
        raw = column_bytes(packets, self.layout)[:, :, : LEGACY_COLUMN.itemsize]
        return np.ascontiguousarray(raw).view(LEGACY_COLUMN)[..., 0]["encoder"].astype(np.int64)

    def read(self, packets: U8Array, field: str) -> I64Array:
        """(P,) a field of `HeaderLayout`; 0 if packets have no header."""
        if self.layout.legacy:
            return np.zeros(len(packets), np.int64)
        stated, other = self._headers
        value = _header_field(packets, stated, field)
        if self.serial == 0:
            return value
        here = _header_field(packets, stated, "serial") == self.serial
        moved = ~here & (_header_field(packets, other, "serial") == self.serial)
        return np.where(moved, _header_field(packets, other, field), value)

    @property
    def _headers(self) -> tuple[HeaderLayout, HeaderLayout]:
        """The layout that the metadata state, and the other one."""
        other = FUSA if self.header == STANDARD else STANDARD
        return HEADERS[self.header], HEADERS[other]


def _header_field(packets: U8Array, header: HeaderLayout, field: str) -> I64Array:
    first, size = getattr(header, field)
    return number(packets, first, size)


def wrong_crc(packets: U8Array) -> BoolArray:
    """(P,) whether the checksum of packets with a STANDARD header is wrong.

    Packets of early firmware have no checksum.
    """
    from mlbatch.sensors.crc import crc64

    stated = np.ascontiguousarray(packets[:, -CRC_SIZE:]).view("<u8")[:, 0]
    has_crc = ~np.isin(stated, np.array(_NO_CRC, np.uint64))
    return np.asarray(has_crc & (crc64(packets[:, :-CRC_SIZE]) != stated))


def pixel_table(layout: PacketLayout) -> PixelTable:
    """Pixel layout for compiled decoding."""
    fields = layout.profile.fields
    returns = layout.profile.returns
    runs = (ChannelRun(layout.column_header_size, 0, layout.beams),)
    layouts = []
    for suffix in ("", "2")[:returns]:
        reflectivity = fields[f"REFLECTIVITY{suffix}"]
        layouts.append(
            ReturnLayout(
                runs,
                _bits(fields[f"RANGE{suffix}"]),
                _bits(fields.get(f"SIGNAL{suffix}", reflectivity)),
                _bits(reflectivity),
            )
        )
    return PixelTable(
        layout.profile.pixel_size, tuple(layouts), MM_PER_M / (1 << fields["RANGE"].shift)
    )


def _bits(field: Field) -> BitField:
    word, shift = divmod(field.first_bit, _WORD_BITS)
    return BitField(word * _WORD_BYTES, "<u4", shift, (1 << field.width) - 1)
