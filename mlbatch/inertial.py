"""IMU samples on their way past the batching: kept until the scan of their time is out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch.batching.intake import STAMP_LIMIT_NS
from mlbatch.ledger import DecodedCounts
from mlbatch.types import BoolArray, ImuSamples


class ImuQueue:
    """Samples of all sensors, counted in `counts`; nothing is kept for an output without a place.

    offsets_ns: added to the stamps of each sensor, as to those of its columns.
    """

    def __init__(
        self, counts: Sequence[DecodedCounts], offsets_ns: Sequence[int], *, wanted: bool
    ) -> None:
        self._counts = list(counts)
        self._offsets_ns = list(offsets_ns)
        self._wanted = wanted
        self._waiting: list[ImuSamples] = []

    def add(self, samples: ImuSamples) -> None:
        """Take in samples of one sensor."""
        counts = self._counts[samples.sensor]
        counts.decoded += len(samples.stamp_ns)
        if not self._wanted:
            counts.drop("no_place", len(samples.stamp_ns))
            return
        samples.stamp_ns = samples.stamp_ns + self._offsets_ns[samples.sensor]
        sane = (samples.stamp_ns >= 0) & (samples.stamp_ns < STAMP_LIMIT_NS)
        samples = self._kept(samples, sane, "bad_stamp")
        if len(samples.stamp_ns):
            self._waiting.append(samples)

    def drop_before(self, low_ns: int) -> None:
        """Drop what lies before the first limit, so that it need not wait for a scan."""
        kept = [self._kept(one, one.stamp_ns >= low_ns, "outside_time") for one in self._waiting]
        self._waiting = [samples for samples in kept if len(samples.stamp_ns)]

    def take(
        self, until_ns: int | None, limits_ns: tuple[int | None, int | None]
    ) -> list[ImuSamples]:
        """Samples before `until_ns` (None: all) and inside the limits, by stamp."""
        low, high = limits_ns
        taken, later = [], []
        for number in sorted({samples.sensor for samples in self._waiting}):
            samples = _in_order([one for one in self._waiting if one.sensor == number])
            upto = len(samples.stamp_ns)
            if until_ns is not None:
                upto = int(np.searchsorted(samples.stamp_ns, until_ns))
                later.append(_part(samples, slice(upto, None)))
            samples = _part(samples, slice(0, upto))
            inside = np.ones(upto, bool)
            if low is not None:
                inside &= samples.stamp_ns >= low
            if high is not None:
                inside &= samples.stamp_ns < high
            samples = self._kept(samples, inside, "outside_time")
            if len(samples.stamp_ns):
                self._counts[number].written += len(samples.stamp_ns)
                taken.append(samples)
        self._waiting = [samples for samples in later if len(samples.stamp_ns)]
        return sorted(taken, key=lambda samples: (int(samples.stamp_ns[0]), samples.sensor))

    def _kept(self, samples: ImuSamples, keep: BoolArray, reason: str) -> ImuSamples:
        if keep.all():
            return samples
        self._counts[samples.sensor].drop(reason, int(np.count_nonzero(~keep)))
        return _part(samples, keep)


def _in_order(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Samples of one sensor as one, by stamp: packets may have overtaken each other."""
    stamp_ns = np.concatenate([part.stamp_ns for part in parts])
    order = np.argsort(stamp_ns, kind="stable")
    return ImuSamples(
        parts[0].sensor,
        stamp_ns[order],
        np.concatenate([part.acceleration for part in parts])[order],
        np.concatenate([part.angular_velocity for part in parts])[order],
    )


def _part(samples: ImuSamples, which: BoolArray | slice) -> ImuSamples:
    return ImuSamples(
        samples.sensor,
        samples.stamp_ns[which],
        samples.acceleration[which],
        samples.angular_velocity[which],
    )
