"""The upper envelope of stamp minus arrival: what the fastest packets say of a clock.

Queues, bursts and busy recorders only make packets arrive later, so stamp minus arrival has a sharp
upper edge: the difference of the two clocks, less the shortest way. It is followed by a line
through knots, robust to single stamps that lie above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, median
from mlbatch.units import NS_PER_MS, NS_PER_S

# A group of bins is long enough to hold packets that no burst delayed.
GROUP_NS = NS_PER_S // 4
GROUP_PACKETS = 64
MOST_GROUPS = 512
KNOT_NS = 10 * NS_PER_S
MOST_KNOTS = 512
# No oscillator is worse; what looks steeper is the way, not the clock.
STEEPEST = 1e-3
# Fewer groups tell no rate.
RATE_GROUPS = 4
_LINE_POINTS = 128
_REACH = 16
_ALONE_NS = NS_PER_MS
_ALONE_SCALES = 10
# Knots and the points around them are found in turn; rates differ little, so this converges.
_ROUNDS = 3
_MAD_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class BinRange:
    """Rows `begin` to `end` of a track: a clock that runs on without a step.

    first, last: (stamp, arrival) of its first and last packet, ns.
    """

    table: BinTable
    begin: int
    end: int
    first: tuple[int, int]
    last: tuple[int, int]

    @property
    def packets(self) -> int:
        """Packets in it; roughly, where it begins or ends within a bin."""
        whole = self.end == len(self.table.rows)
        over = len(self.table.rows) * self.table.per_bin - self.table.packets if whole else 0
        return max((self.end - self.begin) * self.table.per_bin - over, 1)

    @property
    def span_ns(self) -> int:
        """How long it lasts, by the recorder's clock."""
        return max(self.last[1] - self.first[1], 0)

    def points(self) -> tuple[I64Array, I64Array, I64Array]:
        """Arrival, and stamp minus arrival, of the fastest packet of each bin, ns; and its row."""
        rows = self.table.rows[self.begin : self.end, TOP]
        offset_ns = rows[:, 0] - rows[:, 1]
        kept = np.flatnonzero(~_lonely(offset_ns))
        return rows[kept, 1], offset_ns[kept], self.begin + kept

    def samples(self) -> tuple[I64Array, I64Array]:
        """The same of the first packet of each bin: how packets usually arrive."""
        rows = self.table.rows[self.begin : self.end, FIRST]
        return rows[:, 1], rows[:, 0] - rows[:, 1]


@dataclass(frozen=True, slots=True)
class Line:
    """The envelope of a part: stamp minus arrival at knots, straight between them, ns.

    host_ns, offset_ns: (k,) int64, k >= 1; rate: change of the offset, ns per ns, over all, and
    beyond the knots; rate_error: three of its standard errors, infinite where nothing tells a
    rate; scatter_ns: robust deviation of the points; residual_ns: (n,) theirs, absolute.
    """

    host_ns: I64Array
    offset_ns: I64Array
    rate: float
    rate_error: float
    scatter_ns: float
    residual_ns: F64Array

    def at(self, host_ns: I64Array) -> I64Array:
        """The offset at times of arrival; beyond the knots it goes on at the overall rate."""
        base = int(self.host_ns[0])
        x = (host_ns - base).astype(np.float64)
        knots = (self.host_ns - base).astype(np.float64)
        first = int(self.offset_ns[0])
        y = np.interp(x, knots, (self.offset_ns - first).astype(np.float64))
        y += self.rate * (np.minimum(x - knots[0], 0.0) + np.maximum(x - knots[-1], 0.0))
        return first + np.rint(y).astype(np.int64)


def groups(host_ns: I64Array, offset_ns: I64Array, part: BinRange, most: int) -> I64Array:
    """Index of the top point of each group of neighbouring points, in order; see GROUP_NS."""
    count = len(host_ns)
    wanted = min(part.span_ns // GROUP_NS, part.packets // GROUP_PACKETS, most, count)
    size = -(-count // max(wanted, 1))
    starts: I64Array = np.arange(0, count, size)
    if len(starts) > 1 and count - starts[-1] < size // 2:
        # A short rest may hold delayed packets alone.
        starts = starts[:-1]
    best = np.maximum.reduceat(offset_ns, starts)
    at = np.flatnonzero(offset_ns == np.repeat(best, np.diff(starts, append=count)))
    return at[np.diff(np.searchsorted(starts, at, side="right"), prepend=0) > 0]


def envelope(part: BinRange) -> Line:
    """The envelope of a part."""
    host_ns, offset_ns, _ = part.points()
    x = (host_ns - host_ns[0]).astype(np.float64)
    y = (offset_ns - offset_ns[0]).astype(np.float64)
    tops = groups(host_ns, offset_ns, part, _LINE_POINTS)
    rate, error = _rate(x[tops], y[tops])
    knots_x, knots_y = _knots(x, y, rate)
    fine = groups(host_ns, offset_ns, part, MOST_GROUPS)
    residual = y[fine] - _polyline(x[fine], knots_x, knots_y, rate)
    scatter_ns = _MAD_SIGMA * median(np.abs(residual - median(residual)))
    return Line(
        int(host_ns[0]) + np.rint(knots_x).astype(np.int64),
        int(offset_ns[0]) + np.rint(knots_y).astype(np.int64),
        rate,
        error,
        scatter_ns,
        np.abs(residual),
    )


def _lonely(offset_ns: I64Array) -> BoolArray:
    """Which points lie far above all near them on both sides: damaged stamps, not fast packets."""
    count = len(offset_ns)
    lonely = np.zeros(count, bool)
    if count < 2 * 2 + 1:
        return lonely
    low = np.iinfo(np.int64).min // 2
    padded = np.concatenate([np.full(_REACH, low), offset_ns, np.full(_REACH, low)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, _REACH).max(axis=1)
    before, after = windows[:count], windows[_REACH + 1 :]
    usual_ns = median(np.abs(np.diff(offset_ns)))
    above_ns = max(_ALONE_NS, _ALONE_SCALES * usual_ns)
    inner = slice(2, count - 2)
    lonely[inner] = (offset_ns - np.maximum(before, after))[inner] > above_ns
    return lonely


def _rate(x: F64Array, y: F64Array) -> tuple[float, float]:
    """Slope of a line through points, by the median of the slopes of all pairs; and its error.

    Theil and Sen: up to 29 % of the points may lie anywhere.
    """
    count = len(x)
    if count < RATE_GROUPS:
        return 0.0, float("inf")
    one, two = np.triu_indices(count, 1)
    run = x[two] - x[one]
    far = run > 0
    rate = median((y[two] - y[one])[far] / run[far]) if far.any() else np.inf
    if abs(rate) > STEEPEST:
        return 0.0, float("inf")
    residual = y - rate * x
    sigma = _MAD_SIGMA * median(np.abs(residual - median(residual)))
    spread = float(np.sqrt(((x - x.mean()) ** 2).sum()))
    # 1.25: a median is that much less sure than a mean; few points tell their scatter badly.
    return rate, 3 * 1.25 * (sigma + 1.0) / spread * (1 + RATE_GROUPS / count)


def _knots(x: F64Array, y: F64Array, rate: float) -> tuple[F64Array, F64Array]:
    """Knots in the middle of windows of equal length, through the top of each window."""
    begin, end = float(x.min()), float(x.max())
    count = int(np.clip((end - begin) // KNOT_NS, 1, MOST_KNOTS))
    edges = np.linspace(begin, end, count + 1)
    window = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, count - 1)
    middle = (edges[:-1] + edges[1:]) / 2
    knots_x, knots_y = middle[:1], np.zeros(1)
    for _ in range(_ROUNDS):
        residual = y - _polyline(x, knots_x, knots_y, rate)
        top = np.full(count, -np.inf)
        np.maximum.at(top, window, residual)
        full = np.isfinite(top)
        previous = _polyline(middle, knots_x, knots_y, rate)
        knots_x, knots_y = middle[full], (previous + np.where(full, top, 0.0))[full]
    return knots_x, knots_y


def _polyline(x: F64Array, knots_x: F64Array, knots_y: F64Array, rate: float) -> F64Array:
    beyond = np.minimum(x - knots_x[0], 0.0) + np.maximum(x - knots_x[-1], 0.0)
    line: F64Array = np.interp(x, knots_x, knots_y) + rate * beyond
    return line


# Packets of a clock that runs on without a break, as at most 4096 bins of equal packet counts.
#
# A bin keeps of its packets: the one whose stamp is farthest ahead of its arrival (it was the
# fastest on its way, so it lies on the envelope), the first one, those before which stamp minus
# arrival rose and fell most, and the one before which stamps rose least. When all bins are full,
# pairs of them merge. So the bins depend on the sequence of packets alone, not on the pieces
# they came in.

MOST_BINS = 4096
# Columns of a bin: stamp and arrival of its top and of its first packet; stamp and arrival of the
# packets before and after the largest rise, and the largest fall, of stamp minus arrival, and the
# smallest step of stamps (bursts cause falls, so they may hide a clock that was set back).
TOP, FIRST, RISE, FALL, BACK = slice(2), slice(2, 4), slice(4, 8), slice(8, 12), slice(12, 16)
_WIDTH = 16


@dataclass(frozen=True, slots=True)
class BinTable:
    """What is known of a segment of packets: rows (bins, 16), in order of arrival.

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


class PacketBins:
    """The packets of one segment of a clock."""

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

    def table(self) -> BinTable | None:
        """All that is kept; None without a packet."""
        if self._last is None:
            return None
        return BinTable(self._rows.copy(), self._per_bin, self.packets, self._last)


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
