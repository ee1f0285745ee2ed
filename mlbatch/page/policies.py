"""Figures of a fusion policy, or of windows, for pages and plots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F64Array

# Speeds that offsets of objects are shown for, km/h.
SPEEDS_KMH = (10, 30, 50, 100)
KMH_PER_MPS = 3.6
# Of an object, if no other speed is asked for.
DEFAULT_MPS = 10.0
_MS_PER_S = 1000


@dataclass(frozen=True, slots=True, eq=False)
class PolicyFigures:
    """Sets of one policy, (n,) float64 each.

    start_s: of a set, from the first of all policies; span_ms: from its first to its last column;
    apart_ms: between the mean times of its sensors; latency_ms: from its first column until it is
    complete; columns: number that could be used.
    """

    name: str
    sets: int
    without_a_sensor: int
    stale: int
    columns: int
    used_twice: int
    never_used: int
    start_s: F64Array
    span_ms: F64Array
    apart_ms: F64Array
    latency_ms: F64Array

    @property
    def worst_ms(self) -> float:
        """Largest span; 0 without a set."""
        return float(self.span_ms.max(initial=0.0))

    @staticmethod
    def median(values: F64Array) -> float:
        """Median by nearest rank; 0 without values."""
        return float(np.quantile(values, 0.5, method="inverted_cdf")) if len(values) else 0.0

    def shares(self) -> tuple[float, float, float]:
        """Shares of columns used once, more than once, and never."""
        whole = max(1, self.columns)
        twice = self.used_twice / whole
        never = self.never_used / whole
        return max(0.0, 1 - twice - never), twice, never


def offset_m(speed_mps: float, time_ms: float) -> float:
    """Way of an object in a time: how far apart two lidars show it."""
    return speed_mps * time_ms / _MS_PER_S
