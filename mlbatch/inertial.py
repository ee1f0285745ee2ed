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

    def take(
        self, until_ns: int | None, limits_ns: tuple[int | None, int | None]
    ) -> list[ImuSamples]:
        """Samples that begin before `until_ns` (None: all) and lie inside the limits, by stamp."""
        ready: list[ImuSamples] = []
        later: list[ImuSamples] = []
        for samples in self._waiting:
            due = until_ns is None or int(samples.stamp_ns[0]) < until_ns
            (ready if due else later).append(samples)
        self._waiting = later
        low, high = limits_ns
        taken = []
        for samples in ready:
            inside = np.ones(len(samples.stamp_ns), bool)
            if low is not None:
                inside &= samples.stamp_ns >= low
            if high is not None:
                inside &= samples.stamp_ns < high
            samples = self._kept(samples, inside, "outside_time")
            if len(samples.stamp_ns):
                self._counts[samples.sensor].written += len(samples.stamp_ns)
                taken.append(samples)
        return sorted(taken, key=lambda samples: (int(samples.stamp_ns[0]), samples.sensor))

    def _kept(self, samples: ImuSamples, keep: BoolArray, reason: str) -> ImuSamples:
        if keep.all():
            return samples
        self._counts[samples.sensor].drop(reason, int(np.count_nonzero(~keep)))
        return ImuSamples(
            samples.sensor,
            samples.stamp_ns[keep],
            samples.acceleration[keep],
            samples.angular_velocity[keep],
        )
