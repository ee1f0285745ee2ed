"""Pixels of gathered Ouster columns (hot path).

Source: docs/sources/ouster.md section 3. No field crosses a 32-bit word, so a column is a row of
words and a range is one word, shifted and masked; reflectivity and signal are whole bytes in all
profiles. Few passes over reused scratch arrays; if a pixel is one word, whole rows are shifted and
masked, header included, since short rows cost more.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import I32Array, U8Array, U32Array
from mlbatch.lidar.pixel_table import BitField, ChannelRun, PixelTable, ReturnLayout
from mlbatch.sensors.ouster.profiles import Field, PacketLayout, Profile
from mlbatch.types import Pixels
from mlbatch.units import MM_PER_M

_WORD_BITS = 32
_WORD_BYTES = 4


class _BitField(NamedTuple):
    """A field as (word >> shift) & mask; None for a step that is not needed."""

    word: int
    shift: np.uint32 | None
    mask: np.uint32 | None


class _ByteField(NamedTuple):
    """A field of whole bytes, read in place."""

    first: int
    dtype: np.dtype[np.unsignedinteger[Any]]


class _Return(NamedTuple):
    """Fields of one return; per_metre: raw range units in a metre."""

    range: _BitField
    per_metre: np.float32
    reflectivity: _ByteField
    signal: _ByteField | None


class PixelReader:
    """Decoder of the columns of one layout; owns its scratch arrays."""

    __slots__ = ("_beams", "_first", "_returns", "_step", "_words")

    def __init__(self, layout: PacketLayout) -> None:
        self._beams = layout.beams
        self._first = layout.column_header_size // _WORD_BYTES
        self._step = layout.profile.pixel_size // _WORD_BYTES
        self._returns = tuple(
            _fields_of(layout.profile, suffix) for suffix in ("", "2")[: layout.profile.returns]
        )
        width = layout.record_size // _WORD_BYTES if self._step == 1 else layout.beams
        self._words: U32Array = np.empty((0, width), np.uint32)

    def read(self, records: U8Array, which: int, out: Pixels) -> None:
        """Decode return `which` of columns (n, record size), C-contiguous, into `out`."""
        words: U32Array = records.view("<u4")
        self._grow(len(records))
        fields = self._returns[which]
        np.copyto(out.range_m, self._take(words, fields.range))
        # Integers below 2**24 are exact in float32, so only the division rounds.
        np.divide(out.range_m, fields.per_metre, out=out.range_m)
        reflectivity = self._whole(records, fields.reflectivity)
        if out.reflectivity is not None:
            np.copyto(out.reflectivity, reflectivity)
        signal = fields.signal
        np.copyto(out.intensity, reflectivity if signal is None else self._whole(records, signal))

    def _take(self, words: U32Array, part: _BitField) -> I32Array:
        """A field of all pixels (n, H), in scratch; signed, which CPUs convert to float faster."""
        taken = self._words[: len(words)]
        end = self._first + self._beams * self._step
        pixels = slice(self._first, end) if self._step == 1 else slice(None)
        source = words if self._step == 1 else words[:, self._first + part.word : end : self._step]
        if part.shift is not None:
            source = np.right_shift(source, part.shift, out=taken)
        if part.mask is not None:
            source = np.bitwise_and(source, part.mask, out=taken)
        return source[:, pixels].view(np.int32)

    def _whole(self, records: U8Array, field: _ByteField) -> npt.NDArray[np.unsignedinteger[Any]]:
        """A field of all pixels (n, H), a view of the records."""
        first = self._first * _WORD_BYTES
        size = self._step * _WORD_BYTES
        pixels = records[:, first : first + self._beams * size]
        pixels = pixels.reshape(len(records), self._beams, size)
        last = field.first + field.dtype.itemsize
        return pixels[:, :, field.first : last].view(field.dtype)[:, :, 0]

    def _grow(self, columns: int) -> None:
        if columns > len(self._words):
            self._words = np.empty((columns, self._words.shape[1]), np.uint32)


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


def _fields_of(profile: Profile, suffix: str) -> _Return:
    fields = profile.fields
    signal = fields.get(f"SIGNAL{suffix}")
    range_field = fields[f"RANGE{suffix}"]
    return _Return(
        _part(range_field),
        np.float32(MM_PER_M / (1 << range_field.shift)),
        _whole(fields[f"REFLECTIVITY{suffix}"]),
        None if signal is None else _whole(signal),
    )


def _whole(field: Field) -> _ByteField:
    return _ByteField(field.first_bit // 8, np.dtype(f"<u{field.width // 8}"))


def _part(field: Field) -> _BitField:
    word, shift = divmod(field.first_bit, _WORD_BITS)
    return _BitField(
        word,
        np.uint32(shift) if shift else None,
        np.uint32((1 << field.width) - 1) if shift + field.width < _WORD_BITS else None,
    )
