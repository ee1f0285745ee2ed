"""Pixels of Ouster columns as a table. Source: docs/sources/ouster.md section 3.

No field crosses a 32-bit word; reflectivity and signal are whole bytes in all profiles.
"""

from __future__ import annotations

from mlbatch.lidar.pixel_table import BitField, ChannelRun, PixelTable, ReturnLayout
from mlbatch.sensors.ouster.profiles import Field, PacketLayout
from mlbatch.units import MM_PER_M

_WORD_BITS = 32
_WORD_BYTES = 4


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
