"""Estimator of one sensor's clock: domain, offset, drift and jumps (docs/clocks.md).

`ClockWatch` takes the stamps and receive times of the packets of a sensor and gives a
`ClockEstimate`. The capture host's clock is the reference, and is taken for UTC.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.clocks.envelope import Envelope, PacketBins
from mlbatch.clocks.steps import ClockTrack, Step, track_of
from mlbatch.clocks.timescale import (
    DELAY,
    DESCRIPTION,
    EPOCHS,
    HOST,
    UNKNOWN,
    UPTIME,
    domain_of,
    format_difference,
    kind_of_jump,
    known_difference,
)
from mlbatch.units import NS_PER_MS, NS_PER_S

# A step between two packets that ends a segment at once; the same as in `batching.intake`.
HARD_NS = NS_PER_S
LIMIT_NS = 2**31 * NS_PER_S
# With more segments the clock is unsteady, and later packets are not used.
MAX_SEGMENTS = 64
# Packets that are evaluated together; one by one would take a hundred times as long.
_BATCH = 16384
# Upper limit of the shortest transport delay.
SHORTEST_DELAY_NS = NS_PER_MS
# Longest delay by a queue; in a recording this short, all packets may be delayed.
BURST_NS = 20 * NS_PER_MS
_PPM = 1e6


class Jump(NamedTuple):
    """A step of a clock."""

    host_ns: int  # receive time of the first packet after it
    stamp_before_ns: int  # stamp of the packet before it
    stamp_after_ns: int  # stamp of the packet after it
    size_ns: int  # change of stamp minus receive time
    # `forward`, `backward`, `restart` or `wrap` of the sensor's clock; `host`: the capture
    # host's clock stepped; `delay`: the transport delay of this sensor alone changed (longer:
    # negative).
    kind: str
    side: str  # `sensor` or `host`, what stepped between the two packets, "" after a pause

    def describe(self) -> str:
        """The jump as text."""
        at_s = self.host_ns / NS_PER_S
        if self.kind == HOST:
            size = format_difference(-self.size_ns)
            return f"the capture host's clock stepped by {size} at {at_s:.3f} s"
        if self.kind == DELAY:
            change = "longer" if self.size_ns < 0 else "shorter"
            size = format_difference(abs(self.size_ns)).lstrip("+")
            return f"the transport delay became {size} {change} at {at_s:.3f} s"
        before_s = self.stamp_before_ns / NS_PER_S
        after_s = self.stamp_after_ns / NS_PER_S
        size = format_difference(self.size_ns)
        return f"{self.kind} by {size}: from {before_s:.6f} s to {after_s:.6f} s"


class Segment(NamedTuple):
    """A clock between two jumps: first and last stamp and receive time (ns), domain, envelope."""

    first_stamp_ns: int
    last_stamp_ns: int
    first_host_ns: int
    last_host_ns: int
    packets: int
    domain: str
    envelope: Envelope

    @property
    def middle_ns(self) -> int:
        """Receive time in its middle."""
        return self.first_host_ns + max(self.last_host_ns - self.first_host_ns, 0) // 2

    @property
    def offset_ns(self) -> int:
        """Stamp minus receive time of the fastest packets in its middle."""
        return int(self.envelope.at(np.array([self.middle_ns], np.int64))[0])


class ClockEstimate(NamedTuple):
    """Estimate of a sensor's clock."""

    packets: int
    damaged: int  # packets whose stamp fits neither the one before nor the one after
    domain: str  # utc, tai, gps, top_of_hour, uptime, wrong_year or unknown, of the longest segment
    # Stamp minus receive time of the fastest packets in the middle of that segment.
    offset_ns: int
    uncertainty_ns: int  # of the offset
    at_host_ns: int  # receive time in the middle of that segment
    # Rate of the sensor's clock relative to the capture host's, None if the recording is too
    # short.
    drift_ppm: float | None
    drift_uncertainty_ppm: float | None
    jumps: tuple[Jump, ...]
    segments: tuple[Segment, ...]
    unsteady: bool  # more than MAX_SEGMENTS segments
    mode: str = ""  # time source that the sensor reports

    @property
    def sensor_jumps(self) -> tuple[Jump, ...]:
        """Jumps of the sensor's own clock."""
        return tuple(jump for jump in self.jumps if jump.kind not in (HOST, DELAY))

    def describe(self) -> str:
        """The estimate as one line."""
        offset = format_difference(self.offset_ns)
        text = f"clock: {DESCRIPTION[self.domain]}, {offset} to the capture host"
        text += f" (+-{self.uncertainty_ns / NS_PER_MS:.3f} ms)"
        known = known_difference(self.offset_ns, self.at_host_ns, HARD_NS // 2)
        if self.domain not in ("uptime", "utc") and known is not None:
            name = known[1]
            text += f", about {name}" if "second" not in name else ""
        if self.drift_ppm is not None:
            text += f", drift {self.drift_ppm:+.2f} +-{self.drift_uncertainty_ppm:.2f} ppm"
        if self.domain == UPTIME and not self.mode:
            text += ", no time source is named: dates would be of 1970"
        for jump in self.jumps:
            text += f"; {jump.describe()}"
        return text + (f"; more than {MAX_SEGMENTS - 1} jumps" if self.unsteady else "")


class ClockWatch:
    """Estimates the clock of one sensor from its packets, in bounded memory.

    The estimate does not depend on how packets are grouped into batches.
    """

    def __init__(self, *, period_ns: int = 0, mode: str = "") -> None:
        """Properties of the sensor.

        period_ns: range of the counter if the decoder completes stamps from receive times (an hour
        for Velodyne), else 0; mode: time source that the sensor reports.
        """
        self.damaged = 0
        self._period_ns = period_ns
        self._mode = mode
        # One for each segment between steps above HARD_NS.
        self._bins: list[PacketBins] = []
        self._last_offset_ns: int | None = None
        # Stamp and receive time of a packet after a step, until the next one confirms it.
        self._pending: tuple[int, int] | None = None
        self._unsteady = False
        self._estimate: ClockEstimate | None = None
        self._queue: list[tuple[I64Array, I64Array]] = []
        self._queued = 0

    def add(self, stamp_ns: I64Array, host_ns: I64Array) -> None:
        """Add packets (P,) in order of receive time: newest stamp and receive time of each.

        The arrays are kept until enough packets are collected: do not change them.
        """
        self._estimate = None
        self._queue.append((stamp_ns, host_ns))
        self._queued += len(stamp_ns)
        if self._queued >= _BATCH:
            self._evaluate()

    def estimate(self) -> ClockEstimate | None:
        """The estimate so far; None before the first packet."""
        if self._estimate is None:
            self._estimate = self._make_estimate()
        return self._estimate

    def track(self) -> ClockTrack | None:
        """Ranges, envelopes and steps so far; None before the first packet."""
        self._evaluate()
        tables = [table for table in (one.table() for one in self._bins) if table is not None]
        if not tables and self._pending is not None:
            alone = PacketBins()
            alone.add(*(np.array([value], np.int64) for value in self._pending))
            tables = [table for table in (alone.table(),) if table is not None]
        return track_of(tables) if tables else None

    def _evaluate(self) -> None:
        """Put the queued packets into bins, cut at steps above HARD_NS."""
        if not self._queue:
            return
        stamp_ns = np.concatenate([stamp_ns for stamp_ns, _ in self._queue])
        host_ns = np.concatenate([host_ns for _, host_ns in self._queue])
        self._queue = []
        self._queued = 0
        sane = (stamp_ns >= 0) & (stamp_ns < LIMIT_NS) & (host_ns >= 0) & (host_ns < LIMIT_NS)
        if not sane.all():
            self.damaged += int(np.count_nonzero(~sane))
            stamp_ns = stamp_ns[sane]
            host_ns = host_ns[sane]
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
            self._add_run(stamp_ns[begin:end], host_ns[begin:end], is_last=end == len(stamp_ns))

    def _add_run(self, stamp_ns: I64Array, host_ns: I64Array, *, is_last: bool) -> None:
        """Add packets without a step above HARD_NS between them."""
        first_ns = int(stamp_ns[0] - host_ns[0])
        continues = (
            self._last_offset_ns is not None and abs(first_ns - self._last_offset_ns) <= HARD_NS
        )
        if len(stamp_ns) == 1 and not continues:
            # One packet alone is no step, unless the next one confirms it.
            if is_last:
                self._pending = int(stamp_ns[0]), int(host_ns[0])
            else:
                self.damaged += 1
            return
        if not continues:
            if len(self._bins) == MAX_SEGMENTS:
                self._unsteady = True
                return
            self._bins.append(PacketBins())
        self._bins[-1].add(stamp_ns, host_ns)
        self._last_offset_ns = int(stamp_ns[-1] - host_ns[-1])

    def _make_estimate(self) -> ClockEstimate | None:
        track = self.track()
        if track is None:
            return None
        longest = max(range(len(track.parts)), key=lambda at: track.parts[at].packets)
        part = track.parts[longest]
        envelope = track.envelopes[longest]
        segments = tuple(
            _segment(track, number, self._period_ns) for number in range(len(track.parts))
        )
        jumps = tuple(_jump(step, self._period_ns) for step in track.steps)
        quantum_ns = 0
        for one in self._bins:
            quantum_ns = int(np.gcd(quantum_ns, one.quantum_ns))
        drift = _drift(track)
        scatter_ns = round(3 * envelope.scatter_ns) + quantum_ns * (quantum_ns <= NS_PER_MS)
        burst_ns = BURST_NS * BURST_NS // max(part.span_ns, BURST_NS)
        return ClockEstimate(
            packets=sum(one.packets for one in self._bins) + (not self._bins),
            damaged=self.damaged + (self._pending is not None and bool(self._bins)),
            domain=_domain(segments, jumps, longest),
            offset_ns=segments[longest].offset_ns,
            uncertainty_ns=SHORTEST_DELAY_NS + scatter_ns + burst_ns,
            at_host_ns=segments[longest].middle_ns,
            drift_ppm=None if drift is None else drift[0] * _PPM,
            drift_uncertainty_ppm=None if drift is None else drift[1] * _PPM,
            jumps=jumps,
            segments=segments,
            unsteady=self._unsteady,
            mode=self._mode,
        )


def without_host_steps(
    estimate: ClockEstimate, kinds: Collection[str] = (HOST,)
) -> tuple[Segment, ...]:
    """Segments by a capture host's clock that never stepped; kinds: jumps counted as its steps."""
    moved_ns = 0
    segments = [estimate.segments[0]]
    for jump, one in zip(estimate.jumps, estimate.segments[1:], strict=True):
        if jump.kind in kinds:
            moved_ns -= jump.size_ns
        envelope = one.envelope._replace(
            host_ns=one.envelope.host_ns - moved_ns,
            offset_ns=one.envelope.offset_ns + moved_ns,
        )
        segments.append(
            one._replace(
                first_host_ns=one.first_host_ns - moved_ns,
                last_host_ns=one.last_host_ns - moved_ns,
                envelope=envelope,
            )
        )
    return tuple(segments)


def segment_of(
    segments: Sequence[Segment], stamp_ns: I64Array, host_ns: I64Array | None = None
) -> I64Array:
    """Index of the segment that each stamp belongs to.

    host_ns: receive times, to separate segments with the same stamps (a clock that was set back).
    """
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
    """Distance of values from an interval."""
    away: I64Array = np.maximum(low - value, 0) + np.maximum(value - high, 0)
    return away


def _segment(track: ClockTrack, number: int, period_ns: int) -> Segment:
    part = track.parts[number]
    envelope = track.envelopes[number]
    offset_ns = int(envelope.offset_ns[len(envelope.offset_ns) // 2])
    return Segment(
        first_stamp_ns=part.first[0],
        last_stamp_ns=part.last[0],
        first_host_ns=part.first[1],
        last_host_ns=part.last[1],
        packets=part.packets,
        domain=domain_of(part.first[0], offset_ns, period_ns),
        envelope=envelope,
    )


def _domain(segments: Sequence[Segment], jumps: Sequence[Jump], longest: int) -> str:
    """Domain of the longest segment; if unknown, of another one between steps of the host only."""
    named = [one.domain for one in segments if one.domain in EPOCHS]
    if segments[longest].domain == UNKNOWN and named and all(one.kind == HOST for one in jumps):
        return named[0]
    return segments[longest].domain


def _jump(step: Step, period_ns: int) -> Jump:
    before_ns = step.before[0]
    after_ns = step.after[0]
    kind = HOST
    if step.side != HOST:
        kind = kind_of_jump(before_ns, after_ns, step.size_ns, period_ns)
    return Jump(step.after[1], before_ns, after_ns, step.size_ns, kind, step.side)


def _drift(track: ClockTrack) -> tuple[float, float] | None:
    """Rate over all ranges, weighted by the cube of their length, and its error; None: no rate."""
    known = [
        (float(part.span_ns) ** 3, envelope)
        for part, envelope in zip(track.parts, track.envelopes, strict=True)
        if np.isfinite(envelope.rate_error)
    ]
    total = sum(weight for weight, _ in known)
    if not total:
        return None
    rate = sum(weight * envelope.rate for weight, envelope in known) / total
    return rate, sum(weight * envelope.rate_error for weight, envelope in known) / total
