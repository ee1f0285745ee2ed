"""Layouts of the pixels of a column as data, which the compiled loops read."""

from __future__ import annotations

from typing import NamedTuple


class BitField(NamedTuple):
    """An unsigned integer in a pixel: `(word >> shift) & mask` of the word at byte `first`.

    word: numpy type, "u1", "<u2", ">u2" or "<u4".
    """

    first: int
    word: str
    shift: int = 0
    mask: int = 0xFFFFFFFF


class ChannelRun(NamedTuple):
    """Channels with evenly spaced pixels.

    first_byte: offset of the first pixel in a record; channel: its channel; channels: their number.
    """

    first_byte: int
    channel: int
    channels: int


class ReturnLayout(NamedTuple):
    """The pixels of one return; reflectivity: None if the sensor has none besides intensity."""

    runs: tuple[ChannelRun, ...]
    distance: BitField
    intensity: BitField
    reflectivity: BitField | None = None


class PixelTable(NamedTuple):
    """The pixels of a record, `step` bytes from channel to channel.

    The range in m is `distance * factor / divisor`, each step rounded to float32; 0 (no return) if
    the distance is at most `silent`, and for the channels `dark`.
    """

    step: int
    returns: tuple[ReturnLayout, ...]
    divisor: float
    factor: float = 1.0
    silent: int = 0
    dark: tuple[int, ...] = ()


def readings(
    first_bytes: tuple[tuple[int, ...], ...], channels: int, word: str, mask: int = 0xFFFFFFFF
) -> tuple[ReturnLayout, ...]:
    """Return layouts of pixels with 2 bytes of distance, then 1 byte of intensity.

    first_bytes: by return, the first bytes of runs of equally many channels.
    """
    distance = BitField(0, word, 0, mask)
    intensity = BitField(2, "u1")
    return tuple(
        ReturnLayout(
            tuple(
                ChannelRun(first, number * (channels // len(firsts)), channels // len(firsts))
                for number, first in enumerate(firsts)
            ),
            distance,
            intensity,
        )
        for firsts in first_bytes
    )
