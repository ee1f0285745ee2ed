"""Steps of a clock: where the offset of stamps to receive times changes at once.

A step above 1 s between two packets ends a table of bins (`watch`). A smaller one, down to 1 ms,
shows as a level of the envelope that changes at once and does not return; its packets are then
located in the bins. Smaller steps are not reported: the envelope follows them as drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import F64Array, I64Array, median
from mlbatch.clocks.envelope import (
    BACK,
    FALL,
    MAX_GROUPS,
    RISE,
    BinRange,
    BinTable,
    Envelope,
    fit_envelope,
    group_tops,
    offset_rise,
)
from mlbatch.clocks.timescale import HOST, SENSOR
from mlbatch.units import NS_PER_MS

SMALLEST_NS = NS_PER_MS
# A step must exceed the usual difference of neighbouring groups so many times.
_SCALES = 8
# Groups on each side that must agree. A fall may also be delayed packets, so it needs all of them.
_SIDE = 3
_MIN_RISE = 2
_MIN_FALL = 3
# A step is between neighbouring rows, a fast change of rate takes longer. Before a step the highest
# of so many rows may have moved by at most this share of its size, after it by at least the rest.
_ROWS = 3
_SHARE = 0.25
# Longest time between two packets from which the clock that stepped can be determined.
_PAUSE_NS = 20 * NS_PER_MS
_PAUSE_PERIODS = 16


class Step(NamedTuple):
    """A step between two ranges: stamp and receive time of the packets before and after it, ns."""

    before: tuple[int, int]
    after: tuple[int, int]
    size_ns: int  # change of the offset
    side: str  # `sensor` if the stamps step, `host` if the receive times do, "" if a pause hides it


class ClockTrack(NamedTuple):
    """A clock from its first packet to its last: ranges, their envelopes, steps between them."""

    parts: tuple[BinRange, ...]
    envelopes: tuple[Envelope, ...]
    steps: tuple[Step, ...]


def track_of(tables: Sequence[BinTable]) -> ClockTrack:
    """The track of a clock, from the tables between its large steps.

    Ranges whose envelopes differ by less than SMALLEST_NS are joined: there, the capture host
    paused.
    """
    parts: list[BinRange] = []
    envelopes: list[Envelope] = []
    steps: list[Step] = []
    for part in (part for table in tables for part in _split(table)):
        envelope = fit_envelope(part)
        if parts:
            step = _step(parts[-1], envelopes[-1], part, envelope)
            if abs(step.size_ns) <= SMALLEST_NS:
                parts[-1] = _joined(parts[-1], part)
                envelopes[-1] = fit_envelope(parts[-1])
                continue
            steps.append(step)
        parts.append(part)
        envelopes.append(envelope)
    return ClockTrack(tuple(parts), tuple(envelopes), tuple(steps))


def _joined(one: BinRange, two: BinRange) -> BinRange:
    """Two successive ranges as one."""
    if one.table is two.table:
        return BinRange(one.table, one.begin, two.end, one.first, two.last)
    rows = np.concatenate(
        [one.table.rows[one.begin : one.end], two.table.rows[two.begin : two.end]]
    )
    packets = one.packets + two.packets
    table = BinTable(rows, max(-(-packets // len(rows)), 1), packets, two.last)
    return BinRange(table, 0, len(rows), one.first, two.last)


# -- small steps ----------------------------------------------------------------------------------


def _split(table: BinTable) -> list[BinRange]:
    """A table, cut at the steps of its envelope."""
    whole = BinRange(table, 0, len(table.rows), table.first, table.last)
    host_ns, offset_ns, row = whole.points()
    tops = group_tops(host_ns, offset_ns, whole, MAX_GROUPS)
    rate = _usual_rate(host_ns[tops], offset_ns[tops])
    level = _level(host_ns[tops], offset_ns[tops] - offset_ns[0], host_ns[0], rate)
    if len(level) < 2 * _MIN_RISE:
        return [whole]
    usual_ns = median(np.abs(np.diff(level)))
    size = _level_changes(level)
    row_offset_ns = table.rows[:, 0] - table.rows[:, 1] - offset_ns[0]
    row_level = _level(table.rows[:, 1], row_offset_ns, host_ns[0], rate)
    parts: list[BinRange] = []
    begin = 0
    first = whole.first
    for at in np.flatnonzero(np.abs(size) > max(SMALLEST_NS, _SCALES * usual_ns)).tolist():
        near = slice(row[tops[max(at - 2, 0)]], row[tops[min(at + 1, len(tops) - 1)]] + 1)
        found = _locate(table, near, row_level, float(level[at - 1]), float(size[at]))
        if found is not None and found.end > begin and found.start < len(table.rows):
            parts.append(BinRange(table, begin, found.end, first, found.before))
            begin = found.start
            first = found.after
    return [*parts, BinRange(table, begin, len(table.rows), first, whole.last)]


def _usual_rate(host_ns: I64Array, offset_ns: I64Array) -> float:
    """Median rate from each point to the next; steps do not change it."""
    run = np.diff(host_ns)
    rates = np.diff(offset_ns)[run > 0] / run[run > 0]
    return median(rates) if len(rates) else 0.0


def _level(host_ns: I64Array, offset_ns: I64Array, begin_ns: int, rate: float) -> F64Array:
    """Offsets (small numbers) less a steady drift since `begin_ns`."""
    level: F64Array = offset_ns - rate * (host_ns - begin_ns)
    return level


def _level_changes(level: F64Array) -> F64Array:
    """(n,) distance by which the levels from each on are above (below: negative) those before it.

    0 where the _SIDE levels before and the _SIDE levels from there on overlap.
    """
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
    rises = (side >= _MIN_RISE) & (up > 0)
    falls = (side >= _MIN_FALL) & (down > 0)
    size[rises] = up[rises]
    size[falls] = -down[falls]
    return size


class StepLocation(NamedTuple):
    """A step in the rows of a table, and the packets before and after it (stamp, receive time)."""

    end: int  # end of the rows before the step
    start: int  # first row after it
    before: tuple[int, int]
    after: tuple[int, int]


def _locate(
    table: BinTable, near: slice, level: F64Array, old: float, size: float
) -> StepLocation | None:
    """Location of a step of a size in the rows `near`; None if there is no step.

    level: of all rows; old: before the step.
    """
    over = np.flatnonzero(level[near] > old + size / 2)
    if not len(over):
        return None
    # Delays only lower points: the first row above contains a rise, and the last row above is
    # before a fall or contains it.
    at = near.start + int(over[0] if size > 0 else over[-1])
    begin = at if size > 0 else at + 1
    before_level = level[max(begin - _ROWS, 0) : begin]
    after_level = level[begin : begin + _ROWS]
    if not len(before_level) or not len(after_level):
        return None
    risen = float(before_level.max() - old) / size
    reached = float(after_level.max() - old) / size
    if risen > _SHARE or reached < 1 - _SHARE:
        return None
    pairs = table.rows[[at], RISE] if size > 0 else _falls(table.rows[at : at + 2])
    best = int(np.argmin(np.abs(offset_rise(pairs) - size)))
    before = pairs[best, :2].tolist()
    after = pairs[best, 2:].tolist()
    # The first half of the pairs of a fall is of the last row above, the other of the next row.
    end = at if size > 0 or best < len(pairs) // 2 else at + 1
    # A row of one packet is on one side of the step; one of several may contain both sides.
    return StepLocation(end, end + (table.per_bin > 1), tuple(before), tuple(after))


def _falls(rows: I64Array) -> I64Array:
    """Pairs of packets around the falls of rows, row by row."""
    return np.stack([rows[:, FALL], rows[:, BACK]], axis=1).reshape(-1, 4)


# -- size and side of a step ----------------------------------------------------------------------


def _step(one: BinRange, envelope: Envelope, two: BinRange, next_envelope: Envelope) -> Step:
    """The step between two ranges."""
    before = one.last
    after = two.first
    stamps_ns = after[0] - before[0]
    hosts_ns = after[1] - before[1]
    size_ns = _height(envelope, next_envelope, after[1], after[1])
    period_ns = one.span_ns // max(one.packets - 1, 1)
    if min(stamps_ns, hosts_ns) > _PAUSE_NS + _PAUSE_PERIODS * period_ns:
        return Step(before, after, size_ns, "")
    if abs(stamps_ns - hosts_ns - size_ns) > abs(size_ns) / 2:
        # A burst at the same time: receive times show nothing.
        by_sensor = abs(stamps_ns - period_ns - size_ns) < abs(stamps_ns - period_ns)
    else:
        by_sensor = abs(stamps_ns - period_ns) >= abs(hosts_ns - period_ns)
    if not by_sensor:
        # The time that the capture host's clock skipped did not pass: there was no drift in it.
        size_ns = _height(envelope, next_envelope, before[1], after[1])
    return Step(before, after, size_ns, SENSOR if by_sensor else HOST)


def _height(envelope: Envelope, next_envelope: Envelope, before_ns: int, after_ns: int) -> int:
    """Difference of two envelopes, each at its own receive time, ns."""
    low = envelope.at(np.array([before_ns], np.int64))
    high = next_envelope.at(np.array([after_ns], np.int64))
    return int(high[0]) - int(low[0])
