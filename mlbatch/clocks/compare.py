"""Clocks of several sensors relative to each other: may their stamps be merged, and how.

Sensors are compared through the clock of the capture host. It is the same for all of them, so its
error, drift and steps cancel. The shortest transport delays do not; they are part of every
uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.clocks.timescale import (
    DELAY,
    EPOCHS,
    GPS,
    HOST,
    TAI,
    UTC,
    format_difference,
    known_difference,
)
from mlbatch.clocks.watch import ClockEstimate, Jump, Segment, without_host_steps
from mlbatch.errors import ClockError
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

SYNCHRONISED = "synchronised"
CORRECTABLE = "correctable"
UNSYNCHRONISED = "unsynchronised"
_RANKS = (SYNCHRONISED, CORRECTABLE, UNSYNCHRONISED)
# Largest difference of synchronised clocks, uncertainties included.
BOUND_NS = 10 * NS_PER_MS
# Rates of clocks that follow one source may differ by this while their servos settle.
RATE_SLACK_PPM = 1.0
# A step of the capture host's clock occurs in all sensors at the same time, with the same size.
_SAME_TIME_NS = NS_PER_S
_SAME_SIZE_NS = NS_PER_MS
_SAME_SIZE_SHARE = 0.02
# Drift of the capture host's clock between two sensors that were never seen together.
_FREE_PPM = 100.0
Named: TypeAlias = tuple[str, ClockEstimate]


class Correction(NamedTuple):
    """Correction that makes the stamps of a sensor comparable with stamps of `reference`."""

    sensor: str
    reference: str
    offset_ns: int  # to add to the stamps
    epoch: str  # `tai` or `gps` if the clock counts that, else ""
    error_ns: int  # upper limit of the difference that remains

    def rig_text(self) -> str:
        """The line for the sensor in a rig file."""
        if self.epoch:
            return f"clock: {{epoch: {self.epoch}}}"
        seconds, rest = divmod(abs(self.offset_ns), NS_PER_S)
        sign = "-" if self.offset_ns < 0 else ""
        fraction = f".{rest:09d}".rstrip("0") if rest else ""
        return f"clock: {{offset_s: {sign}{seconds}{fraction}}}"


class Pair(NamedTuple):
    """Difference of two clocks: how far that of `two` is ahead of that of `one`, ns."""

    one: str
    two: str
    low_ns: int  # smallest difference while both were seen
    high_ns: int  # largest difference while both were seen
    uncertainty_ns: int  # sum of both
    whole: str  # name of the known difference, or ""
    verdict: str
    correction: Correction | None  # of `two`, if a constant one is enough
    why: str  # reason for the verdict

    @property
    def bound_ns(self) -> int:
        """Upper limit of the difference."""
        return max(abs(self.low_ns), abs(self.high_ns)) + self.uncertainty_ns

    @property
    def least_ns(self) -> int:
        """Lower limit of the largest difference."""
        return max(abs(self.low_ns), abs(self.high_ns)) - self.uncertainty_ns

    def describe(self) -> str:
        """The pair as one line."""
        middle = (self.low_ns + self.high_ns) // 2
        error_ns = (self.high_ns - self.low_ns) // 2 + self.uncertainty_ns
        text = f"{self.one} and {self.two}: {self.verdict}: {self.why}; {self.two} is "
        text += f"{format_difference(middle)} from {self.one}"
        text += f" (+-{error_ns / NS_PER_MS:.3f} ms)"
        if self.correction is not None:
            text += f"; for {self.two} write {self.correction.rig_text()}"
        return text


class Comparison(NamedTuple):
    """Clocks of all sensors of a recording."""

    verdict: str
    # Upper limit of the difference of any two stamps (after the corrections), None if there
    # is none.
    bound_ns: int | None
    reference: str  # the sensor that corrections refer to
    # By sensor, with jumps that all sensors share as steps of the capture host's clock.
    estimates: tuple[Named, ...]
    pairs: tuple[Pair, ...]
    corrections: tuple[Correction, ...]

    def describe(self) -> list[str]:
        """Lines of text: the verdict (of two or more sensors), each sensor, each pair."""
        lines = [f"clocks: {self.verdict}{self._bound()}"] if self.pairs else []
        lines += [f"{name}: {estimate.describe()}" for name, estimate in self.estimates]
        lines += [pair.describe() for pair in self.pairs]
        return lines

    def _bound(self) -> str:
        if self.bound_ns is None:
            return ""
        after = " once corrected" if self.verdict == CORRECTABLE else ""
        return f" within {self.bound_ns / NS_PER_MS:.3f} ms{after}"


def compare(estimates: Sequence[Named], bound_ns: int = BOUND_NS) -> Comparison:
    """Compare the clocks of sensors; bound_ns: largest difference of synchronised clocks.

    A single sensor is synchronised unless its clock jumps.
    """
    named = mark_host_steps(estimates)
    pairs = tuple(
        _pair(one, two, bound_ns) for at, one in enumerate(named) for two in named[at + 1 :]
    )
    reference = _reference(named)
    towards = [
        _pair(one, two, bound_ns)
        for one in named
        if one[0] == reference
        for two in named
        if two[0] != reference
    ]
    verdict = max((pair.verdict for pair in (*pairs, *towards)), key=_RANKS.index, default="")
    if not verdict:
        broken = any(estimate.sensor_jumps or estimate.unsteady for _, estimate in named)
        verdict = UNSYNCHRONISED if broken else SYNCHRONISED
    corrections = tuple(pair.correction for pair in towards if pair.correction is not None)
    if verdict == UNSYNCHRONISED:
        bound = None
    elif verdict == SYNCHRONISED:
        bound = max((pair.bound_ns for pair in pairs), default=0)
    else:
        left = [
            pair.bound_ns if pair.correction is None else pair.correction.error_ns
            for pair in towards
        ]
        # Two sensors may differ from the reference in opposite directions.
        bound = sum(sorted(left)[-2:])
    return Comparison(verdict, bound, reference, named, pairs, corrections)


def _reference(named: Sequence[Named]) -> str:
    """The sensor that the others are corrected to: on UTC, else TAI, else GPS, else the first."""
    for domain in EPOCHS:
        for name, estimate in named:
            if estimate.domain == domain:
                return name
    return named[0][0] if named else ""


# -- steps that all sensors share -----------------------------------------------------------------


def mark_host_steps(estimates: Sequence[Named]) -> tuple[Named, ...]:
    """Estimates with the kinds of jumps corrected by what other sensors show.

    A jump that all sensors share is a step of the capture host's clock, unless the stamps were seen
    to step. A step in the receive times of one sensor alone is a change of its transport delay.
    """
    if len(estimates) < 2:
        return tuple(estimates)
    named = []
    for name, estimate in estimates:
        others = [other for other_name, other in estimates if other_name != name]
        jumps = tuple(jump._replace(kind=_kind(jump, others)) for jump in estimate.jumps)
        named.append((name, estimate._replace(jumps=jumps)))
    return tuple(named)


def _kind(jump: Jump, others: Sequence[ClockEstimate]) -> str:
    shared = [jump]
    for other in others:
        same = [one for one in other.jumps if _is_same(one, jump)]
        observed = any(_covers(one, jump.host_ns) for one in other.segments)
        if not same and (observed or other.jumps):
            return DELAY if jump.kind == HOST else jump.kind
        shared += same
    if len(shared) == 1:
        return jump.kind
    # If pauses hide what stepped in every sensor, it was the clock that all share.
    hidden = all(not one.side for one in shared)
    return HOST if hidden or any(one.kind == HOST for one in shared) else jump.kind


def _covers(segment: Segment, host_ns: int) -> bool:
    return segment.first_host_ns + _SAME_TIME_NS < host_ns < segment.last_host_ns - _SAME_TIME_NS


def _is_same(one: Jump, two: Jump) -> bool:
    near_ns = _SAME_TIME_NS + abs(two.size_ns)
    same_ns = _SAME_SIZE_NS + _SAME_SIZE_SHARE * min(abs(two.size_ns), NS_PER_S)
    return abs(one.host_ns - two.host_ns) < near_ns and abs(one.size_ns - two.size_ns) < same_ns


# -- pairs of sensors -----------------------------------------------------------------------------


def _pair(one: Named, two: Named, bound_ns: int) -> Pair:
    """Compare two sensors."""
    name, estimate = one
    other_name, other = two
    low_ns, high_ns, gap_ns = _range(without_host_steps(estimate), without_host_steps(other))
    uncertainty_ns = estimate.uncertainty_ns + other.uncertainty_ns
    uncertainty_ns += round(gap_ns * _FREE_PPM / 1e6)
    error_ns = (high_ns - low_ns) // 2 + uncertainty_ns
    middle_ns = round((low_ns + high_ns) / 2 / NS_PER_US) * NS_PER_US
    known = None
    if error_ns < NS_PER_S // 4:
        known = known_difference(middle_ns, estimate.at_host_ns, error_ns)
    whole = known[1] if known is not None else ""
    pair = Pair(
        one=name,
        two=other_name,
        low_ns=low_ns,
        high_ns=high_ns,
        uncertainty_ns=uncertainty_ns,
        whole=whole,
        verdict=UNSYNCHRONISED,
        correction=None,
        why="",
    )
    broken = [f"{who} jumps" for who, what in (one, two) if what.sensor_jumps or what.unsteady]
    if broken:
        return pair._replace(why=", ".join(broken))
    if uncertainty_ns > bound_ns:
        sure = "apart, and " if pair.least_ns > bound_ns else ""
        return pair._replace(why=f"{sure}too few packets, or too irregular, for an exact estimate")
    apart_ppm = _apart_ppm(estimate, other)
    if pair.bound_ns <= bound_ns and not apart_ppm:
        return pair._replace(verdict=SYNCHRONISED, why=f"within {pair.bound_ns / NS_PER_MS:.3f} ms")
    offset_ns = known[0] if known is not None else middle_ns
    left_ns = max(abs(low_ns - offset_ns), abs(high_ns - offset_ns)) + uncertainty_ns
    if known is not None and left_ns > bound_ns:
        offset_ns = middle_ns
        left_ns = error_ns + NS_PER_US
        whole = ""
    if left_ns > bound_ns:
        why = "they run apart" if apart_ppm else "their difference changes"
        why += f" by {format_difference(high_ns - low_ns)}"
        return pair._replace(whole=whole, why=why)
    # Of the second clock in a rig, if the first is on UTC.
    is_epoch = whole and estimate.domain == UTC and other.domain in (TAI, GPS)
    epoch = other.domain if is_epoch else ""
    why = whole or "a constant offset"
    if apart_ppm:
        why += f", running apart by {apart_ppm:.2f} ppm"
    return pair._replace(
        whole=whole,
        verdict=CORRECTABLE,
        correction=Correction(other_name, name, -offset_ns, epoch, left_ns),
        why=why,
    )


def _apart_ppm(one: ClockEstimate, two: ClockEstimate) -> float:
    """Difference of the rates of two clocks where it is significant, else 0."""
    if one.drift_ppm is None or two.drift_ppm is None:
        return 0.0
    error = (one.drift_uncertainty_ppm or 0.0) + (two.drift_uncertainty_ppm or 0.0)
    apart = abs(one.drift_ppm - two.drift_ppm)
    return apart if apart > error + RATE_SLACK_PPM else 0.0


def _range(one: Sequence[Segment], two: Sequence[Segment]) -> tuple[int, int, int]:
    """Smallest and largest difference of two clocks; time between them if never seen together."""
    low = []
    high = []
    for first in one:
        for second in two:
            begin = max(first.first_host_ns, second.first_host_ns)
            end = min(first.last_host_ns, second.last_host_ns)
            if begin <= end:
                difference = _difference(first, second, begin, end)
                low.append(int(difference.min()))
                high.append(int(difference.max()))
    if low:
        return min(low), max(high), 0
    if one[-1].last_host_ns < two[0].first_host_ns:
        first = one[-1]
        second = two[0]
    else:
        first = one[0]
        second = two[-1]
    begin = min(first.last_host_ns, second.last_host_ns)
    end = max(first.first_host_ns, second.first_host_ns)
    difference = _difference(first, second, begin, end)
    return int(difference.min()), int(difference.max()), end - begin


def _difference(first: Segment, second: Segment, begin: int, end: int) -> I64Array:
    """Second clock minus the first, at both ends of an interval and at all knots within it."""
    knots = np.concatenate([first.envelope.host_ns, second.envelope.host_ns])
    inside = knots[(knots > begin) & (knots < end)]
    at = np.concatenate([[begin, end], inside])
    return second.envelope.at(at) - first.envelope.at(at)


# -- check before batching ------------------------------------------------------------------------

# Clocks that differ more cannot be merged.
COMPARABLE_NS = NS_PER_S
# Tolerance for the name of a difference of single packets; a time after the last leap second.
_NAMED_WITHIN_NS = 50 * NS_PER_MS
_TODAY_NS = 1_700_000_000 * NS_PER_S


def refuse_incomparable(
    offsets_ns: list[tuple[str, int | None]], number: int, *, has_receive_times: bool = True
) -> None:
    """Compare sensor `number` with all others that have a packet; ClockError beyond 1 s.

    offsets_ns: name of each sensor and its first stamp minus the receive time of its packet;
    has_receive_times: False if packets of a sensor have none, like packets of clouds.
    """
    by_host = "use --align-clocks or --clock host, or " if has_receive_times else ""
    name, mine_ns = offsets_ns[number]
    for other, theirs_ns in offsets_ns[:number] + offsets_ns[number + 1 :]:
        if mine_ns is None or theirs_ns is None or abs(mine_ns - theirs_ns) <= COMPARABLE_NS:
            continue
        apart_ns = abs(mine_ns - theirs_ns)
        known = known_difference(apart_ns, _TODAY_NS, _NAMED_WITHIN_NS)
        named = f" ({known[1]})" if known is not None and "second" not in known[1] else ""
        raise ClockError(
            f"clocks of the sensors cannot be compared: expected at most 1 s between them, found "
            f"{apart_ns / NS_PER_S:.3f} s{named}: stamp minus receive time is "
            f"{theirs_ns / NS_PER_S:+.3f} s for {other} and {mine_ns / NS_PER_S:+.3f} s for "
            f"{name}; {by_host}give clock.offset_s or clock.epoch in the rig"
        )
