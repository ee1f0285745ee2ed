"""The instant of a recording at which fused sets and windows differ most, found in one pass.

Columns of the last windows are kept, with their raw packets. At some instants all that a set of
that time contains is decoded, and the one with the largest difference is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.batching.fusion import MOST_AGE_NS
from mlbatch.batching.sweeps import SweepSet, sweeps_of
from mlbatch.batching.windows import Window
from mlbatch.compare.places import (
    RADIUS_M,
    Difference,
    Points,
    apart,
    difference,
    mean_times_ns,
)
from mlbatch.decode.decoder import Decoder, ScanHeader
from mlbatch.outputs.stored_scan import StoredScan
from mlbatch.page.instant import InstantSet, SharedInstant, Spot
from mlbatch.pipeline.sensor import Sensor
from mlbatch.types import WindowColumns
from mlbatch.units import NS_PER_MS, NS_PER_S

# Sets of an instant are complete by then: approximate time waits a sweep and its tolerance.
_WAIT_NS = 400_000_000
_KEPT_NS = MOST_AGE_NS + _WAIT_NS + 400_000_000
# Windows from one instant to the next, doubled after so many.
_STEP, _INSTANTS = 5, 12
# Of the spans of sets, beyond the largest so far, to look at once.
_LONGER_NS = 5_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _Best:
    """What differs most so far; members: distinct sets with their names, window last."""

    window: Window
    members: list[tuple[str, SweepSet]]
    shown: int
    place: Difference | None
    clouds: list[StoredScan]
    apart_ms: list[tuple[float, float] | None]

    @property
    def score(self) -> tuple[bool, float]:
        return (False, 0.0) if self.place is None else self.place.score


class InstantFinder:
    """Takes sets of all policies and windows, in order; `found` once all are there."""

    def __init__(
        self,
        names: Sequence[str],
        sensors: Sequence[Sensor],
        period_ns: int,
        new_decoder: Callable[[], Decoder],
    ) -> None:
        """names: of the policies, then of windows.

        new_decoder: called with the first instant; its scans are dense, with `column`.
        """
        self._names = names
        self._sensors = sensors
        self._period_ns = period_ns
        self._new_decoder = new_decoder
        self._decoder: Decoder | None = None
        self._windows: deque[Window] = deque()
        self._sets: list[deque[SweepSet]] = [deque() for _ in names[:-1]]
        self._first_ns: int | None = None
        self._count = self._looked = 0
        self._step = _STEP
        self._longest_ns = 0
        self._best: _Best | None = None
        lacking = [sensor.name for sensor in sensors if not sensor.detected.pose.is_known]
        self._why = (
            f"No merged clouds: {', '.join(lacking)} without extrinsics; give them in a rig "
            "(--rig) or in /tf_static."
            if lacking
            else ""
        )

    def add_set(self, policy: int, joined: SweepSet) -> None:
        """Add a set of a policy."""
        sets = self._sets[policy]
        sets.append(joined)
        while _last_ns(sets[0]) < _last_ns(joined) - _KEPT_NS:
            sets.popleft()

    def add(self, window: Window) -> None:
        """Add the next window, after the sets that are complete by then."""
        if self._first_ns is None:
            self._first_ns = window.start_ns
        self._windows.append(window)
        while self._windows[0].end_ns < window.end_ns - _KEPT_NS:
            self._windows.popleft()
        due = [one for one in self._windows if one.end_ns <= window.end_ns - _WAIT_NS]
        if due and not due[-1].is_partial:
            self._look(due[-1], is_asked=False)

    def finish(self) -> None:
        """End of input: look at the last windows of a recording that is too short for others."""
        for window in list(self._windows)[:-1] if self._best is None else ():
            if not window.is_partial:
                self._look(window, is_asked=True)

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index of a sensor that an instant may need; None: none."""
        parts = (one.columns.ring_index[one.columns.sensor == sensor] for one in self._windows)
        return min((int(part.min()) for part in parts if len(part)), default=None)

    def found(self) -> SharedInstant | None:
        """The instant; None without a set."""
        best = self._best
        if best is None or self._first_ns is None:
            return None
        sensors = len(self._sensors)
        instant_ns = best.window.end_ns
        clouds: Sequence[StoredScan | None] = best.clouds or [None] * len(best.members)
        sets = []
        for number, ((name, members), cloud) in enumerate(zip(best.members, clouds, strict=True)):
            spot_ms: tuple[float | None, ...] = ()
            if cloud is not None and best.place is not None:
                times_ns = mean_times_ns(_points(cloud), best.place.centre_m, sensors)
                spot_ms = tuple(None if one is None else -one / NS_PER_MS for one in times_ns)
            ages_ms = tuple(
                None
                if one is None
                else (
                    (instant_ns - one.first_ns) / NS_PER_MS,
                    (instant_ns - one.last_ns) / NS_PER_MS,
                )
                for one in members
            )
            shared_ms = best.apart_ms[number] if best.apart_ms else None
            sets.append(InstantSet(name, ages_ms, cloud, spot_ms, shared_ms))
        spot = None
        if best.place is not None:
            place = best.place
            spot = Spot(place.centre_m, RADIUS_M, place.unmatched, place.points)
        own = best.window.columns.sensor
        return SharedInstant(
            at_s=(instant_ns - self._first_ns) / NS_PER_S,
            looked=self._looked,
            sensors=tuple(sensor.name for sensor in self._sensors),
            poses=tuple(sensor.body_from_sensor for sensor in self._sensors),
            period_ns=self._period_ns,
            columns=np.bincount(own, minlength=sensors),
            sets=tuple(sets),
            shown=best.shown,
            spot=spot,
            why=self._why,
        )

    # -- an instant ---------------------------------------------------------------------------

    def _look(self, window: Window, *, is_asked: bool) -> None:
        """Compare the sets of the end of a window, if it is due or its sets are longer than any."""
        members = self._members(window)
        if len(members) < 2:
            return
        longest_ns = max(_last_ns(one) - _first_ns(one) for _, one in members)
        is_longer = longest_ns > self._longest_ns + _LONGER_NS
        self._count += 1
        if self._count % self._step and not is_longer and not is_asked:
            return
        self._looked += 1
        if self._looked % _INSTANTS == 0:
            self._step *= 2
        if self._why:
            # By times alone.
            if is_longer:
                self._best = _Best(window, members, 0, None, [], [])
        else:
            best = self._compared(window, members)
            if self._best is None or best.score > self._best.score:
                self._best = best
        self._longest_ns = max(self._longest_ns, longest_ns)

    def _members(self, window: Window) -> list[tuple[str, SweepSet]]:
        """Distinct sets whose last column is nearest to the end of a window, then the window."""
        found: dict[SweepSet, list[str]] = {}
        for name, sets in zip(self._names, self._sets, strict=False):
            nearest = min(sets, key=lambda one: abs(_last_ns(one) - window.end_ns), default=None)
            if nearest is None or abs(_last_ns(nearest) - window.end_ns) > self._period_ns:
                continue
            newest_ns = max(one.first_ns for one in nearest if one is not None)
            kept = tuple(
                one if one is not None and one.first_ns >= newest_ns - MOST_AGE_NS else None
                for one in nearest
            )
            found.setdefault(kept, []).append(name)
        sets_found = [(", ".join(names), members) for members, names in found.items()]
        return [
            *sets_found,
            (self._names[-1], sweeps_of(window.columns, len(self._sensors), window.end_ns)),
        ]

    def _compared(self, window: Window, members: list[tuple[str, SweepSet]]) -> _Best:
        columns = _joined([one.columns for one in self._windows])
        inside = [_inside(columns, one) for _, one in members]
        rows = np.flatnonzero(np.logical_or.reduce(inside))
        some = columns.take(rows)
        start_ns = int(some.stamp_ns[0])
        if self._decoder is None:
            self._decoder = self._new_decoder()
        scan = self._decoder.scan(some, ScanHeader(0, 0, start_ns, int(some.stamp_ns[-1]), True, 0))
        if scan.column is None:
            raise TypeError("expected scans with columns")
        time_ns = scan.time_ns.astype(np.int64) + (start_ns - window.end_ns)
        clouds = []
        for one in inside:
            kept = one[rows][scan.column]
            clouds.append(
                StoredScan(
                    where="",
                    start_ns=window.end_ns,
                    xyz=scan.xyz[kept],
                    organized=False,
                    intensity=scan.intensity[kept],
                    time_ns=time_ns[kept],
                    ring=scan.ring[kept],
                    lidar_id=scan.lidar_id[kept],
                )
            )
        points = list(map(_points, clouds))
        shown, place = 0, None
        for number, fused in enumerate(points[:-1]):
            other = difference(fused, points[-1], self._period_ns)
            if other is not None and (place is None or other.score > place.score):
                shown, place = number, other
        shared = [apart(one, one.cells(), self._period_ns).shared_ms() for one in points]
        return _Best(window, members, shown, place, clouds, shared)


def _inside(columns: WindowColumns, members: SweepSet) -> BoolArray:
    """Which columns are of a set, (n,)."""
    inside: BoolArray = np.zeros(len(columns), np.bool_)
    for one in members:
        if one is not None:
            stamp_ns = columns.stamp_ns
            inside |= (
                (columns.sensor == one.sensor)
                & (stamp_ns >= one.first_ns)
                & (stamp_ns <= one.last_ns)
            )
    return inside


def _joined(parts: Sequence[WindowColumns]) -> WindowColumns:
    names = ("stamp_ns", "sensor", "ring_index", "encoder")
    return WindowColumns(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
    )


def _points(cloud: StoredScan) -> Points:
    if cloud.lidar_id is None or cloud.time_ns is None:
        raise TypeError("expected points with times and lidars")
    return Points(cloud.xyz, cloud.lidar_id, cloud.time_ns)


def _first_ns(members: SweepSet) -> int:
    return min(one.first_ns for one in members if one is not None)


def _last_ns(members: SweepSet) -> int:
    return max(one.last_ns for one in members if one is not None)
