"""The clock doctor: what a sensor's clock counts, how far it is off, how fast it drifts, its jumps.

A `ClockWatch` is fed with the stamps of one sensor's packets and their arrivals, and tells a
`ClockEstimate`; `clock_compare.compare` holds those of several sensors against each other (the page
docs/clocks.md says how it decides, and what it cannot know).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.clocks.envelope import Line, PacketBins
from mlbatch.clocks.steps import ClockTrack, Step, track_of
from mlbatch.clocks.timescale import (
    DELAY,
    EPOCHS,
    HOST,
    IN_WORDS,
    UNKNOWN,
    domain_of,
    in_seconds,
    kind_of_jump,
    whole_ns,
)
from mlbatch.units import NS_PER_MS, NS_PER_S

__all__ = [
    "ClockEstimate",
    "ClockWatch",
    "Jump",
    "Segment",
    "segment_of",
    "steady",
    "whole_ns",
]

# A step between packets that is looked at at once; the same as batching/intake.py.
HARD_NS = NS_PER_S
LIMIT_NS = 2**31 * NS_PER_S
# A clock that steps more often tells no time.
MAX_SEGMENTS = 64
# Packets are looked at so many at a time: one by one they would cost a hundred times as much.
_AT_ONCE = 4096
# What also the fastest packet may have taken from its stamp to the recorder.
SHORTEST_WAY_NS = NS_PER_MS
# What a queue may hold packets back for; recordings as short as that show no fast packet.
BURST_NS = 20 * NS_PER_MS
_PPM = 1e6
Pending: TypeAlias = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Jump:
    """A clock that does not go on as it did.

    host_ns: arrival of the first packet after it; stamp_before_ns, stamp_after_ns: of the packets
    around it; size_ns: how far the sensor's clock moved against the recorder's; kind: forward,
    backward, restart or wrap of the sensor's clock; host: the recorder's clock stepped, the stamps
    went on; delay: so did they, but packets of this sensor alone took longer (less: positive) from
    then on. side: `sensor` or `host` by what stepped between the two packets, "" after a pause.
    """

    host_ns: int
    stamp_before_ns: int
    stamp_after_ns: int
    size_ns: int
    kind: str
    side: str

    def describe(self) -> str:
        """For people."""
        before_s, after_s = self.stamp_before_ns / NS_PER_S, self.stamp_after_ns / NS_PER_S
        if self.kind == HOST:
            size = in_seconds(-self.size_ns)
            return f"the recorder's clock stepped by {size} at {self.host_ns / NS_PER_S:.3f} s"
        if self.kind == DELAY:
            way = "longer" if self.size_ns < 0 else "less long"
            size = in_seconds(abs(self.size_ns)).lstrip("+")
            return f"packets took {size} {way} from {self.host_ns / NS_PER_S:.3f} s on"
        return (
            f"{self.kind} by {in_seconds(self.size_ns)}: from {before_s:.6f} s to {after_s:.6f} s"
        )


@dataclass(frozen=True, slots=True)
class Segment:
    """A clock between two jumps: first and last stamp and arrival, ns; domain; its envelope."""

    first_stamp_ns: int
    last_stamp_ns: int
    first_host_ns: int
    last_host_ns: int
    packets: int
    domain: str
    line: Line


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """What is known of a sensor's clock; see docs/clocks.md.

    domain: utc, tai, gps, top_of_hour, uptime, wrong_year or unknown, of the longest segment;
    offset_ns: stamp minus arrival of the fastest packets, in the middle of it (`at_host_ns`), and
    its uncertainty; drift_ppm: rate of the sensor's clock against the recorder's, None if too
    short to tell; resolution_ns: what all steps of stamps are multiples of (0: no step);
    jitter_p50_ns, jitter_p99_ns: how much later packets arrive than the fastest; damaged: packets
    whose stamp fits neither the one before nor the one after; unsteady: more jumps than are kept.
    """

    packets: int
    damaged: int
    domain: str
    offset_ns: int
    uncertainty_ns: int
    at_host_ns: int
    drift_ppm: float | None
    drift_uncertainty_ppm: float | None
    jumps: tuple[Jump, ...]
    resolution_ns: int
    jitter_p50_ns: int
    jitter_p99_ns: int
    segments: tuple[Segment, ...]
    unsteady: bool
    mode: str = ""

    @property
    def sensor_jumps(self) -> tuple[Jump, ...]:
        """Jumps of the sensor's own clock."""
        return tuple(jump for jump in self.jumps if jump.kind not in (HOST, DELAY))

    def describe(self) -> str:
        """One line for people."""
        text = f"clock: {IN_WORDS[self.domain]}, {in_seconds(self.offset_ns)} to the recorder"
        text += f" (+-{self.uncertainty_ns / NS_PER_MS:.3f} ms)"
        whole = whole_ns(self.offset_ns, self.at_host_ns, HARD_NS // 2)
        if self.domain not in ("uptime", "utc") and whole is not None:
            name = whole[1]
            text += f", about {name}" if "second" not in name else ""
        if self.drift_ppm is not None:
            text += f", drift {self.drift_ppm:+.2f} +-{self.drift_uncertainty_ppm:.2f} ppm"
        for jump in self.jumps:
            text += f"; {jump.describe()}"
        return text + ("; it jumps again and again" if self.unsteady else "")


class ClockWatch:
    """Watches the clock of one sensor; memory does not grow with the recording.

    period_ns: what the sensor's stamps leave out and the recorder's clock gave (an hour for
    Velodyne), 0: nothing; mode: the maker's word for the source of its time, passed on.
    """

    def __init__(self, *, period_ns: int = 0, mode: str = "") -> None:
        self.damaged = 0
        self._period_ns = period_ns
        self._mode = mode
        self._bins: list[PacketBins] = []
        self._last: int | None = None
        self._pending: Pending | None = None
        self._unsteady = False
        self._told: ClockEstimate | None = None
        self._queue: list[tuple[I64Array, I64Array]] = []
        self._queued = 0

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Add packets (P,) in order of arrival: newest stamp of each, and its arrival.

        The arrays are kept for a while: they must not be changed.
        """
        self._told = None
        self._queue.append((stamp_ns, host_ns))
        self._queued += len(stamp_ns)
        if self._queued >= _AT_ONCE:
            self._look()

    def _look(self) -> None:
        """Take in what was added; what is known does not depend on how it was grouped."""
        if not self._queue:
            return
        stamp_ns, host_ns = (np.concatenate(parts) for parts in zip(*self._queue, strict=True))
        self._queue, self._queued = [], 0
        sane = (stamp_ns >= 0) & (stamp_ns < LIMIT_NS) & (host_ns >= 0) & (host_ns < LIMIT_NS)
        if not sane.all():
            self.damaged += int(np.count_nonzero(~sane))
            stamp_ns, host_ns = stamp_ns[sane], host_ns[sane]
        if self._pending is not None:
            stamp_ns = np.concatenate([[self._pending[0]], stamp_ns])
            host_ns = np.concatenate([[self._pending[1]], host_ns])
            self._pending = None
        if not len(stamp_ns):
            return
        offset_ns = stamp_ns - host_ns
        breaks = np.flatnonzero(np.abs(np.diff(offset_ns)) > HARD_NS) + 1
        edges = [0, *breaks.tolist(), len(stamp_ns)]
        for begin, end in pairwise(edges):
            self._run(stamp_ns[begin:end], host_ns[begin:end], is_last=end == len(stamp_ns))

    def _run(self, stamp_ns: I64Array, host_ns: I64Array, *, is_last: bool) -> None:
        """Packets that follow each other without a hard step."""
        first, last = int(stamp_ns[0] - host_ns[0]), int(stamp_ns[-1] - host_ns[-1])
        goes_on = self._last is not None and abs(first - self._last) <= HARD_NS
        if len(stamp_ns) == 1 and not goes_on:
            # One packet proves no step: the next one tells.
            if is_last:
                self._pending = int(stamp_ns[0]), int(host_ns[0])
            else:
                self.damaged += 1
            return
        if not goes_on:
            if len(self._bins) == MAX_SEGMENTS:
                self._unsteady = True
                return
            self._bins.append(PacketBins())
        self._bins[-1].add(stamp_ns, host_ns)
        self._last = last

    def estimate(self) -> ClockEstimate | None:
        """What is known so far; None before the first packet."""
        if self._told is None:
            self._told = self._found()
        return self._told

    def _found(self) -> ClockEstimate | None:
        course = self.track()
        if course is None:
            return None
        longest = max(range(len(course.parts)), key=lambda at: course.parts[at].packets)
        part, line = course.parts[longest], course.lines[longest]
        at_ns = part.first[1] + part.span_ns // 2
        segments = tuple(
            _stretch(course, number, self._period_ns) for number in range(len(course.parts))
        )
        jumps = tuple(_jump(step, self._period_ns) for step in course.steps)
        quantum = 0
        for one in self._bins:
            quantum = int(np.gcd(quantum, one.quantum_ns))
        p50, p99 = _jitter(course)
        drift = _drift(course)
        scatter_ns = round(3 * line.scatter_ns) + quantum * (quantum <= NS_PER_MS)
        burst_ns = BURST_NS * BURST_NS // max(part.span_ns, BURST_NS)
        return ClockEstimate(
            packets=sum(one.packets for one in self._bins) + (not self._bins),
            damaged=self.damaged + (self._pending is not None and bool(self._bins)),
            domain=_domain(segments, jumps, longest),
            offset_ns=int(line.at(np.array([at_ns], np.int64))[0]),
            uncertainty_ns=SHORTEST_WAY_NS + scatter_ns + burst_ns,
            at_host_ns=at_ns,
            drift_ppm=None if drift is None else drift[0] * _PPM,
            drift_uncertainty_ppm=None if drift is None else drift[1] * _PPM,
            jumps=jumps,
            resolution_ns=quantum,
            jitter_p50_ns=p50,
            jitter_p99_ns=p99,
            segments=segments,
            unsteady=self._unsteady,
            mode=self._mode,
        )

    def track(self) -> ClockTrack | None:
        """Parts, envelopes and steps; None before the first packet."""
        self._look()
        tracks = [track for track in (one.table() for one in self._bins) if track is not None]
        if not tracks and self._pending is not None:
            alone = PacketBins()
            alone.add(*(np.array([value], np.int64) for value in self._pending))
            tracks = [track for track in (alone.table(),) if track is not None]
        return track_of(tracks) if tracks else None


def steady(finding: ClockEstimate, kinds: Collection[str] = (HOST,)) -> tuple[Segment, ...]:
    """The segments by a recorder's clock that never stepped; kinds: jumps taken for its steps."""
    moved_ns, segments = 0, [finding.segments[0]]
    for jump, one in zip(finding.jumps, finding.segments[1:], strict=True):
        if jump.kind in kinds:
            moved_ns -= jump.size_ns
        line = replace(
            one.line,
            host_ns=one.line.host_ns - moved_ns,
            offset_ns=one.line.offset_ns + moved_ns,
        )
        first_ns, last_ns = one.first_host_ns - moved_ns, one.last_host_ns - moved_ns
        segments.append(replace(one, first_host_ns=first_ns, last_host_ns=last_ns, line=line))
    return tuple(segments)


def segment_of(
    segments: Sequence[Segment], stamp_ns: I64Array, host_ns: I64Array | None = None
) -> I64Array:
    """Which segment stamps belong to, from 0; where segments share stamps, their arrival tells."""
    if len(segments) == 1:
        return np.zeros(stamp_ns.shape, np.int64)
    away = np.stack(
        [
            _outside(stamp_ns, one.first_stamp_ns, one.last_stamp_ns)
            + (0 if host_ns is None else _outside(host_ns, one.first_host_ns, one.last_host_ns))
            for one in segments
        ]
    )
    nearest: I64Array = away.argmin(axis=0)
    return nearest


def _outside(value: I64Array, low: int, high: int) -> I64Array:
    away: I64Array = np.maximum(low - value, 0) + np.maximum(value - high, 0)
    return away


def _stretch(course: ClockTrack, number: int, period_ns: int) -> Segment:
    part, line = course.parts[number], course.lines[number]
    offset_ns = int(line.offset_ns[len(line.offset_ns) // 2])
    return Segment(
        part.first[0],
        part.last[0],
        part.first[1],
        part.last[1],
        part.packets,
        domain_of(part.first[0], offset_ns, period_ns),
        line,
    )


def _domain(segments: Sequence[Segment], jumps: Sequence[Jump], longest: int) -> str:
    """Of the longest segment; a recorder's clock that was set may tell it before or after only."""
    named = [one.domain for one in segments if one.domain in EPOCHS]
    if segments[longest].domain == UNKNOWN and named and all(one.kind == HOST for one in jumps):
        return named[0]
    return segments[longest].domain


def _jump(step: Step, period_ns: int) -> Jump:
    before, after = step.before[0], step.after[0]
    is_host = step.side == HOST
    kind = HOST if is_host else kind_of_jump(before, after, step.size_ns, period_ns)
    return Jump(step.after[1], before, after, step.size_ns, kind, step.side)


def _jitter(course: ClockTrack) -> tuple[int, int]:
    """Median and 99th percentile of how far packets lie below the envelope, ns."""
    late = []
    for part, line in zip(course.parts, course.lines, strict=True):
        host_ns, offset_ns = part.samples()
        late.append(np.maximum(line.at(host_ns) - offset_ns, 0))
    p50, p99 = np.quantile(np.concatenate(late), [0.5, 0.99], method="inverted_cdf").tolist()
    return int(p50), int(p99)


def _drift(course: ClockTrack) -> tuple[float, float] | None:
    """Rate over all segments, longer ones counting more; and its error."""
    known = [
        (float(part.span_ns) ** 3, line)
        for part, line in zip(course.parts, course.lines, strict=True)
        if np.isfinite(line.rate_error)
    ]
    total = sum(weight for weight, _ in known)
    if not total:
        return None
    rate = sum(weight * line.rate for weight, line in known) / total
    return rate, sum(weight * line.rate_error for weight, line in known) / total
