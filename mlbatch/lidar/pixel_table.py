"""Where the readings of a column lie in its record, as a table that compiled loops can follow.

`Lidar.read` says the same in numpy; the engines are compared pixel by pixel in the tests.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BitField:
    """A whole number in a pixel: `(word >> shift) & mask` of the word that begins at byte `first`.

    word: type of numpy, "u1", "<u2", ">u2" or "<u4".
    """

    first: int
    word: str
    shift: int = 0
    mask: int = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class ChannelRun:
    """Channels whose pixels lie evenly; first_byte: of the first of them, in a record."""

    first_byte: int
    channel: int
    channels: int


@dataclass(frozen=True, slots=True)
class ReturnLayout:
    """The pixels of one return; reflectivity: None where the sensor has none beside intensity."""

    runs: tuple[ChannelRun, ...]
    distance: BitField
    intensity: BitField
    reflectivity: BitField | None = None


@dataclass(frozen=True, slots=True)
class PixelTable:
    """The pixels of a record; a pixel of the same channel and return takes `step` bytes.

    The range in m is `distance * factor / divisor`, each step rounded to float32; 0 where the
    distance is not above `silent`, and for channels that are `dark`.
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
    """Returns whose pixels are a distance of two bytes, and a level of one behind it.

    first_bytes: for each return, where its runs of equally many channels begin.
    """
    distance, level = BitField(0, word, 0, mask), BitField(2, "u1")
    return tuple(
        ReturnLayout(
            tuple(
                ChannelRun(first, number * (channels // len(firsts)), channels // len(firsts))
                for number, first in enumerate(firsts)
            ),
            distance,
            level,
        )
        for firsts in first_bytes
    )
