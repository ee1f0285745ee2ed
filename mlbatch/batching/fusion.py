"""Frame-level fusion: the sweeps of all sensors, joined to sets by a policy of `sweeps`.

What drivers and message filters would give (approach A of the paper), from the same columns as
windows. A set is a `Window` that is on no grid. A sweep is released once all its sets are known:
its columns were used, or are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.batching.merge import ColumnMerge, joined
from mlbatch.batching.sweeps import (
    DEFAULT_TIMEOUT_NS,
    DEFAULT_TOLERANCE_NS,
    CollectedSweeps,
    JoinPolicy,
    NearestSweeps,
    NewestSweeps,
    Sweep,
    SweepCutter,
    publication_order,
)
from mlbatch.types import ColumnFigures, Columns, Window, WindowColumns
from mlbatch.units import NS_PER_S

# By the words of `--batching`.
POLICIES: Mapping[str, Callable[[int], JoinPolicy]] = {
    "latest": NewestSweeps,
    "approximate": lambda sensors: NearestSweeps(sensors, DEFAULT_TOLERANCE_NS),
    "collate": lambda sensors: CollectedSweeps(sensors, DEFAULT_TIMEOUT_NS),
}
# Older sweeps are in no set, so that raw packets are not kept for a sensor that is silent.
MOST_AGE_NS = NS_PER_S


@dataclass(slots=True)
class _Held:
    """A sweep with its columns, and the number of sets that contain it."""

    sweep: Sweep
    columns: Columns
    sets: int = 0
    is_published: bool = False


class SweepFusion:
    """Takes windows in order, yields sets; dropped, reused: columns by sensor.

    dropped: by reason; reused: columns in a further set, counted once for each.
    """

    def __init__(self, policy: str, cutters: Sequence[SweepCutter], merge: ColumnMerge) -> None:
        """policy: a word of POLICIES; cutters: one per sensor."""
        self._policy = POLICIES[policy](len(cutters))
        self._cutters = list(cutters)
        self._merge = merge
        # Columns of the sweep of each sensor that has not ended.
        self._open: list[list[Columns]] = [[] for _ in cutters]
        self._held: dict[int, _Held] = {}
        self._sets = 0
        self.dropped: list[dict[str, int]] = [{} for _ in cutters]
        self.reused = [0] * len(cutters)

    def sets(self, windows: Iterable[Window]) -> Iterator[Window]:
        """Yield the sets of all windows."""
        for window in windows:
            yield from self.push(window)
        self.finish()

    def push(self, window: Window) -> Iterator[Window]:
        """Add the columns of the next window; yield the sets that they complete."""
        ended: list[Sweep] = []
        for sensor in range(len(self._cutters)):
            ended += self._cut(sensor, window.columns)
        for sweep in publication_order(ended):
            self._held[id(sweep)].is_published = True
            for members in self._policy.publish(sweep):
                known = [one for one in members if one is not None and id(one) in self._held]
                if known:
                    yield self._set(known, window.ready_host_ns)
            self._forget(sweep.first_ns - MOST_AGE_NS)

    def finish(self) -> None:
        """End of input: count what no set contains."""
        for sensor, parts in enumerate(self._open):
            self._drop(sensor, "part_sweep", sum(map(len, parts)))
            parts.clear()
        for held in list(self._held.values()):
            self._release(held)

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor that a later set may need; None: none."""
        parts = [held.columns for held in self._held.values() if held.sweep.sensor == sensor]
        oldest = (int(part.ring_index.min()) for part in (*parts, *self._open[sensor]))
        return min(oldest, default=None)

    # -- sweeps -------------------------------------------------------------------------------

    def _cut(self, sensor: int, columns: WindowColumns) -> list[Sweep]:
        """Add the columns of a sensor; hold the sweeps that end within them."""
        own = np.flatnonzero(columns.sensor == sensor)
        if not len(own):
            return []
        some = columns.take(own)
        part = Columns(some.stamp_ns, some.ring_index, some.encoder)
        cutter = self._cutters[sensor]
        was_whole = cutter.open_columns is not None
        ended = cutter.push(part.stamp_ns, part.encoder)
        waiting = joined([*self._open[sensor], part])
        left = cutter.open_columns
        begin = 0
        if left is not None:
            if not was_whole:
                begin = len(waiting) - left - sum(sweep.columns for sweep in ended)
                self._drop(sensor, "part_sweep", begin)
            for sweep in ended:
                end = begin + sweep.columns
                self._held[id(sweep)] = _Held(sweep, waiting.take(slice(begin, end)))
                begin = end
        self._open[sensor] = [waiting.take(slice(begin, None))]
        return ended

    def _forget(self, oldest_ns: int) -> None:
        """Release sweeps that no later set contains, and sweeps that began before a time."""
        waiting = {id(sweep) for sweep in self._policy.waiting}
        for key, held in list(self._held.items()):
            is_done = held.is_published and key not in waiting
            if is_done or held.sweep.first_ns < oldest_ns:
                self._release(held)

    def _release(self, held: _Held) -> None:
        del self._held[id(held.sweep)]
        sensor = held.sweep.sensor
        if held.sets:
            self.reused[sensor] += (held.sets - 1) * len(held.columns)
        else:
            self._drop(sensor, "no_set", len(held.columns))

    def _drop(self, sensor: int, reason: str, count: int) -> None:
        if count:
            self.dropped[sensor][reason] = self.dropped[sensor].get(reason, 0) + count

    # -- sets ---------------------------------------------------------------------------------

    def _set(self, sweeps: Sequence[Sweep], ready_host_ns: int) -> Window:
        """Join sweeps to a set."""
        newest_ns = max(sweep.first_ns for sweep in sweeps)
        used = [sweep for sweep in sweeps if sweep.first_ns >= newest_ns - MOST_AGE_NS]
        parts = []
        for sweep in used:
            held = self._held[id(sweep)]
            held.sets += 1
            parts.append(held.columns)
        both = joined(parts)
        sensor = np.array([one.sensor for one in used]).repeat([len(part) for part in parts])
        # In order of time, then of sensors, as in windows.
        order = np.lexsort((sensor, both.stamp_ns))
        columns = WindowColumns(both.stamp_ns, sensor, both.ring_index, both.encoder).take(order)
        figures = self._merge.figures(columns, [len(columns)])[0]
        start_ns = min(sweep.first_ns for sweep in used)
        end_ns = max(sweep.last_ns for sweep in used) + 1
        number = self._sets
        self._sets += 1
        return Window(
            index=number,
            slice=0,
            start_ns=start_ns,
            end_ns=end_ns,
            complete=len(used) == len(self._cutters),
            ready_host_ns=ready_host_ns,
            columns=columns,
            figures=figures,
            edge_gap_ns=tuple(_edge_gap_ns(own, start_ns, end_ns) for own in figures),
            # Sweeps have no length to compare with.
            fill=np.full(len(self._cutters), np.nan, np.float32),
            is_partial=False,
        )


def _edge_gap_ns(figures: ColumnFigures, start_ns: int, end_ns: int) -> int:
    """Longest time without a column at the start or the end of a set."""
    if not figures.columns:
        return end_ns - start_ns
    return max(figures.first_ns - start_ns, end_ns - figures.last_ns)
