"""`--align-clocks`: maps of sensors' clocks onto the capture host's, or onto the first sensor's.

A map follows the envelope of stamp minus receive time. Steps of the capture host's clock are left
out, since the stamps did not step: aligned stamps are on the host's clock as it was at the start.
Steps of a sensor's clock are removed from its stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.clocks.compare import mark_host_steps
from mlbatch.clocks.timescale import DELAY, HOST
from mlbatch.clocks.watch import (
    LIMIT_NS,
    ClockEstimate,
    ClockWatch,
    Segment,
    segment_of,
    without_host_steps,
)
from mlbatch.errors import ClockError
from mlbatch.units import NS_PER_MS

TO_HOST = "host"
TO_FIRST = "first"
# Jumps that are not of the sensor's clock: its stamps did not step.
_NOT_OF_SENSOR = (HOST, DELAY)
_FAR = 2**62


@dataclass(frozen=True, slots=True)
class _Piece:
    """Map of one segment: offsets to add at stamps (k,), ns, straight between them."""

    stamp_ns: I64Array
    offset_ns: I64Array
    rate: float  # slope beyond the stamps
    least_ns: int  # lower limit of aligned stamps, so that segments keep their order
    most_ns: int  # upper limit of aligned stamps

    def apply(self, stamp_ns: I64Array) -> I64Array:
        """Aligned stamps; exact, since only differences become floats."""
        at = np.searchsorted(self.stamp_ns, stamp_ns, side="right") - 1
        inner = np.clip(at, 0, len(self.stamp_ns) - 1)
        since = (stamp_ns - self.stamp_ns[inner]).astype(np.float64)
        rates = np.append(self._rates(), self.rate)[inner]
        rates = np.where(at < 0, self.rate, rates)
        added_ns = self.offset_ns[inner] + np.rint(since * rates).astype(np.int64)
        aligned: I64Array = np.clip(stamp_ns + added_ns, self.least_ns, self.most_ns)
        return aligned

    def _rates(self) -> F64Array:
        steps = np.diff(self.stamp_ns).astype(np.float64)
        rates: F64Array = np.diff(self.offset_ns).astype(np.float64) / steps
        return rates


@dataclass(frozen=True, slots=True)
class ClockMap:
    """Map of a sensor's stamps onto another clock; it keeps their order."""

    to: str  # `host` or `first`
    knots: int  # number, in all segments
    residual_p50_ns: int  # median distance of the fastest packets from the map
    residual_max_ns: int  # largest distance of the fastest packets from the map
    segments: tuple[Segment, ...]
    _pieces: tuple[_Piece, ...]

    def apply(self, stamp_ns: I64Array, host_ns: I64Array | None = None) -> I64Array:
        """Aligned stamps, int64 ns, of any shape; stamps outside [0, 2^31) s are unchanged.

        host_ns: receive times, of a shape that fits, to separate equal stamps of a clock that was
        set back.
        """
        sane = (stamp_ns >= 0) & (stamp_ns < LIMIT_NS)
        if not sane.all():
            # Damaged stamps could overflow to good ones.
            good_ns = np.where(sane, stamp_ns, 0)
            return np.where(sane, self.apply(good_ns, host_ns), stamp_ns)
        if len(self._pieces) == 1:
            return self._pieces[0].apply(stamp_ns)
        which = segment_of(self.segments, stamp_ns, host_ns)
        aligned = np.empty_like(stamp_ns)
        for number, piece in enumerate(self._pieces):
            mine = which == number
            aligned[mine] = piece.apply(stamp_ns[mine])
        return aligned

    def describe(self) -> str:
        """The map as one line."""
        target = "the capture host's clock" if self.to == TO_HOST else "the first sensor's clock"
        return (
            f"aligned to {target}: {self.knots} knot(s), residual of the fastest packets "
            f"{self.residual_p50_ns / NS_PER_MS:.3f} ms (median), "
            f"{self.residual_max_ns / NS_PER_MS:.3f} ms (maximum)"
        )


def fit(watches: Sequence[ClockWatch], to: str = TO_HOST) -> tuple[ClockMap | None, ...]:
    """A map for each sensor; None for one without packets.

    to: `host` or `first`; ClockError if the first sensor's clock cannot be the target.
    """
    all_estimates = [(str(at), watch.estimate()) for at, watch in enumerate(watches)]
    known = [(name, one) for name, one in all_estimates if one is not None]
    estimates = dict(mark_host_steps(known))
    target = _target(estimates.get("0")) if to == TO_FIRST else ()
    maps: list[ClockMap | None] = []
    for name, _ in all_estimates:
        estimate = estimates.get(name)
        if estimate is None:
            maps.append(None)
        elif to == TO_FIRST and name == "0":
            maps.append(_identity(estimate))
        else:
            maps.append(_map(estimate, to, target))
    return tuple(maps)


def _target(estimate: ClockEstimate | None) -> tuple[Segment, ...]:
    """The first sensor's clock, by a capture host's clock that never stepped."""
    if estimate is None:
        raise ClockError(
            "--align-clocks first: expected packets of the first sensor, found none; "
            "use --align-clocks host"
        )
    if estimate.sensor_jumps or estimate.unsteady:
        raise ClockError(
            "--align-clocks first: expected a first sensor whose clock does not jump, found "
            f"{len(estimate.sensor_jumps)} jump(s); use --align-clocks host"
        )
    return without_host_steps(estimate, _NOT_OF_SENSOR)


def _identity(estimate: ClockEstimate) -> ClockMap:
    """The map of the target itself."""
    zero = np.zeros(1, np.int64)
    piece = _Piece(zero, zero, rate=0.0, least_ns=-_FAR, most_ns=_FAR)
    return ClockMap(TO_FIRST, 0, 0, 0, estimate.segments[:1], (piece,))


def _map(estimate: ClockEstimate, to: str, target: Sequence[Segment]) -> ClockMap:
    pieces: list[_Piece] = []
    least_ns = -_FAR
    for one in without_host_steps(estimate, _NOT_OF_SENSOR):
        piece = _piece(one, target, least_ns)
        least_ns = int(piece.apply(np.array([one.last_stamp_ns], np.int64))[0])
        pieces.append(replace(piece, most_ns=least_ns))
    pieces[-1] = replace(pieces[-1], most_ns=_FAR)
    residual_ns = np.concatenate([one.envelope.residual_ns for one in estimate.segments])
    return ClockMap(
        to=to,
        knots=sum(len(piece.stamp_ns) for piece in pieces),
        residual_p50_ns=round(float(np.quantile(residual_ns, 0.5, method="inverted_cdf"))),
        residual_max_ns=round(float(residual_ns.max())),
        segments=estimate.segments,
        _pieces=tuple(pieces),
    )


def _piece(one: Segment, target: Sequence[Segment], least_ns: int) -> _Piece:
    """The map of one segment; target: empty for the capture host's clock."""
    at_ns = one.envelope.host_ns
    target_rate = 0.0
    if target:
        theirs_ns = np.concatenate([segment.envelope.host_ns for segment in target])
        at_ns = np.union1d(at_ns, theirs_ns)
        near = (at_ns >= one.first_host_ns) & (at_ns <= one.last_host_ns)
        at_ns = at_ns[near | np.isin(at_ns, one.envelope.host_ns)]
        target_rate = target[-1].envelope.rate
    own_ns = one.envelope.at(at_ns)
    stamp_ns = at_ns + own_ns
    newest = np.maximum.accumulate(np.append(-_FAR, stamp_ns))[:-1]
    kept = stamp_ns > newest
    offset_ns = (_offsets(target, at_ns) - own_ns)[kept]
    rate = (target_rate - one.envelope.rate) / (1 + one.envelope.rate)
    return _Piece(stamp_ns[kept], offset_ns, rate, least_ns, _FAR)


def _offsets(target: Sequence[Segment], at_ns: I64Array) -> I64Array:
    """How far the target's clock is ahead of the capture host's, at receive times."""
    offset_ns = np.zeros(len(at_ns), np.int64)
    for number, segment in enumerate(target):
        mine = at_ns >= segment.first_host_ns if number else np.ones(len(at_ns), bool)
        offset_ns[mine] = segment.envelope.at(at_ns[mine])
    return offset_ns
