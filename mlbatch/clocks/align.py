"""`--align-clocks`: a sensor's clock mapped onto the recorder's, or onto the first sensor's.

The map follows the upper envelope of stamp minus arrival, straight between knots. Steps of the
recorder's clock are left out, since the stamps went on: aligned stamps run by the recorder's clock
as it was at the start. Steps of the sensor's clock are taken out of its stamps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from mlbatch.clocks.compare import with_host_steps
from mlbatch.clocks.timescale import DELAY, HOST
from mlbatch.clocks.watch import LIMIT_NS, ClockEstimate, ClockWatch, Segment, segment_of, steady
from mlbatch.errors import ClockError
from mlbatch.units import NS_PER_MS

TO_HOST, TO_FIRST = "host", "first"
# Whatever steps on the recorder's side: the stamps went on.
_TAKEN_OUT = (HOST, DELAY)
_FAR = 2**62


@dataclass(frozen=True, slots=True)
class _Piece:
    """A segment of a map: offsets to add at stamps (k,), ns; beyond them the rate goes on.

    least_ns, most_ns: no aligned stamp lies outside, so that segments keep their order.
    """

    stamp_ns: I64Array
    offset_ns: I64Array
    rate: float
    least_ns: int
    most_ns: int

    def apply(self, stamp_ns: I64Array) -> I64Array:
        """Aligned stamps: exact, since only differences, never epochs, become floats."""
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
    """Maps a sensor's stamps onto another clock; larger stamps never become smaller ones.

    knots: of all segments; residual_p50_ns, residual_max_ns: how far the fastest packets lie from
    the map; to: `host` or `first`.
    """

    to: str
    knots: int
    residual_p50_ns: int
    residual_max_ns: int
    segments: tuple[Segment, ...]
    _pieces: tuple[_Piece, ...]

    def apply(self, stamp_ns: I64Array, host_ns: I64Array | None = None) -> I64Array:
        """Aligned stamps, int64 ns, of any shape; what is no time at all stays as it is.

        host_ns: arrivals, of a shape that fits; they tell stamps apart that a clock gave twice
        because it was set back.
        """
        sane = (stamp_ns >= 0) & (stamp_ns < LIMIT_NS)
        if not sane.all():
            # Damaged stamps could come round to good ones by overflow.
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
        """One line for the report."""
        target = "the recorder's clock" if self.to == TO_HOST else "the first sensor's clock"
        return (
            f"aligned to {target}: {self.knots} knot(s), fastest packets within "
            f"{self.residual_p50_ns / NS_PER_MS:.3f} ms (half of them), "
            f"{self.residual_max_ns / NS_PER_MS:.3f} ms (all)"
        )


def fit(watches: Sequence[ClockWatch], to: str = TO_HOST) -> tuple[ClockMap | None, ...]:
    """A map for each sensor; None for one without packets.

    to: `host` or `first`; ClockError if the first sensor's clock cannot be a target.
    """
    found = [(str(at), watch.estimate()) for at, watch in enumerate(watches)]
    seen = with_host_steps([(name, one) for name, one in found if one is not None])
    findings = dict(seen)
    target = _target(findings.get("0")) if to == TO_FIRST else ()
    maps: list[ClockMap | None] = []
    for name, _ in found:
        finding = findings.get(name)
        if finding is None:
            maps.append(None)
        elif to == TO_FIRST and name == "0":
            maps.append(_itself(finding))
        else:
            maps.append(_map(finding, to, target))
    return tuple(maps)


def _target(finding: ClockEstimate | None) -> tuple[Segment, ...]:
    """The first sensor's clock, by a recorder's clock that never stepped."""
    if finding is None:
        raise ClockError(
            "--align-clocks first: wanted packets of the first sensor, got none; "
            "use --align-clocks host"
        )
    if finding.sensor_jumps or finding.unsteady:
        raise ClockError(
            "--align-clocks first: wanted a first sensor whose clock runs without a jump, got "
            f"{len(finding.sensor_jumps)} jump(s); use --align-clocks host"
        )
    return steady(finding, _TAKEN_OUT)


def _itself(finding: ClockEstimate) -> ClockMap:
    """The map of the target: nothing changes."""
    nothing = np.zeros(1, np.int64)
    return ClockMap(
        TO_FIRST, 0, 0, 0, finding.segments[:1], (_Piece(nothing, nothing, 0.0, -_FAR, _FAR),)
    )


def _map(finding: ClockEstimate, to: str, target: Sequence[Segment]) -> ClockMap:
    pieces: list[_Piece] = []
    least_ns = -_FAR
    for one in steady(finding, _TAKEN_OUT):
        piece = _piece(one, target, least_ns)
        least_ns = int(piece.apply(np.array([one.last_stamp_ns], np.int64))[0])
        pieces.append(replace(piece, most_ns=least_ns))
    pieces[-1] = replace(pieces[-1], most_ns=_FAR)
    residual_ns = np.concatenate([one.line.residual_ns for one in finding.segments])
    return ClockMap(
        to,
        sum(len(piece.stamp_ns) for piece in pieces),
        round(float(np.quantile(residual_ns, 0.5, method="inverted_cdf"))),
        round(float(residual_ns.max())),
        finding.segments,
        tuple(pieces),
    )


def _piece(one: Segment, target: Sequence[Segment], least_ns: int) -> _Piece:
    """The map of one segment; target: empty for the recorder's clock."""
    at_ns = one.line.host_ns
    rate = 0.0
    if target:
        at_ns = np.union1d(at_ns, np.concatenate([segment.line.host_ns for segment in target]))
        near = (at_ns >= one.first_host_ns) & (at_ns <= one.last_host_ns)
        at_ns = at_ns[near | np.isin(at_ns, one.line.host_ns)]
        rate = target[-1].line.rate
    ours_ns = one.line.at(at_ns)
    stamp_ns = at_ns + ours_ns
    newest = np.maximum.accumulate(np.append(-_FAR, stamp_ns))[:-1]
    kept = stamp_ns > newest
    offset_ns = (_offsets(target, at_ns) - ours_ns)[kept]
    rate = (rate - one.line.rate) / (1 + one.line.rate)
    return _Piece(stamp_ns[kept], offset_ns, rate, least_ns, _FAR)


def _offsets(target: Sequence[Segment], at_ns: I64Array) -> I64Array:
    """How far the target's clock is ahead of the recorder's."""
    offset_ns = np.zeros(len(at_ns), np.int64)
    for number, segment in enumerate(target):
        mine = at_ns >= segment.first_host_ns if number else np.ones(len(at_ns), bool)
        offset_ns[mine] = segment.line.at(at_ns[mine])
    return offset_ns
