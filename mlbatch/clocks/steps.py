"""Where a clock steps: between packets, and too small to be seen from one packet to the next.

A step between two packets is a break of the track. A smaller one shows as a level of the envelope
that ends at once and does not come back; its packets are then found in the bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array, I64Array, median
from mlbatch.clocks.envelope import (
    BACK,
    FALL,
    MOST_GROUPS,
    RISE,
    BinRange,
    BinTable,
    Line,
    envelope,
    groups,
)
from mlbatch.clocks.timescale import HOST, SENSOR
from mlbatch.units import NS_PER_MS

# Smaller steps are followed as changes of the rate.
SMALLEST_NS = NS_PER_MS
_SCALES = 8
# Groups on each side that must agree; a fall may also be a late packet, so it needs all of them.
_SIDE, _LEAST_RISE, _LEAST_FALL = 3, 2, 3
# A step happens between neighbouring rows, a fast change of rate takes longer: so many rows on each
# side must have less than this share of it still to come, or already gone.
_ROWS, _SHARE = 3, 0.25
_PAUSE_NS, _PAUSE_PERIODS = 20 * NS_PER_MS, 16


@dataclass(frozen=True, slots=True)
class Step:
    """A step between two parts: stamp and arrival of the packets before and after it, ns.

    size_ns: change of stamp minus arrival; side: `sensor` where the stamps step, `host` where the
    arrivals do, "" where a pause leaves that open.
    """

    before: tuple[int, int]
    after: tuple[int, int]
    size_ns: int
    side: str


@dataclass(frozen=True, slots=True)
class ClockTrack:
    """A clock from its first packet to its last: parts, their envelopes, the steps between them."""

    parts: tuple[BinRange, ...]
    lines: tuple[Line, ...]
    steps: tuple[Step, ...]


def track_of(tracks: Sequence[BinTable]) -> ClockTrack:
    """What a clock did: steps that come to nothing are pauses of the recorder, and left out."""
    parts, lines, steps = list[BinRange](), list[Line](), list[Step]()
    for part in (part for track in tracks for part in _split(track)):
        line = envelope(part)
        if parts:
            step = _step(parts[-1], lines[-1], part, line)
            if abs(step.size_ns) <= SMALLEST_NS:
                parts[-1] = _joined(parts[-1], part)
                lines[-1] = envelope(parts[-1])
                continue
            steps.append(step)
        parts.append(part)
        lines.append(line)
    return ClockTrack(tuple(parts), tuple(lines), tuple(steps))


def _joined(one: BinRange, two: BinRange) -> BinRange:
    """Two parts as one."""
    if one.table is two.table:
        return BinRange(one.table, one.begin, two.end, one.first, two.last)
    rows = np.concatenate(
        [one.table.rows[one.begin : one.end], two.table.rows[two.begin : two.end]]
    )
    packets = one.packets + two.packets
    table = BinTable(rows, max(-(-packets // len(rows)), 1), packets, two.last)
    return BinRange(table, 0, len(rows), one.first, two.last)


def _split(table: BinTable) -> list[BinRange]:
    """A table, cut at the steps of its envelope."""
    whole = BinRange(table, 0, len(table.rows), table.first, table.last)
    host_ns, offset_ns, row = whole.points()
    tops = groups(host_ns, offset_ns, whole, MOST_GROUPS)
    rate = _usual_rate(host_ns[tops], offset_ns[tops])
    level = _level(host_ns[tops], offset_ns[tops] - offset_ns[0], host_ns[0], rate)
    if len(level) < 2 * _LEAST_RISE:
        return [whole]
    usual_ns = median(np.abs(np.diff(level)))
    size = _gaps(level)
    tops_of_rows = table.rows[:, 0] - table.rows[:, 1] - offset_ns[0]
    levels = _level(table.rows[:, 1], tops_of_rows, host_ns[0], rate)
    parts: list[BinRange] = []
    begin, first = 0, whole.first
    for at in np.flatnonzero(np.abs(size) > max(SMALLEST_NS, _SCALES * usual_ns)).tolist():
        near = slice(row[tops[max(at - 2, 0)]], row[tops[min(at + 1, len(tops) - 1)]] + 1)
        cut = _cut(table, near, levels, float(level[at - 1]), float(size[at]))
        if cut is not None and cut.end > begin and cut.start < len(table.rows):
            parts.append(BinRange(table, begin, cut.end, first, cut.before))
            begin, first = cut.start, cut.after
    return [*parts, BinRange(table, begin, len(table.rows), first, whole.last)]


def _usual_rate(host_ns: I64Array, offset_ns: I64Array) -> float:
    """The usual rate from each point to the next; steps do not count."""
    run = np.diff(host_ns)
    rates = np.diff(offset_ns)[run > 0] / run[run > 0]
    return median(rates) if len(rates) else 0.0


def _level(host_ns: I64Array, offset_ns: I64Array, begin_ns: int, rate: float) -> F64Array:
    """Offsets (small numbers) without what a steady rate since `begin_ns` explains."""
    level: F64Array = offset_ns - rate * (host_ns - begin_ns)
    return level


def _gaps(level: F64Array) -> F64Array:
    """(n,) how far the levels from each on lie above (negative: below) all before it; else 0."""
    count = len(level)
    size = np.zeros(count)
    high = np.concatenate([np.full(_SIDE, -np.inf), level, np.full(_SIDE, -np.inf)])
    low = np.concatenate([np.full(_SIDE, np.inf), level, np.full(_SIDE, np.inf)])
    highest = np.lib.stride_tricks.sliding_window_view(high, _SIDE).max(axis=1)
    lowest = np.lib.stride_tricks.sliding_window_view(low, _SIDE).min(axis=1)
    at = np.arange(count)
    up = lowest[at + _SIDE] - highest[at]
    down = lowest[at] - highest[at + _SIDE]
    side = np.minimum(at, count - at)
    rises = (side >= _LEAST_RISE) & (up > 0)
    falls = (side >= _LEAST_FALL) & (down > 0)
    size[rises] = up[rises]
    size[falls] = -down[falls]
    return size


@dataclass(frozen=True, slots=True)
class StepLocation:
    """End of the rows before a step, start of those after it, the packets around it."""

    end: int
    start: int
    before: tuple[int, int]
    after: tuple[int, int]


def _cut(
    table: BinTable, near: slice, level: F64Array, old: float, size: float
) -> StepLocation | None:
    """Where a step lies in the rows `near`; level: of all rows; old: before it; None: no step."""
    over = np.flatnonzero(level[near] > old + size / 2)
    if not len(over):
        return None
    # Delays only lower points: the first row up there holds a rise, and the last one is at or
    # right before a fall.
    at = near.start + int(over[0] if size > 0 else over[-1])
    begin = at if size > 0 else at + 1
    sides = (level[max(begin - _ROWS, 0) : begin], level[begin : begin + _ROWS])
    if not all(len(side) for side in sides):
        return None
    low, high = (float(side.max() - old) / size for side in sides)
    if low > _SHARE or high < 1 - _SHARE:
        return None
    pairs = table.rows[[at], RISE] if size > 0 else _falls(table.rows[at : at + 2])
    heights = (pairs[:, 2] - pairs[:, 0]) - (pairs[:, 3] - pairs[:, 1])
    best = int(np.argmin(np.abs(heights - size)))
    before, after = pairs[best, :2].tolist(), pairs[best, 2:].tolist()
    # Of a fall, the first half of the pairs is of the last row before it, or in that row.
    end = at if size > 0 or best < len(pairs) // 2 else at + 1
    # A row of one packet lies on one side; one of many may hold packets of both.
    return StepLocation(end, end + (table.per_bin > 1), tuple(before), tuple(after))


def _falls(rows: I64Array) -> I64Array:
    """Pairs of packets around falls, of one row after the other."""
    return np.stack([rows[:, FALL], rows[:, BACK]], axis=1).reshape(-1, 4)


def _step(one: BinRange, line: Line, two: BinRange, next_line: Line) -> Step:
    """The step between two parts."""
    before, after = one.last, two.first
    stamps_ns, hosts_ns = after[0] - before[0], after[1] - before[1]
    size_ns = _size(line, next_line, after[1], after[1])
    period_ns = one.span_ns // max(one.packets - 1, 1)
    if min(stamps_ns, hosts_ns) > _PAUSE_NS + _PAUSE_PERIODS * period_ns:
        return Step(before, after, size_ns, "")
    if abs(stamps_ns - hosts_ns - size_ns) > abs(size_ns) / 2:
        # A burst at the same time: arrivals tell nothing.
        by_sensor = abs(stamps_ns - period_ns - size_ns) < abs(stamps_ns - period_ns)
    else:
        by_sensor = abs(stamps_ns - period_ns) >= abs(hosts_ns - period_ns)
    if not by_sensor:
        # The time over which the recorder's clock stepped never was: nothing drifted in it.
        size_ns = _size(line, next_line, before[1], after[1])
    return Step(before, after, size_ns, SENSOR if by_sensor else HOST)


def _size(line: Line, next_line: Line, before_ns: int, after_ns: int) -> int:
    """How far an envelope lies above another, each at its own time of arrival, ns."""
    low = line.at(np.array([before_ns], np.int64))
    high = next_line.at(np.array([after_ns], np.int64))
    return int(high[0]) - int(low[0])
