"""A kernel that tells what the columns of a scan are, sensor by sensor; see `outline.py`."""

from __future__ import annotations

from collections.abc import Callable

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._primitives import Pointer, i8_at, moved, piece

_TICK_BITS = 32
_TICKS = (1 << _TICK_BITS) - 1
# What is found of each sensor, and what its last column was.
_COLUMNS, _GAP, _ONCE, _AGAIN, _STAMP, _SECTOR = range(at.OUTLINE_FIGURES)


def build(sectors: int) -> Callable[[Pointer], int]:
    """Takes the frame OUTLINED to OUTLINE_SIZE of `frame.py`; gives 1 where numpy has to tell.

    sectors: of a turn.
    """
    clear, sector_of, count = _clear(sectors), _sector_of(sectors), _count(sectors)

    def kernel(frame: Pointer) -> int:
        clear(frame)
        stamps, sensors = i8_at(frame[at.OUTLINE_STAMP_NS]), i8_at(frame[at.OUTLINE_SENSOR])
        words, positions = i8_at(frame[at.OUTLINE_ENCODER]), i8_at(frame[at.OUTLINE_POSITIONS])
        for column in range(frame[at.OUTLINED]):
            sensor = sensors[column]
            sector = sector_of(words[column], positions[sensor])
            if sector < 0 or sector >= sectors:
                return 1
            own = moved(i8_at(frame[at.OUTLINE_FOUND]), sensor * at.OUTLINE_FIGURES)
            passes = moved(i8_at(frame[at.OUTLINE_PASSES]), sensor * sectors)
            if own[_COLUMNS] == 0:
                passes[sector] += 1
            else:
                passes[sector] += sector != own[_SECTOR]
                own[_GAP] = max(own[_GAP], stamps[column] - own[_STAMP])
            own[_COLUMNS] += 1
            own[_STAMP] = stamps[column]
            own[_SECTOR] = sector
        count(frame)
        return 0

    return kernel


def _clear(sectors: int) -> Callable[[Pointer], None]:
    """Nothing is found yet."""

    @piece
    def clear(frame: Pointer) -> None:
        found, passes = i8_at(frame[at.OUTLINE_FOUND]), i8_at(frame[at.OUTLINE_PASSES])
        for place in range(frame[at.OUTLINE_SENSORS] * at.OUTLINE_FIGURES):
            found[place] = 0
        for place in range(frame[at.OUTLINE_SENSORS] * sectors):
            passes[place] = 0

    return clear


def _sector_of(sectors: int) -> Callable[[int, int], int]:
    """As `geometry.sectors`; positions 0: a rotor word."""

    @piece
    def sector_of(word: int, positions: int) -> int:
        if positions == 0:
            return (word & _TICKS) * sectors >> _TICK_BITS
        return word * sectors // positions

    return sector_of


def _count(sectors: int) -> Callable[[Pointer], None]:
    """Sectors that were entered, and those that were entered again."""

    @piece
    def count(frame: Pointer) -> None:
        found, passes = i8_at(frame[at.OUTLINE_FOUND]), i8_at(frame[at.OUTLINE_PASSES])
        for sensor in range(frame[at.OUTLINE_SENSORS]):
            own, entered = (
                moved(found, sensor * at.OUTLINE_FIGURES),
                moved(passes, sensor * sectors),
            )
            for sector in range(sectors):
                own[_ONCE] += entered[sector] > 0
                own[_AGAIN] += entered[sector] > 1

    return count
