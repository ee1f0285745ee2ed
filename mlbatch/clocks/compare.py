"""Clocks of several sensors against each other: whether their stamps may be merged, or how.

Sensors are compared through the recorder's clock, packet by packet the same for all of them, so
its own errors and steps drop out. What remains is how long packets take at least, which is part of
every uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.clocks.timescale import DELAY, EPOCHS, GPS, HOST, TAI, UTC, in_seconds, whole_ns
from mlbatch.clocks.watch import ClockEstimate, Jump, Segment, steady
from mlbatch.errors import ClockError
from mlbatch.units import NS_PER_MS, NS_PER_S, NS_PER_US

SYNCHRONISED, CORRECTABLE, UNSYNCHRONISED = "synchronised", "correctable", "unsynchronised"
_RANKS = (SYNCHRONISED, CORRECTABLE, UNSYNCHRONISED)
# Stamps are merged as they are only where all that is known keeps them closer than this.
BOUND_NS = 10 * NS_PER_MS
# Clocks that follow one source may differ by this while their servos work.
RATE_SLACK_PPM = 1.0
# Steps of the recorder's clock are seen at the same time and of the same size by all sensors.
_TOGETHER_NS, _SAME_NS, _SAME_SHARE = NS_PER_S, NS_PER_MS, 0.02
_FREE_PPM = 100.0
Named = tuple[str, ClockEstimate]


@dataclass(frozen=True, slots=True)
class Correction:
    """What makes a sensor's stamps comparable with those of `reference`; offset_ns is added.

    epoch: `tai` or `gps` where the clock is known to count that; error_ns: what may remain.
    """

    sensor: str
    reference: str
    offset_ns: int
    epoch: str
    error_ns: int

    def rig_text(self) -> str:
        """The line of the sensor in a rig file."""
        if self.epoch:
            return f"clock: {{epoch: {self.epoch}}}"
        seconds, rest = divmod(abs(self.offset_ns), NS_PER_S)
        sign = "-" if self.offset_ns < 0 else ""
        return f"clock: {{offset_s: {sign}{seconds}{f'.{rest:09d}'.rstrip('0') if rest else ''}}}"


@dataclass(frozen=True, slots=True)
class Pair:
    """Two sensors: how far the clock of `two` was ahead of that of `one`, ns.

    low_ns, high_ns: least and most while both were seen; uncertainty_ns: of both; whole: name of
    the known difference that they keep, or ""; correction: of `two`, where one will do; why: the
    reason of the verdict.
    """

    one: str
    two: str
    low_ns: int
    high_ns: int
    uncertainty_ns: int
    whole: str
    verdict: str
    correction: Correction | None
    why: str

    @property
    def bound_ns(self) -> int:
        """The clocks were never farther apart than this."""
        return max(abs(self.low_ns), abs(self.high_ns)) + self.uncertainty_ns

    def describe(self) -> str:
        """One line for people."""
        middle = (self.low_ns + self.high_ns) // 2
        text = f"{self.one} and {self.two}: {self.verdict}: {self.why}; {self.two} is "
        text += f"{in_seconds(middle)} from {self.one}"
        error_ns = (self.high_ns - self.low_ns) // 2 + self.uncertainty_ns
        text += f" (+-{error_ns / NS_PER_MS:.3f} ms)"
        if self.correction is not None:
            text += f"; for {self.two} write {self.correction.rig_text()}"
        return text


@dataclass(frozen=True, slots=True)
class Comparison:
    """All sensors of a recording; findings: with steps of the recorder's clock named as such.

    bound_ns: no two stamps are farther apart than this (after the corrections), None where
    nothing vouches for it; corrections: those that make all stamps comparable with the reference's.
    """

    verdict: str
    bound_ns: int | None
    reference: str
    estimates: tuple[Named, ...]
    pairs: tuple[Pair, ...]
    corrections: tuple[Correction, ...]

    def apart(self, limit_ns: int) -> tuple[Pair, ...]:
        """Pairs that were farther apart than `limit_ns`, whatever the verdict."""
        return tuple(pair for pair in self.pairs if _least(pair) > limit_ns)

    def describe(self) -> list[str]:
        """Lines for people: the verdict (of two or more sensors), each sensor, each pair."""
        lines = [f"clocks: {self.verdict}{self._bound()}"] if self.pairs else []
        lines += [f"{name}: {finding.describe()}" for name, finding in self.estimates]
        lines += [pair.describe() for pair in self.pairs]
        return lines

    def _bound(self) -> str:
        if self.bound_ns is None:
            return ""
        after = " once corrected" if self.verdict == CORRECTABLE else ""
        return f" within {self.bound_ns / NS_PER_MS:.3f} ms{after}"


def _least(pair: Pair) -> int:
    """How far the clocks of a pair were apart at least at some time, ns."""
    return max(abs(pair.low_ns), abs(pair.high_ns)) - pair.uncertainty_ns


def compare(findings: Sequence[Named], bound_ns: int = BOUND_NS) -> Comparison:
    """Compare the clocks of sensors; bound_ns: how close stamps must be to count as synchronised.

    A single sensor is synchronised with itself, as long as its clock does not jump.
    """
    named = with_host_steps(findings)
    pairs = tuple(
        _pair(one, two, bound_ns) for at, one in enumerate(named) for two in named[at + 1 :]
    )
    reference = _reference(named)
    towards = [
        _pair((name, finding), other, bound_ns)
        for name, finding in named
        if name == reference
        for other in named
        if other[0] != reference
    ]
    verdict = max((pair.verdict for pair in (*pairs, *towards)), key=_RANKS.index, default="")
    if not verdict:
        broken = any(finding.sensor_jumps or finding.unsteady for _, finding in named)
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
        # Two sensors that are each near the reference are twice as far from each other.
        bound = sum(sorted(left)[-2:])
    return Comparison(verdict, bound, reference, named, pairs, corrections)


def _reference(named: Sequence[Named]) -> str:
    """The sensor whose clock the others are corrected to."""
    for domain in EPOCHS:
        for name, finding in named:
            if finding.domain == domain:
                return name
    return named[0][0] if named else ""


def with_host_steps(findings: Sequence[Named]) -> tuple[Named, ...]:
    """Findings whose jumps that all sensors share are steps of the recorder's clock.

    Where stamps are seen to step it is no such step; where arrivals of one sensor alone step, its
    packets took longer.
    """
    if len(findings) < 2:
        return tuple(findings)
    named = []
    for name, finding in findings:
        others = [other for other_name, other in findings if other_name != name]
        jumps = tuple(replace(jump, kind=_kind(jump, others)) for jump in finding.jumps)
        named.append((name, replace(finding, jumps=jumps)))
    return tuple(named)


def _kind(jump: Jump, others: Sequence[ClockEstimate]) -> str:
    shared = [jump]
    for other in others:
        seen = [one for one in other.segments if _covers(one, jump.host_ns)]
        same = [one for one in other.jumps if _is_same(one, jump)]
        if not same and (len(seen) or other.jumps):
            return DELAY if jump.kind == HOST else jump.kind
        shared += same
    if len(shared) == 1:
        return jump.kind
    return HOST if any(one.kind == HOST for one in shared) or _open(shared) else jump.kind


def _open(shared: Sequence[Jump]) -> bool:
    """Whether pauses leave open what stepped: that all sensors did together tells it."""
    return all(not one.side for one in shared)


def _covers(segment: Segment, host_ns: int) -> bool:
    inside_ns = _TOGETHER_NS
    return segment.first_host_ns + inside_ns < host_ns < segment.last_host_ns - inside_ns


def _is_same(one: Jump, two: Jump) -> bool:
    near_ns = _TOGETHER_NS + abs(two.size_ns)
    same_ns = _SAME_NS + _SAME_SHARE * min(abs(two.size_ns), NS_PER_S)
    return abs(one.host_ns - two.host_ns) < near_ns and abs(one.size_ns - two.size_ns) < same_ns


def _pair(one: Named, two: Named, bound_ns: int) -> Pair:
    """Two sensors held against each other."""
    (name, finding), (other_name, other) = one, two
    low_ns, high_ns, gap_ns = _range(steady(finding), steady(other))
    uncertainty_ns = finding.uncertainty_ns + other.uncertainty_ns
    uncertainty_ns += round(gap_ns * _FREE_PPM / 1e6)
    utc_ns = finding.at_host_ns
    half_ns = (high_ns - low_ns) // 2
    error_ns = half_ns + uncertainty_ns
    middle_ns = round((low_ns + high_ns) / 2 / NS_PER_US) * NS_PER_US
    whole = whole_ns(middle_ns, utc_ns, error_ns) if error_ns < NS_PER_S // 4 else None
    text = whole[1] if whole is not None else ""
    pair = Pair(name, other_name, low_ns, high_ns, uncertainty_ns, text, UNSYNCHRONISED, None, "")
    broken = [f"{who} jumps" for who, what in (one, two) if what.sensor_jumps or what.unsteady]
    if broken:
        return replace(pair, why=", ".join(broken))
    if uncertainty_ns > bound_ns:
        sure = "apart, and " if _least(pair) > bound_ns else ""
        return replace(pair, why=f"{sure}too few packets, or too irregular, to tell exactly")
    apart_ppm = _apart_ppm(finding, other)
    if pair.bound_ns <= bound_ns and not apart_ppm:
        return replace(pair, verdict=SYNCHRONISED, why=_within(pair.bound_ns))
    offset_ns = whole[0] if whole is not None else middle_ns
    left_ns = max(abs(low_ns - offset_ns), abs(high_ns - offset_ns)) + uncertainty_ns
    if whole is not None and left_ns > bound_ns:
        offset_ns, left_ns, text = middle_ns, error_ns + NS_PER_US, ""
    if left_ns > bound_ns:
        why = "they run apart" if apart_ppm else "their difference changes"
        return replace(pair, whole=text, why=f"{why} by {in_seconds(high_ns - low_ns)}")
    epoch = _epoch(finding.domain, other.domain) if text else ""
    correction = Correction(other_name, name, -offset_ns, epoch, left_ns)
    why = text or "a constant offset"
    if apart_ppm:
        why += f", running apart by {apart_ppm:.2f} ppm"
    return replace(pair, whole=text, verdict=CORRECTABLE, correction=correction, why=why)


def _within(bound_ns: int) -> str:
    return f"within {bound_ns / NS_PER_MS:.3f} ms"


def _epoch(one: str, two: str) -> str:
    """What a rig says of the second clock, where the first is on UTC."""
    return two if one == UTC and two in (TAI, GPS) else ""


def _apart_ppm(one: ClockEstimate, two: ClockEstimate) -> float:
    """How much faster one clock runs than the other, where that is sure; else 0."""
    if one.drift_ppm is None or two.drift_ppm is None:
        return 0.0
    error = (one.drift_uncertainty_ppm or 0.0) + (two.drift_uncertainty_ppm or 0.0)
    apart = abs(one.drift_ppm - two.drift_ppm)
    return apart if apart > error + RATE_SLACK_PPM else 0.0


def _range(one: Sequence[Segment], two: Sequence[Segment]) -> tuple[int, int, int]:
    """Least and largest difference of two clocks, and the time between them if never both seen."""
    low, high = [], []
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
    first, second = (one[-1], two[0]) if _before(one, two) else (one[0], two[-1])
    begin = min(first.last_host_ns, second.last_host_ns)
    end = max(first.first_host_ns, second.first_host_ns)
    difference = _difference(first, second, begin, end)
    return int(difference.min()), int(difference.max()), end - begin


def _before(one: Sequence[Segment], two: Sequence[Segment]) -> bool:
    return one[-1].last_host_ns < two[0].first_host_ns


def _difference(first: Segment, second: Segment, begin: int, end: int) -> I64Array:
    """How far the second clock is ahead at all knots of both within a time, and at its ends."""
    knots = np.concatenate([first.line.host_ns, second.line.host_ns])
    inside = knots[(knots > begin) & (knots < end)]
    at = np.concatenate([[begin, end], inside])
    return second.line.at(at) - first.line.at(at)


# Clocks that can be merged: CONTRACT.md section 1, "Comparable clocks".

COMPARABLE_NS = NS_PER_S
# As near a difference must lie to one that has a name, such as TAI - UTC; and the time for which
# it is named, since no leap second has been added for years.
WHOLE_WITHIN_NS = 50 * NS_PER_MS
TODAY_NS = 1_700_000_000 * NS_PER_S


def refuse_incomparable(offsets_ns: list[tuple[str, int | None]], number: int) -> None:
    """Compare sensor `number` with all others that have a packet; ClockError beyond 1 s.

    offsets_ns: name of each sensor and its first stamp minus the arrival of its packet.
    """
    name, mine_ns = offsets_ns[number]
    for other, theirs_ns in offsets_ns[:number] + offsets_ns[number + 1 :]:
        if mine_ns is None or theirs_ns is None or abs(mine_ns - theirs_ns) <= COMPARABLE_NS:
            continue
        apart_ns = abs(mine_ns - theirs_ns)
        known = whole_ns(apart_ns, TODAY_NS, WHOLE_WITHIN_NS)
        named = f" ({known[1]})" if known is not None and "second" not in known[1] else ""
        raise ClockError(
            f"clocks of the sensors cannot be compared: stamp minus arrival is "
            f"{theirs_ns / NS_PER_S:+.3f} s for {other} and {mine_ns / NS_PER_S:+.3f} s for "
            f"{name}, {apart_ns / NS_PER_S:.3f} s apart{named}; wanted at most 1 s; use "
            "--align-clocks or --clock host, or give clock.offset_s or clock.epoch in the rig"
        )
