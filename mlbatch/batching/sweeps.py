"""Sweeps of sensors, as drivers cut them, and policies that join sweeps to sets.

A driver publishes one sweep (a cloud) per revolution of the rotor; frame-level fusion joins the
sweeps of several sensors by their times. The policies are models of such tools in their best case:
packets and sweeps arrive without delay. All times are int ns on the common clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.types import WindowColumns
from mlbatch.units import NS_PER_MS

# Lidars rotate at 5 Hz or faster: after a longer silence the rotor has passed zero.
LONGEST_SWEEP_NS = 250 * NS_PER_MS
# Length of the sweeps of sensors without a rotor.
PART_NS = 100 * NS_PER_MS
# Approximate time: half a revolution at 10 Hz.
DEFAULT_TOLERANCE_NS = 50 * NS_PER_MS
# Timeout collate: one revolution at 10 Hz.
DEFAULT_TIMEOUT_NS = 100 * NS_PER_MS
# A rotor position that falls by more than this fraction of a revolution begins a new sweep: more
# than the jitter of angles, less than the narrowest azimuth window of a sensor.
_MIN_FALL = 0.01


class Sweep(NamedTuple):
    """Columns of one sensor that are published together.

    first_ns, last_ns: timestamps of its first and last column; ready_ns: time of publication.
    """

    sensor: int
    first_ns: int
    last_ns: int
    ready_ns: int
    columns: int

    @property
    def middle_ns(self) -> int:
        """Midpoint of its first and last column."""
        return (self.first_ns + self.last_ns) // 2


# A sweep, or None, of each sensor.
SweepSet: TypeAlias = tuple[Sweep | None, ...]


class SweepCutter:
    """Cuts the columns of one sensor, in order of their timestamps, where the rotor passes zero.

    A sweep is ready with the first column of the next one. Columns before the first cut are no
    whole sweep and are dropped.
    """

    def __init__(self, sensor: int, positions: int | None) -> None:
        """positions: encoder ticks per revolution; None: `encoder` contains rotor words."""
        self._sensor = sensor
        self._positions = positions
        self._forward = 0
        self._origin_ns = 0
        self._angle = 0.0
        self._is_whole = False
        self._open: Sweep | None = None

    def push(self, stamp_ns: I64Array, encoder: I64Array) -> list[Sweep]:
        """Add columns (n,); return the sweeps that end within them."""
        if not len(stamp_ns):
            return []
        angle = self._revolutions(encoder)
        if self._open is None:
            first = int(stamp_ns[0])
            self._origin_ns = first
            self._angle = float(angle[0])
            self._open = Sweep(self._sensor, first, first, first, 0)
        ended = []
        begin = 0
        sweep = self._open
        for at in self._cuts(stamp_ns, angle, sweep.last_ns):
            sweep = _extended(sweep, stamp_ns[begin:at], int(stamp_ns[at]))
            if self._is_whole:
                ended.append(sweep)
            begin = at
            first = int(stamp_ns[at])
            self._is_whole = True
            sweep = Sweep(self._sensor, first, first, first, 0)
        self._open = _extended(sweep, stamp_ns[begin:], int(stamp_ns[-1]))
        self._angle = float(angle[-1])
        return ended

    @property
    def open_columns(self) -> int | None:
        """Columns of the sweep that has not ended; None before the first cut."""
        return self._open.columns if self._is_whole and self._open is not None else None

    def _revolutions(self, encoder: I64Array) -> F64Array:
        """Rotor positions in revolutions."""
        if self._positions is not None:
            return encoder / self._positions
        return read_rotor_words(encoder)[0] / (2 * np.pi)

    def _cuts(self, stamp_ns: I64Array, angle: F64Array, last_ns: int) -> list[int]:
        """Indices of the columns that begin a new sweep."""
        steps = np.diff(angle, prepend=self._angle)
        # Sign of most steps so far: the sense of rotation; 0: no rotor.
        forward = self._forward + np.cumsum(np.sign(steps))
        self._forward = int(forward[-1])
        falls = steps * np.sign(forward) < -_MIN_FALL
        part = (np.concatenate([[last_ns], stamp_ns]) - self._origin_ns) // PART_NS
        cuts = np.where(forward == 0, part[1:] != part[:-1], falls)
        cuts |= np.diff(stamp_ns, prepend=last_ns) > LONGEST_SWEEP_NS
        found: list[int] = np.flatnonzero(cuts).tolist()
        return found


def _extended(sweep: Sweep, stamp_ns: I64Array, ready_ns: int) -> Sweep:
    last_ns = int(stamp_ns[-1]) if len(stamp_ns) else sweep.last_ns
    return Sweep(sweep.sensor, sweep.first_ns, last_ns, ready_ns, sweep.columns + len(stamp_ns))


def sweeps_of(columns: WindowColumns, sensors: int, ready_ns: int) -> SweepSet:
    """The columns of each sensor in a window."""
    parts: list[Sweep | None] = []
    for index in range(sensors):
        stamp_ns = columns.stamp_ns[columns.sensor == index]
        part = None
        if len(stamp_ns):
            part = Sweep(index, int(stamp_ns[0]), int(stamp_ns[-1]), ready_ns, len(stamp_ns))
        parts.append(part)
    return tuple(parts)


def publication_order(sweeps: Sequence[Sweep]) -> list[Sweep]:
    """Sweeps in the order of publication.

    Of sweeps that end together the first sensor's is last, so that it meets the others: the best
    case; in practice the order is random.
    """
    return sorted(sweeps, key=lambda sweep: (sweep.ready_ns, -sweep.sensor))


class JoinPolicy(Protocol):
    """How sweeps are joined to sets; ready_ns: when the set that was yielded last was complete."""

    name: str
    ready_ns: int

    def publish(self, sweep: Sweep) -> Iterator[SweepSet]:
        """Add a sweep; yield every set that it completes."""
        ...

    @property
    def waiting(self) -> Sequence[Sweep]:
        """Sweeps that later sets may use."""
        ...


class NewestSweeps:
    """Latest: the newest sweep of every sensor, at each sweep of the first sensor.

    Begins when every sensor has a sweep.
    """

    name = "latest sweeps"

    def __init__(self, sensors: int) -> None:
        self._newest: list[Sweep | None] = [None] * sensors
        self.ready_ns = 0

    def publish(self, sweep: Sweep) -> Iterator[SweepSet]:
        """A set at each sweep of the first sensor."""
        self._newest[sweep.sensor] = sweep
        self.ready_ns = sweep.ready_ns
        if sweep.sensor == 0 and None not in self._newest:
            yield tuple(self._newest)

    @property
    def waiting(self) -> Sequence[Sweep]:
        """The newest sweeps."""
        return [sweep for sweep in self._newest if sweep is not None]


class NearestSweeps:
    """Approximate time: for each sweep of the first sensor, the sweeps that began nearest to it.

    As message_filters in ROS. A sweep is used once. There is no set where a sensor has no sweep
    within the tolerance.
    """

    name = "approximate time"

    def __init__(self, sensors: int, tolerance_ns: int) -> None:
        self._queues: list[deque[Sweep]] = [deque() for _ in range(sensors)]
        self._tolerance_ns = tolerance_ns
        self.ready_ns = 0

    def publish(self, sweep: Sweep) -> Iterator[SweepSet]:
        """Sets of all sweeps of the first sensor whose nearest sweeps are known."""
        self._queues[sweep.sensor].append(sweep)
        self.ready_ns = sweep.ready_ns
        first, *others = self._queues
        while first and all(self._is_known(queue, first[0], sweep.ready_ns) for queue in others):
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
    def waiting(self) -> Sequence[Sweep]:
        """All sweeps in the queues."""
        return [sweep for queue in self._queues for sweep in queue]

    def _is_known(self, queue: deque[Sweep], leading: Sweep, now_ns: int) -> bool:
        """Whether no later sweep can be nearer."""
        until_ns = leading.first_ns + self._tolerance_ns + LONGEST_SWEEP_NS
        return now_ns > until_ns or bool(queue and queue[-1].first_ns >= leading.first_ns)

    def _nearest(self, queue: deque[Sweep], leading: Sweep) -> Sweep | None:
        def distance_ns(sweep: Sweep) -> int:
            return abs(sweep.first_ns - leading.first_ns)

        nearest = min(queue, key=distance_ns, default=None)
        return (
            nearest if nearest is not None and distance_ns(nearest) <= self._tolerance_ns else None
        )


class CollectedSweeps:
    """Timeout collate: sweeps until every sensor has one, or a timeout after the first of them.

    A second sweep of a sensor waits for the next set; only the newest is kept.
    """

    name = "timeout collate"

    def __init__(self, sensors: int, timeout_ns: int) -> None:
        self._sensors = sensors
        self._timeout_ns = timeout_ns
        self._open: dict[int, Sweep] = {}
        self._next: dict[int, Sweep] = {}
        self.ready_ns = 0

    def publish(self, sweep: Sweep) -> Iterator[SweepSet]:
        """Sets whose timeout has passed, and the set that this sweep completes."""
        while self._open and sweep.ready_ns > self._opened_ns + self._timeout_ns:
            self.ready_ns = self._opened_ns + self._timeout_ns
            yield self._close()
        self.ready_ns = sweep.ready_ns
        if sweep.sensor in self._open:
            self._next[sweep.sensor] = sweep
            return
        self._open[sweep.sensor] = sweep
        if len(self._open) == self._sensors:
            yield self._close()

    @property
    def waiting(self) -> Sequence[Sweep]:
        """Sweeps of the open set and of the next one."""
        return [*self._open.values(), *self._next.values()]

    @property
    def _opened_ns(self) -> int:
        return min(sweep.ready_ns for sweep in self._open.values())

    def _close(self) -> SweepSet:
        joined = tuple(self._open.get(sensor) for sensor in range(self._sensors))
        # A sensor without a sweep in this set has none in the next one: that one is incomplete.
        self._open = self._next
        self._next = {}
        return joined
