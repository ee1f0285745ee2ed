"""Upper envelope of stamp minus receive time: the clock offset that the fastest packets show.

Queues, bursts and a busy capture host only delay packets. So the offset, stamp minus receive time,
has a sharp upper edge: the difference of the two clocks, less the shortest transport delay. The
envelope is a line through knots; it ignores single damaged stamps above it.

`PacketBins` reduces the packets of a clock to a `BinTable` of bounded size, `fit_envelope` fits the
envelope of a range of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, median
from mlbatch.units import NS_PER_MS, NS_PER_S

# -- bins of packets ------------------------------------------------------------------------------

# When all bins are full, pairs of them are merged. So bins depend on the sequence of packets only,
# not on how packets are grouped into batches.
MAX_BINS = 4096
# Columns of a bin, pairs of (stamp, receive time): TOP: of the packet of the largest offset (the
# fastest one, so it is on the envelope); FIRST: of the first packet; then of two neighbouring
# packets each: RISE, FALL: the largest rise and fall of the offset; BACK: the smallest step of
# stamps (bursts also cause falls, and could hide a clock that was set back).
TOP = slice(2)
FIRST = slice(2, 4)
RISE = slice(4, 8)
FALL = slice(8, 12)
BACK = slice(12, 16)
_WIDTH = 16


class BinTable(NamedTuple):
    """Bins of packets without a break: rows (bins, 16) int64, ns, in order of receive time."""

    rows: I64Array
    per_bin: int  # packets of a bin (the last one may have fewer)
    packets: int
    last: tuple[int, int]  # (stamp, receive time) of the last packet

    @property
    def first(self) -> tuple[int, int]:
        """Stamp and receive time of the first packet."""
        return int(self.rows[0, 2]), int(self.rows[0, 3])


class PacketBins:
    """Collects packets of one clock, without a break, into at most MAX_BINS bins."""

    def __init__(self) -> None:
        self.packets = 0
        # Greatest common divisor of all steps between stamps, ns; 0: no step yet.
        self.quantum_ns = 0
        self._per_bin = 1
        self._rows: I64Array = np.empty((0, _WIDTH), np.int64)
        self._last: tuple[int, int] | None = None

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Add packets (P,) in order of receive time."""
        count = len(stamp_ns)
        if not count:
            return
        if self._last is None:
            self._last = int(stamp_ns[0]), int(host_ns[0])
        before_ns = np.concatenate([[self._last[0]], stamp_ns[:-1]])
        before_host_ns = np.concatenate([[self._last[1]], host_ns[:-1]])
        self.quantum_ns = _common_divisor(self.quantum_ns, stamp_ns - before_ns)
        while -(-(self.packets + count) // self._per_bin) > MAX_BINS:
            self._per_bin *= 2
            self._rows = _merged(self._rows, np.arange(0, len(self._rows), 2))
        number = (self.packets + np.arange(count)) // self._per_bin
        starts = np.concatenate([[0], np.flatnonzero(number[1:] != number[:-1]) + 1])
        rows = _binned(before_ns, before_host_ns, stamp_ns, host_ns, starts)
        if self.packets % self._per_bin:
            # The last bin was not full.
            both = np.concatenate([self._rows[-1:], rows[:1]])
            self._rows[-1:] = _merged(both, np.zeros(1, np.int64))
            rows = rows[1:]
        self._rows = np.concatenate([self._rows, rows])
        self.packets += count
        self._last = int(stamp_ns[-1]), int(host_ns[-1])

    def table(self) -> BinTable | None:
        """The bins so far; None without a packet."""
        if self._last is None:
            return None
        return BinTable(self._rows.copy(), self._per_bin, self.packets, self._last)


def _common_divisor(quantum_ns: int, step_ns: I64Array) -> int:
    """Greatest common divisor of a number and of steps (P,)."""
    if quantum_ns and not (step_ns % quantum_ns).any():
        # The usual case; np.gcd takes ten times as long.
        return quantum_ns
    return int(np.gcd(np.gcd.reduce(step_ns), np.int64(quantum_ns)))


def _binned(
    before_ns: I64Array,
    before_host_ns: I64Array,
    stamp_ns: I64Array,
    host_ns: I64Array,
    starts: I64Array,
) -> I64Array:
    """A row for each run of packets that begins at `starts`.

    All (P,): stamps and receive times of packets, and of the packet before each.
    """
    offset_ns = stamp_ns - host_ns
    rise_ns = offset_ns - (before_ns - before_host_ns)
    packet = (stamp_ns, host_ns)
    step = (before_ns, before_host_ns, stamp_ns, host_ns)
    kept = (
        (_largest(offset_ns, starts), packet),
        (starts, packet),
        (_largest(rise_ns, starts), step),
        (_largest(-rise_ns, starts), step),
        (_largest(before_ns - stamp_ns, starts), step),
    )
    return np.stack([column[index] for index, columns in kept for column in columns], axis=1)


def _merged(rows: I64Array, starts: I64Array) -> I64Array:
    """One row for each run of rows that begins at `starts`."""
    if not len(starts):
        return rows
    offset_ns = rows[:, 0] - rows[:, 1]
    step_ns = rows[:, BACK.start + 2] - rows[:, BACK.start]
    return np.hstack(
        [
            rows[_largest(offset_ns, starts), TOP],
            rows[starts, FIRST],
            rows[_largest(offset_rise(rows[:, RISE]), starts), RISE],
            rows[_largest(-offset_rise(rows[:, FALL]), starts), FALL],
            rows[_largest(-step_ns, starts), BACK],
        ]
    )


def offset_rise(pairs: I64Array) -> I64Array:
    """(n,) rise of the offset between two packets; pairs: (n, 4), as in RISE."""
    rise: I64Array = (pairs[:, 2] - pairs[:, 0]) - (pairs[:, 3] - pairs[:, 1])
    return rise


def _largest(key: I64Array, starts: I64Array) -> I64Array:
    """Index of the largest key (the first of equal ones) in each run that begins at `starts`."""
    best = np.maximum.reduceat(key, starts)
    # np.diff takes several times as long where it appends.
    sizes = np.concatenate([starts[1:], [len(key)]]) - starts
    hits = np.flatnonzero(key == np.repeat(best, sizes))
    run = np.searchsorted(starts, hits, side="right")
    is_first = np.ones(len(run), bool)
    np.not_equal(run[1:], run[:-1], out=is_first[1:])
    return hits[is_first]


# -- range of bins without a step -----------------------------------------------------------------

# A group of neighbouring points is long enough to contain packets that no burst delayed.
GROUP_NS = NS_PER_S // 4
GROUP_PACKETS = 64
MAX_GROUPS = 512
# Points on each side among which a damaged stamp is an outlier, by at least this much.
_REACH = 16
_OUTLIER_NS = NS_PER_MS
_OUTLIER_SCALES = 10


class BinRange(NamedTuple):
    """Rows `begin` to `end` of a table: a clock that runs without a step."""

    table: BinTable
    begin: int
    end: int
    first: tuple[int, int]  # (stamp, receive time) of its first packet, ns
    last: tuple[int, int]  # (stamp, receive time) of its last packet, ns

    @property
    def packets(self) -> int:
        """Number of packets; approximate where the range begins or ends within a bin."""
        missing = 0
        if self.end == len(self.table.rows):
            missing = len(self.table.rows) * self.table.per_bin - self.table.packets
        return max((self.end - self.begin) * self.table.per_bin - missing, 1)

    @property
    def span_ns(self) -> int:
        """Length by receive times."""
        return max(self.last[1] - self.first[1], 0)

    def points(self) -> tuple[I64Array, I64Array, I64Array]:
        """Receive time, offset (ns) and row of the fastest packet of each bin, without outliers."""
        rows = self.table.rows[self.begin : self.end, TOP]
        offset_ns = rows[:, 0] - rows[:, 1]
        kept = np.flatnonzero(~_outliers(offset_ns))
        return rows[kept, 1], offset_ns[kept], self.begin + kept


def _outliers(offset_ns: I64Array) -> BoolArray:
    """Mask of points far above all near them on both sides: damaged stamps, not fast packets."""
    count = len(offset_ns)
    outlier = np.zeros(count, bool)
    if count < 2 * 2 + 1:
        return outlier
    low = np.iinfo(np.int64).min // 2
    padded = np.concatenate([np.full(_REACH, low), offset_ns, np.full(_REACH, low)])
    highest = np.lib.stride_tricks.sliding_window_view(padded, _REACH).max(axis=1)
    before = highest[:count]
    after = highest[_REACH + 1 :]
    usual_ns = median(np.abs(np.diff(offset_ns)))
    above_ns = max(_OUTLIER_NS, _OUTLIER_SCALES * usual_ns)
    inner = slice(2, count - 2)
    outlier[inner] = (offset_ns - np.maximum(before, after))[inner] > above_ns
    return outlier


def group_tops(host_ns: I64Array, offset_ns: I64Array, part: BinRange, most: int) -> I64Array:
    """Index of the point of the largest offset in each of at most `most` groups of points."""
    count = len(host_ns)
    groups = min(part.span_ns // GROUP_NS, part.packets // GROUP_PACKETS, most, count)
    size = -(-count // max(groups, 1))
    starts: I64Array = np.arange(0, count, size)
    if len(starts) > 1 and count - starts[-1] < size // 2:
        # A short last group may consist of delayed packets.
        starts = starts[:-1]
    return _largest(offset_ns, starts)


# -- envelope -------------------------------------------------------------------------------------

KNOT_NS = 10 * NS_PER_S
MAX_KNOTS = 512
# No oscillator drifts faster; a steeper line is due to transport delays.
MAX_RATE = 1e-3
# Fewer groups give no rate.
MIN_RATE_GROUPS = 4
_RATE_GROUPS = 128
# Knots, and the points below them, are found alternately; rates differ little, so this converges.
_ROUNDS = 3
# Standard deviation of a normal distribution, from its median absolute deviation.
_MAD_SIGMA = 1.4826
# Standard error of a median, relative to that of a mean.
_MEDIAN_ERROR = 1.25


class Envelope(NamedTuple):
    """The envelope of a range: the offset at knots, straight between them, ns."""

    host_ns: I64Array  # (k,) receive times of the knots, k >= 1
    offset_ns: I64Array  # (k,) offsets at the knots
    rate: float  # overall change of the offset, ns per ns, also beyond the knots
    rate_error: float  # three standard errors of the rate, infinite where there is no rate
    scatter_ns: float  # robust standard deviation of the points
    residual_ns: F64Array  # (n,) absolute distances of the points from the envelope

    def at(self, host_ns: I64Array) -> I64Array:
        """The offset at receive times, ns."""
        base = int(self.host_ns[0])
        first = int(self.offset_ns[0])
        # Only differences become floats: ns since 1970 do not fit into a float64.
        y = _polyline(
            (host_ns - base).astype(np.float64),
            (self.host_ns - base).astype(np.float64),
            (self.offset_ns - first).astype(np.float64),
            self.rate,
        )
        return first + np.rint(y).astype(np.int64)


def fit_envelope(part: BinRange) -> Envelope:
    """Fit the envelope of a range."""
    host_ns, offset_ns, _ = part.points()
    x = (host_ns - host_ns[0]).astype(np.float64)
    y = (offset_ns - offset_ns[0]).astype(np.float64)
    coarse = group_tops(host_ns, offset_ns, part, _RATE_GROUPS)
    rate, error = _fit_rate(x[coarse], y[coarse])
    knots_x, knots_y = _fit_knots(x, y, rate)
    fine = group_tops(host_ns, offset_ns, part, MAX_GROUPS)
    residual = y[fine] - _polyline(x[fine], knots_x, knots_y, rate)
    return Envelope(
        host_ns=int(host_ns[0]) + np.rint(knots_x).astype(np.int64),
        offset_ns=int(offset_ns[0]) + np.rint(knots_y).astype(np.int64),
        rate=rate,
        rate_error=error,
        scatter_ns=_deviation(residual),
        residual_ns=np.abs(residual),
    )


def _fit_rate(x: F64Array, y: F64Array) -> tuple[float, float]:
    """Slope of a line through points and its error (three standard errors).

    Median of the slopes of all pairs of points (Theil 1950, Sen 1968): up to 29 % of the points may
    be anywhere.
    """
    count = len(x)
    if count < MIN_RATE_GROUPS:
        return 0.0, float("inf")
    one, two = np.triu_indices(count, 1)
    run = x[two] - x[one]
    far = run > 0
    rate = median((y[two] - y[one])[far] / run[far]) if far.any() else np.inf
    if abs(rate) > MAX_RATE:
        return 0.0, float("inf")
    sigma = _deviation(y - rate * x)
    spread = float(np.sqrt(((x - x.mean()) ** 2).sum()))
    # The last factor: few points give a poor estimate of their scatter.
    return rate, 3 * _MEDIAN_ERROR * (sigma + 1.0) / spread * (1 + MIN_RATE_GROUPS / count)


def _fit_knots(x: F64Array, y: F64Array, rate: float) -> tuple[F64Array, F64Array]:
    """Knots in the middle of intervals of equal length, through the top of each interval."""
    begin = float(x.min())
    end = float(x.max())
    count = int(np.clip((end - begin) // KNOT_NS, 1, MAX_KNOTS))
    edges = np.linspace(begin, end, count + 1)
    interval = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, count - 1)
    middle = (edges[:-1] + edges[1:]) / 2
    knots_x = middle[:1]
    knots_y = np.zeros(1)
    for _ in range(_ROUNDS):
        residual = y - _polyline(x, knots_x, knots_y, rate)
        top = np.full(count, -np.inf)
        np.maximum.at(top, interval, residual)
        full = np.isfinite(top)
        previous = _polyline(middle, knots_x, knots_y, rate)
        knots_x = middle[full]
        knots_y = (previous + np.where(full, top, 0.0))[full]
    return knots_x, knots_y


def _deviation(values: F64Array) -> float:
    """Robust standard deviation, by the median absolute deviation."""
    return _MAD_SIGMA * median(np.abs(values - median(values)))


def _polyline(x: F64Array, knots_x: F64Array, knots_y: F64Array, rate: float) -> F64Array:
    """The line through knots, with slope `rate` beyond them."""
    beyond = np.minimum(x - knots_x[0], 0.0) + np.maximum(x - knots_x[-1], 0.0)
    line: F64Array = np.interp(x, knots_x, knots_y) + rate * beyond
    return line
