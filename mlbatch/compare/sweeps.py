"""Turns of sensors as their drivers cut them, and ways in which tools join them to sets.

A driver publishes a cloud of each turn of its rotor; other tools join the clouds of several sensors
by their times. The ways here are models of what such tools do, in general words, and kind to them:
packets and clouds take no time to arrive. All times are int ns on the common clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.units import NS_PER_MS

# Lidars turn at 5 Hz and faster: after such a silence the rotor has surely passed zero.
LONGEST_TURN_NS = 250 * NS_PER_MS
# Sensors without a rotor are published in parts of this length.
PART_NS = 100 * NS_PER_MS
# A rotor that falls back by more than this part of a turn has begun a new one: far more than
# angles jitter, less than the narrowest sector that a sensor can be set to.
_LEAST_FALL = 0.01


@dataclass(frozen=True, slots=True)
class Turn:
    """Columns of one sensor that stay together.

    first_ns, last_ns: stamps of its first and last column; ready_ns: when it can be published.
    """

    sensor: int
    first_ns: int
    last_ns: int
    ready_ns: int
    columns: int

    @property
    def middle_ns(self) -> int:
        """Half way between its first and last column."""
        return (self.first_ns + self.last_ns) // 2


# What was joined: a turn, or None, for each sensor.
TurnSet: TypeAlias = tuple[Turn | None, ...]


class TurnCutter:
    """Cuts the columns of one sensor, in order of their stamps, where its rotor passes zero.

    A turn is ready with the first column of the next one. What comes before the first cut is not a
    whole turn, and left out.
    """

    def __init__(self, sensor: int, positions: int | None) -> None:
        """positions: how many the encoder counts in a turn; None: columns hold rotor words."""
        self._sensor = sensor
        self._positions = positions
        self._forward = 0
        self._origin_ns = 0
        self._angle = 0.0
        self._is_whole = False
        self._open: Turn | None = None

    def take(self, stamp_ns: I64Array, encoder: I64Array) -> list[Turn]:
        """The turns that end within these columns (n,)."""
        if not len(stamp_ns):
            return []
        angle = self._turned(encoder)
        if self._open is None:
            first = int(stamp_ns[0])
            self._origin_ns, self._angle = first, float(angle[0])
            self._open = Turn(self._sensor, first, first, first, 0)
        ended = []
        begin, turn = 0, self._open
        for at in self._cuts(stamp_ns, angle, turn.last_ns):
            turn = _extended(turn, stamp_ns[begin:at], int(stamp_ns[at]))
            if self._is_whole:
                ended.append(turn)
            first, begin, self._is_whole = int(stamp_ns[at]), at, True
            turn = Turn(self._sensor, first, first, first, 0)
        self._open = _extended(turn, stamp_ns[begin:], int(stamp_ns[-1]))
        self._angle = float(angle[-1])
        return ended

    def _turned(self, encoder: I64Array) -> F64Array:
        """Rotor positions in turns."""
        if self._positions is not None:
            return encoder / self._positions
        return read_rotor_words(encoder)[0] / (2 * np.pi)

    def _cuts(self, stamp_ns: I64Array, angle: F64Array, last_ns: int) -> list[int]:
        """Which columns begin a new turn."""
        steps = np.diff(angle, prepend=self._angle)
        # Most steps so far went forward, whichever way the rotor turns; 0: there is no rotor.
        forward = self._forward + np.cumsum(np.sign(steps))
        self._forward = int(forward[-1])
        falls = steps * np.sign(forward) < -_LEAST_FALL
        part = (np.concatenate([[last_ns], stamp_ns]) - self._origin_ns) // PART_NS
        cuts = np.where(forward == 0, part[1:] != part[:-1], falls)
        cuts |= np.diff(stamp_ns, prepend=last_ns) > LONGEST_TURN_NS
        found: list[int] = np.flatnonzero(cuts).tolist()
        return found


def _extended(turn: Turn, stamp_ns: I64Array, ready_ns: int) -> Turn:
    last_ns = int(stamp_ns[-1]) if len(stamp_ns) else turn.last_ns
    return Turn(turn.sensor, turn.first_ns, last_ns, ready_ns, turn.columns + len(stamp_ns))


def in_order(turns: Sequence[Turn]) -> list[Turn]:
    """Turns as they are published.

    Of those that end together the first sensor's comes last, so that it meets the others: the
    kindest reading, since chance decides in practice.
    """
    return sorted(turns, key=lambda turn: (turn.ready_ns, -turn.sensor))


class Way(Protocol):
    """How turns are joined; `waiting`: those that later sets might still use."""

    name: str

    def publish(self, turn: Turn) -> Iterator[TurnSet]:
        """Take a turn; yield every set that this completes."""
        ...

    @property
    def waiting(self) -> Sequence[Turn]:
        """What is held at the moment."""
        ...


class Newest:
    """The newest turn of every sensor, at each turn of the first one; begins once all have one."""

    name = "newest turns"

    def __init__(self, sensors: int) -> None:
        self._newest: list[Turn | None] = [None] * sensors

    def publish(self, turn: Turn) -> Iterator[TurnSet]:
        """A set at each turn of the first sensor."""
        self._newest[turn.sensor] = turn
        if turn.sensor == 0 and None not in self._newest:
            yield tuple(self._newest)

    @property
    def waiting(self) -> Sequence[Turn]:
        """The newest turns."""
        return [turn for turn in self._newest if turn is not None]


class Nearest:
    """For each turn of the first sensor those of the others that began nearest, within a tolerance.

    A turn is used once. Where a sensor has none within the tolerance, there is no set.
    """

    name = "nearest turns"

    def __init__(self, sensors: int, tolerance_ns: int) -> None:
        self._queues: list[deque[Turn]] = [deque() for _ in range(sensors)]
        self._tolerance_ns = tolerance_ns

    def publish(self, turn: Turn) -> Iterator[TurnSet]:
        """Sets of all turns of the first sensor whose nearest ones are now known."""
        self._queues[turn.sensor].append(turn)
        first, *others = self._queues
        while first and all(self._is_known(queue, first[0], turn.ready_ns) for queue in others):
            leading = first.popleft()
            for queue in others:
                while queue and queue[0].first_ns < leading.first_ns - self._tolerance_ns:
                    queue.popleft()
            nearest = [self._nearest(queue, leading) for queue in others]
            if None in nearest:
                continue
            for queue, used in zip(others, nearest, strict=True):
                while queue.popleft() is not used:
                    pass
            yield (leading, *nearest)

    @property
    def waiting(self) -> Sequence[Turn]:
        """All that is in the queues."""
        return [turn for queue in self._queues for turn in queue]

    def _is_known(self, queue: deque[Turn], leading: Turn, now_ns: int) -> bool:
        """Whether no turn that is still to come can be nearer."""
        until_ns = leading.first_ns + self._tolerance_ns + LONGEST_TURN_NS
        return now_ns > until_ns or bool(queue and queue[-1].first_ns >= leading.first_ns)

    def _nearest(self, queue: deque[Turn], leading: Turn) -> Turn | None:
        def distance_ns(turn: Turn) -> int:
            return abs(turn.first_ns - leading.first_ns)

        found = min(queue, key=distance_ns, default=None)
        return found if found is not None and distance_ns(found) <= self._tolerance_ns else None


class Collected:
    """Turns as they come, until every sensor has given one, or a timeout after the first of them.

    What a sensor gives beyond its first turn waits for the next set, the newest alone.
    """

    name = "collected turns"

    def __init__(self, sensors: int, timeout_ns: int) -> None:
        self._sensors = sensors
        self._timeout_ns = timeout_ns
        self._open: dict[int, Turn] = {}
        self._next: dict[int, Turn] = {}

    def publish(self, turn: Turn) -> Iterator[TurnSet]:
        """Sets whose time is over, and the one that this turn completes."""
        while self._open and turn.ready_ns > self._opened_ns + self._timeout_ns:
            yield self._close()
        if turn.sensor in self._open:
            self._next[turn.sensor] = turn
            return
        self._open[turn.sensor] = turn
        if len(self._open) == self._sensors:
            yield self._close()

    @property
    def waiting(self) -> Sequence[Turn]:
        """What is collected at the moment."""
        return [*self._open.values(), *self._next.values()]

    @property
    def _opened_ns(self) -> int:
        return min(turn.ready_ns for turn in self._open.values())

    def _close(self) -> TurnSet:
        joined = tuple(self._open.get(sensor) for sensor in range(self._sensors))
        # A sensor that is missing in this set has nothing in the next one, which is never full.
        self._open, self._next = self._next, {}
        return joined
