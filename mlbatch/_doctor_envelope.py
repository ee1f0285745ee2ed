"""The upper envelope of stamp minus arrival: what the fastest packets say of a clock.

Queues, bursts and busy recorders only make packets arrive later, so stamp minus arrival has a sharp
upper edge: the difference of the two clocks, less the shortest way. It is followed by a line
through knots, robust to single stamps that lie above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch._doctor_bins import FIRST, TOP, Track
from mlbatch.median import median
from mlbatch.types import BoolArray, F64Array, I64Array
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
class Part:
    """Rows `begin` to `end` of a track: a clock that runs on without a step.

    first, last: (stamp, arrival) of its first and last packet, ns.
    """

    track: Track
    begin: int
    end: int
    first: tuple[int, int]
    last: tuple[int, int]

    @property
    def packets(self) -> int:
        """Packets in it; roughly, where it begins or ends within a bin."""
        whole = self.end == len(self.track.rows)
        over = len(self.track.rows) * self.track.per_bin - self.track.packets if whole else 0
        return max((self.end - self.begin) * self.track.per_bin - over, 1)

    @property
    def span_ns(self) -> int:
        """How long it lasts, by the recorder's clock."""
        return max(self.last[1] - self.first[1], 0)

    def points(self) -> tuple[I64Array, I64Array, I64Array]:
        """Arrival, and stamp minus arrival, of the fastest packet of each bin, ns; and its row."""
        rows = self.track.rows[self.begin : self.end, TOP]
        offset_ns = rows[:, 0] - rows[:, 1]
        kept = np.flatnonzero(~_lonely(offset_ns))
        return rows[kept, 1], offset_ns[kept], self.begin + kept

    def samples(self) -> tuple[I64Array, I64Array]:
        """The same of the first packet of each bin: how packets usually arrive."""
        rows = self.track.rows[self.begin : self.end, FIRST]
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


def groups(host_ns: I64Array, offset_ns: I64Array, part: Part, most: int) -> I64Array:
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


def envelope(part: Part) -> Line:
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
