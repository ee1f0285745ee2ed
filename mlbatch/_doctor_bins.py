"""Packets of a clock that runs on without a break, as at most 4096 bins of equal packet counts.

A bin keeps of its packets: the one whose stamp is farthest ahead of its arrival (it was the fastest
on its way, so it lies on the envelope), the first one, those before which stamp minus arrival rose
and fell most, and the one before which stamps rose least. When all bins are full, pairs of them
merge. So the bins depend on the sequence of packets alone, not on the pieces they came in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.types import I64Array

MOST_BINS = 4096
# Columns of a bin: stamp and arrival of its top and of its first packet; stamp and arrival of the
# packets before and after the largest rise, and the largest fall, of stamp minus arrival, and the
# smallest step of stamps (bursts cause falls, so they may hide a clock that was set back).
TOP, FIRST, RISE, FALL, BACK = slice(2), slice(2, 4), slice(4, 8), slice(8, 12), slice(12, 16)
_WIDTH = 16


@dataclass(frozen=True, slots=True)
class Track:
    """What is known of a stretch of packets: rows (bins, 16), in order of arrival.

    per_bin: packets of a bin, the last one may hold fewer; last: (stamp, arrival) of the last
    packet.
    """

    rows: I64Array
    per_bin: int
    packets: int
    last: tuple[int, int]

    @property
    def first(self) -> tuple[int, int]:
        """Stamp and arrival of the first packet."""
        return int(self.rows[0, 2]), int(self.rows[0, 3])


class Bins:
    """The packets of one stretch of a clock."""

    def __init__(self) -> None:
        self.packets = 0
        # Greatest common divisor of all steps between stamps, ns; 0: they never stepped.
        self.quantum_ns = 0
        self._per_bin = 1
        self._rows: I64Array = np.empty((0, _WIDTH), np.int64)
        self._last: tuple[int, int] | None = None

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Add packets (P,) in order of arrival."""
        count = len(stamp_ns)
        if not count:
            return
        if self._last is None:
            self._last = int(stamp_ns[0]), int(host_ns[0])
        steps = _Steps(
            np.concatenate([[self._last[0]], stamp_ns[:-1]]),
            np.concatenate([[self._last[1]], host_ns[:-1]]),
            stamp_ns,
            host_ns,
        )
        self.quantum_ns = _quantum_ns(self.quantum_ns, steps.stamp_ns - steps.before_ns)
        while -(-(self.packets + count) // self._per_bin) > MOST_BINS:
            self._per_bin *= 2
            self._rows = _merged(self._rows, np.arange(0, len(self._rows), 2))
        number = (self.packets + np.arange(count)) // self._per_bin
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        rows = steps.rows(starts)
        if self.packets % self._per_bin:
            # The last bin was not full.
            both = np.concatenate([self._rows[-1:], rows[:1]])
            self._rows[-1:] = _merged(both, np.zeros(1, np.int64))
            rows = rows[1:]
        self._rows = np.concatenate([self._rows, rows])
        self.packets += count
        self._last = int(stamp_ns[-1]), int(host_ns[-1])

    def track(self) -> Track | None:
        """All that is kept; None without a packet."""
        if self._last is None:
            return None
        return Track(self._rows.copy(), self._per_bin, self.packets, self._last)


@dataclass(frozen=True, slots=True)
class _Steps:
    """Packets, each with the one before it; all (P,), stamps and arrivals in ns."""

    before_ns: I64Array
    before_host_ns: I64Array
    stamp_ns: I64Array
    host_ns: I64Array

    def rows(self, starts: I64Array) -> I64Array:
        """A bin for each run of packets that begins at `starts`."""
        ahead = self.stamp_ns - self.host_ns
        rise = ahead - (self.before_ns - self.before_host_ns)
        back = self.before_ns - self.stamp_ns
        packet = self.stamp_ns, self.host_ns
        step = self.before_ns, self.before_host_ns, *packet
        kept = (
            (_largest(ahead, starts), packet),
            (starts, packet),
            (_largest(rise, starts), step),
            (_largest(-rise, starts), step),
            (_largest(back, starts), step),
        )
        return np.stack([column[index] for index, columns in kept for column in columns], axis=1)


def _quantum_ns(quantum_ns: int, step_ns: I64Array) -> int:
    """Greatest common divisor of steps (P,) and a number."""
    if quantum_ns and not (step_ns % quantum_ns).any():
        # As nearly always; to look for a smaller one takes ten times as long.
        return quantum_ns
    return int(np.gcd(np.gcd.reduce(step_ns), np.int64(quantum_ns)))


def _merged(rows: I64Array, starts: I64Array) -> I64Array:
    """One row for each run of rows that begins at `starts`."""
    if not len(starts):
        return rows
    rise = _step(rows[:, RISE])
    fall = _step(rows[:, FALL])
    back = rows[:, BACK.start + 2] - rows[:, BACK.start]
    return np.hstack(
        [
            rows[_largest(rows[:, 0] - rows[:, 1], starts), TOP],
            rows[starts, FIRST],
            rows[_largest(rise, starts), RISE],
            rows[_largest(-fall, starts), FALL],
            rows[_largest(-back, starts), BACK],
        ]
    )


def _step(pairs: I64Array) -> I64Array:
    """How far stamp minus arrival went up from the packet before to the one after, ns."""
    return (pairs[:, 2] - pairs[:, 0]) - (pairs[:, 3] - pairs[:, 1])


def _largest(key: I64Array, starts: I64Array) -> I64Array:
    """Index of the largest key (of equal ones the first) in each run that begins at `starts`."""
    best = np.maximum.reduceat(key, starts)
    lengths = np.diff(starts, append=len(key))
    hits = np.flatnonzero(key == np.repeat(best, lengths))
    run = np.searchsorted(starts, hits, side="right")
    return hits[np.diff(run, prepend=0) > 0]
