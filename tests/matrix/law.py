"""Expected scans of packets received in the order of their stamps (docs/batching.md), by arrays.

Only for sessions in which no column is late; faults are applied to packets before. The grid is that
of 20 Hz, whose bounds are whole ns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import I64Array
from tests.matrix.lidars import NS_PER_MS, NS_PER_S, Sent

PERIOD_NS = 50 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class Window:
    """An expected scan: its columns (n,) in order, and the number of their points."""

    start_ns: int
    complete: bool
    stamp_ns: I64Array
    sensor: I64Array
    points: int


@dataclass(frozen=True, slots=True)
class Law:
    """Expected result of a session; dropped: columns of each sensor by reason."""

    t_init_ns: int
    windows: Mapping[int, Window]
    dropped: tuple[Mapping[str, int], ...]
    empty: int

    @property
    def incomplete(self) -> int:
        """Scans that are not complete."""
        return sum(not window.complete for window in self.windows.values())


def law(session: Sequence[Sent], max_wait_ns: int = NS_PER_S) -> Law:
    """Windows of a session without its head and tail."""
    firsts = [int(sent.stamp_ns[0, 0]) for sent in session]
    lasts = [int(sent.stamp_ns.max()) for sent in session]
    # Eq. (1) over those that are not stalled when the others are ready.
    t0max = max(first for first in firsts if first <= min(firsts) + max_wait_ns)
    k0 = t0max // PERIOD_NS + 1
    stamp_ns = np.concatenate([sent.stamp_ns.reshape(-1) for sent in session])
    points = np.concatenate([sent.points.reshape(-1) for sent in session])
    sensor = np.repeat(np.arange(len(session)), [sent.stamp_ns.size for sent in session])
    order = np.lexsort((np.arange(len(sensor)), sensor, stamp_ns))
    stamp_ns = stamp_ns[order]
    sensor = sensor[order]
    points = points[order]
    index = stamp_ns // PERIOD_NS - k0
    tail = int(max(lasts)) // PERIOD_NS - k0
    reasons = {"before_start": index < -1, "head": index == -1, "tail": index == max(tail, 0)}
    dropped = tuple(
        {
            reason: count
            for reason, chosen in reasons.items()
            if (count := int(np.count_nonzero(chosen & (sensor == number))))
        }
        for number in range(len(session))
    )
    gaps = [gap for sent in session for gap in _gaps(sent, max_wait_ns)]
    windows = {}
    seen = np.unique(index[index >= 0]).tolist()
    for one in seen:
        start_ns = (k0 + one) * PERIOD_NS
        end_ns = start_ns + PERIOD_NS
        complete = max(firsts) <= start_ns and min(lasts) >= end_ns
        complete &= not any(before < end_ns and after > start_ns for before, after in gaps)
        if one != tail:
            own = index == one
            windows[one] = Window(
                start_ns, complete, stamp_ns[own], sensor[own], int(points[own].sum())
            )
    return Law(k0 * PERIOD_NS, windows, dropped, seen[-1] + 1 - len(seen) if seen else 0)


def _gaps(sent: Sent, max_wait_ns: int) -> list[tuple[int, int]]:
    """Last stamp before and first after each silence longer than the wait."""
    newest = np.maximum.accumulate(sent.stamp_ns.reshape(-1))
    at = np.flatnonzero(np.diff(newest) > max_wait_ns)
    return list(zip(newest[at].tolist(), newest[at + 1].tolist(), strict=True))
