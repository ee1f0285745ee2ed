"""Expected points of scans, from the data of the encoders (`seen.py`), not by a decoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from tests.builders.seen import Seen


@dataclass(frozen=True, slots=True)
class Points:
    """Points of a dense scan, in its order; (p,) each, xyz_m (p, 3), body frame; times in ns."""

    column: I64Array
    lidar_id: I64Array
    ring: I64Array
    at_ns: I64Array
    range_m: F64Array
    level: I64Array
    xyz_m: F64Array


@dataclass(frozen=True, slots=True)
class _Sorted:
    """Slots (n, channels * returns) of the columns of a sensor, in the order of the contract."""

    ring: I64Array
    at_ns: I64Array
    counts: I64Array
    level: I64Array
    keep: BoolArray
    xyz_m: F64Array
    unit_m: float


class Expected:
    """Makes the points of scans of these sensors, in the order of `lidar_id`."""

    def __init__(self, seen: Sequence[Seen]) -> None:
        self._sensors = []
        ring_base = 0
        for sight in seen:
            self._sensors.append(_sorted(sight, ring_base))
            ring_base += sight.channels

    def points(self, sensor: I64Array, column: I64Array) -> Points:
        """Points of a scan of these columns: (n,), number of each among those of its sensor."""
        parts = []
        for number, slots in enumerate(self._sensors):
            rows = np.flatnonzero(sensor == number)
            own = column[rows]
            keep = slots.keep[own]
            parts.append(
                Points(
                    np.repeat(rows, keep.sum(axis=1)),
                    np.full(np.count_nonzero(keep), number),
                    slots.ring[own][keep],
                    slots.at_ns[own][keep],
                    slots.counts[own][keep].astype(np.float64) * slots.unit_m,
                    slots.level[own][keep],
                    slots.xyz_m[own][keep],
                )
            )
        order = np.argsort(np.concatenate([part.column for part in parts]), kind="stable")
        return Points(
            *(
                np.concatenate([getattr(part, name) for part in parts])[order]
                for name in ("column", "lidar_id", "ring", "at_ns", "range_m", "level", "xyz_m")
            )
        )


def repeated(counts: I64Array) -> BoolArray:
    """(n, channels, returns) which returns equal an earlier one of their shot."""
    again = np.zeros(counts.shape, np.bool_)
    for which in range(1, counts.shape[2]):
        earlier = counts[:, :, :which] == counts[:, :, which, None]
        again[:, :, which] = earlier.any(axis=2) & (counts[:, :, which] > 0)
    return again


def _sorted(sight: Seen, ring_base: int) -> _Sorted:
    """By firing, then channel, then return (docs/formats.md)."""
    keep = (sight.counts > 0) & ~repeated(sight.counts)
    fires_ns = np.repeat(sight.firing_ns, sight.returns, axis=1)
    order = np.argsort(fires_ns, axis=1, kind="stable")
    ring = ring_base + np.arange(sight.channels).repeat(sight.returns)

    def in_order(values: I64Array) -> I64Array:
        return np.take_along_axis(values.reshape(order.shape), order, axis=1)

    return _Sorted(
        ring[order],
        in_order(fires_ns),
        in_order(sight.counts),
        in_order(sight.level),
        in_order(keep.astype(np.int64)) > 0,
        np.take_along_axis(sight.xyz_m.reshape(*order.shape, 3), order[..., None], axis=1),
        sight.unit_m,
    )
