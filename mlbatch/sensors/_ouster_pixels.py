"""Pixels of gathered Ouster columns: the hot path.

Source: facts/ouster.md section 3. No field crosses a 32-bit word, so a column is a row of words and
a field is one of them, shifted and masked. Few passes over scratch that is reused; where a pixel
is one word, whole rows are shifted and masked, header included, since short rows cost more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.sensors._ouster_profiles import Field, PacketLayout, Profile
from mlbatch.types import F32Array, I32Array, Pixels, U8Array, U32Array
from mlbatch.units import MM_PER_M

_WORD_BITS = 32
_WORD_BYTES = 4


@dataclass(frozen=True, slots=True)
class _Part:
    """A field as a word of a pixel: (word >> shift) & mask; None where the step is not needed."""

    word: int
    shift: np.uint32 | None
    mask: np.uint32 | None


@dataclass(frozen=True, slots=True)
class _Return:
    """The fields of one return; `per_metre`: units of the raw range in a metre."""

    range: _Part
    per_metre: np.float32
    reflectivity: _Part
    signal: _Part | None


class PixelReader:
    """Decodes columns of one layout; owns its scratch."""

    __slots__ = ("_beams", "_first", "_floats", "_returns", "_step", "_words")

    def __init__(self, layout: PacketLayout) -> None:
        self._beams = layout.beams
        self._first = layout.column_header_size // _WORD_BYTES
        self._step = layout.profile.pixel_size // _WORD_BYTES
        self._returns = tuple(
            _fields_of(layout.profile, suffix) for suffix in ("", "2")[: layout.profile.returns]
        )
        width = layout.record_size // _WORD_BYTES if self._step == 1 else layout.beams
        self._words: U32Array = np.empty((0, width), np.uint32)
        self._floats: F32Array = np.empty((0, layout.beams), np.float32)

    def read(self, records: U8Array, which: int, out: Pixels) -> None:
        """Decode return `which` of columns (n, record size), C-contiguous, into `out`."""
        words: U32Array = records.view("<u4")
        self._grow(len(records))
        fields = self._returns[which]
        floats = self._floats[: len(records)]
        np.copyto(floats, self._take(words, fields.range))
        # Below 2**24, so exact; one division of exact values is correctly rounded.
        np.divide(floats, fields.per_metre, out=out.range_m)
        intensity = self._take(words, fields.reflectivity)
        if out.reflectivity is not None:
            np.copyto(out.reflectivity, intensity, casting="unsafe")
        if fields.signal is not None:
            intensity = self._take(words, fields.signal)
        np.copyto(out.intensity, intensity)

    def _take(self, words: U32Array, part: _Part) -> I32Array:
        """A field of all pixels (n, H), in scratch: signed, as CPUs turn those into floats fast."""
        taken = self._words[: len(words)]
        end = self._first + self._beams * self._step
        pixels = slice(self._first, end) if self._step == 1 else slice(None)
        source = words if self._step == 1 else words[:, self._first + part.word : end : self._step]
        if part.shift is not None:
            source = np.right_shift(source, part.shift, out=taken)
        if part.mask is not None:
            source = np.bitwise_and(source, part.mask, out=taken)
        return source[:, pixels].view(np.int32)

    def _grow(self, columns: int) -> None:
        if columns > len(self._words):
            self._words = np.empty((columns, self._words.shape[1]), np.uint32)
            self._floats = np.empty((columns, self._beams), np.float32)


def _fields_of(profile: Profile, suffix: str) -> _Return:
    fields = profile.fields
    signal = fields.get(f"SIGNAL{suffix}")
    range_field = fields[f"RANGE{suffix}"]
    return _Return(
        _part(range_field),
        np.float32(MM_PER_M / (1 << range_field.shift)),
        _part(fields[f"REFLECTIVITY{suffix}"]),
        None if signal is None else _part(signal),
    )


def _part(field: Field) -> _Part:
    word, shift = divmod(field.first_bit, _WORD_BITS)
    return _Part(
        word,
        np.uint32(shift) if shift else None,
        np.uint32((1 << field.width) - 1) if shift + field.width < _WORD_BITS else None,
    )
