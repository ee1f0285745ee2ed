"""The strategy of Faitli et al. (2025), section 2.1, on batches of packets instead of columns.

The paper takes the smallest waiting stamp of all sensors, converts that column, advances. Here the
columns of a batch wait as small records, and a stable sort by stamp merges closed windows.
`tests/reference/batching.py` implements the same rules in plain loops; tests compare both.

Terms of event-time stream processing:
- t0: the first stamp of a sensor. Eq. (1) gives t_init, the start of the first window, from the
  largest t0 of the sensors.
- watermark: the smallest newest stamp of all sensors minus the allowed lateness. A window closes,
  and is published, once the watermark reaches its end.
- allowed lateness (SLACK_NS): how far stamps may be out of order, by packets that the network
  reordered.
- idle-source timeout (`Policy.max_wait_ns`, `--max-wait`): a sensor whose newest stamp is further
  behind the newest of all sensors is stalled, and the watermark ignores it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.fill import UNKNOWN_PACE, EdgeGaps, FillMeter, Pace
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import FOREVER, NEVER, STEP_NS, Accepted, Intake
from mlbatch.batching.merge import ColumnMerge
from mlbatch.batching.windows import Policy, Schedule
from mlbatch.clocks.compare import refuse_incomparable
from mlbatch.errors import ClockJump
from mlbatch.types import Columns, Window, WindowColumns, WindowFigures
from mlbatch.units import NS_PER_MS, NS_PER_S

# Allowed lateness.
SLACK_NS = 10 * NS_PER_MS
_NONE = np.empty(0, np.int64)


@dataclass(slots=True)
class Track:
    """State of one sensor."""

    intake: Intake
    first_ns: int = NEVER  # t0
    newest_ns: int = NEVER  # largest stamp delivered
    offset_ns: int | None = None  # first stamp minus its receive time
    # (begin, end) of steps longer than the idle-source timeout.
    gaps: list[tuple[int, int]] = field(default_factory=list)
    waiting: list[Columns] = field(default_factory=list)  # columns of windows that are open
    # Lower bound of the ring indices of all waiting columns.
    oldest_ring_index: int = FOREVER
    decoded: int = 0  # columns of accepted packets
    dropped: dict[str, int] = field(default_factory=dict)  # columns by reason

    def drop(self, reason: str, count: int) -> None:
        """Count columns that are written to no window."""
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count


class Progress(NamedTuple):
    """State before the first delivery of a batch, and after each of its E deliveries."""

    newest: I64Array  # (S, E + 1) int64, newest stamp of each sensor
    watermark: I64Array  # (E + 1,) int64
    host_ns: I64Array  # (E,) int64, receive time of each delivery


class Batcher:
    """Takes packets in order of receive time, yields windows; owns the state of all sensors."""

    def __init__(
        self,
        grid: Grid,
        intakes: Sequence[Intake],
        policy: Policy,
        paces: Sequence[Pace] = (),
        merge: ColumnMerge | None = None,
    ) -> None:
        """Arguments of a run.

        intakes: one per sensor; paces: one per sensor, or none where the rates are unknown; merge:
        shared with the fusion of sweeps, or None.
        """
        self._grid = grid
        self._policy = policy
        self._schedule = Schedule(grid, policy)
        self._tracks = [Track(intake) for intake in intakes]
        self._watermark = NEVER
        # All columns before this stamp are published.
        self._until = NEVER
        # Partial windows with the reason to drop them, until one is whole; None: one was.
        self._partial: list[tuple[Window, str]] | None = [] if policy.partial_if_short else None
        # True once they were given instead of whole ones.
        self.gave_partial = False
        self._gaps = EdgeGaps(len(self._tracks))
        paces = paces or [UNKNOWN_PACE] * len(self._tracks)
        self._fill = FillMeter(paces)
        self._merge = merge or ColumnMerge([pace.positions for pace in paces])

    # -- main loop ----------------------------------------------------------------------------

    def push(self, accepted: Sequence[Accepted | None], host_ns: I64Array) -> Iterator[Window]:
        """Deliver a batch; yield every window that it closes.

        accepted: one per sensor; host_ns: (P,) receive times of the whole batch, by position.
        """
        self._refuse_jumps(accepted)
        ranks, position = ranked(accepted)
        if not len(position):
            return
        self._check_clocks(accepted, ranks)
        progress = self._advance(accepted, ranks, host_ns[position])
        for number, one in enumerate(accepted):
            if one is not None:
                self._enqueue(number, one, progress.watermark[:-1][ranks[number]])
        for track, newest_ns in zip(self._tracks, progress.newest[:, -1].tolist(), strict=True):
            track.newest_ns = newest_ns
        self._watermark = int(progress.watermark[-1])
        yield from self._publish(progress)

    def finish(self, host_ns: int) -> Iterator[Window]:
        """End of input: close all open windows; host_ns: receive time of the last packet."""
        for track in self._tracks:
            track.intake.finish()
        firsts = [track.first_ns for track in self._tracks if track.first_ns > NEVER]
        if not firsts:
            return
        if self.t_init_ns is None:
            self._begin_after(max(firsts))
        self._watermark = FOREVER
        last_ns = max(track.newest_ns for track in self._tracks)
        covered = self._policy.covered
        if covered is not None:
            last_ns = covered.end_ns
        yield from self._publish(
            Progress(
                np.array([[track.newest_ns] * 2 for track in self._tracks]),
                np.array([NEVER, FOREVER]),
                np.array([host_ns]),
            ),
            last_of_all=last_ns,
        )
        yield from self._short(min(firsts), last_ns)

    # -- state for reports and for the packet ring ----------------------------------------------

    @property
    def t_init_ns(self) -> int | None:
        """Start of the first window by eq. (1); None until it is known."""
        return self._schedule.t_init_ns

    @property
    def empty(self) -> int:
        """Windows without a column between the first and the last so far."""
        return self._schedule.empty

    @property
    def rejected(self) -> list[dict[str, int]]:
        """Rejected packets of each sensor, by reason."""
        return [track.intake.rejected for track in self._tracks]

    @property
    def renumbered(self) -> list[int]:
        """Duplicates of each sensor, by their number, whose timestamps are others."""
        return [track.intake.renumbered for track in self._tracks]

    @property
    def dropped(self) -> list[dict[str, int]]:
        """Columns of each sensor that are written to no window, by reason."""
        return [track.dropped for track in self._tracks]

    @property
    def decoded(self) -> list[int]:
        """Columns of each sensor in accepted packets, valid or not."""
        return [track.decoded for track in self._tracks]

    @property
    def firsts(self) -> list[tuple[int, int] | None]:
        """First stamp of each sensor and the receive time of its packet; None without a stamp."""
        return [
            None if track.offset_ns is None else (track.first_ns, track.first_ns - track.offset_ns)
            for track in self._tracks
        ]

    def host_offset_ns(self, sensor: int) -> int | None:
        """First stamp of a sensor minus the receive time of its packet; None without a stamp."""
        return self._tracks[sensor].offset_ns

    def loss(self, sensor: int) -> tuple[int, int]:
        """Lost and reordered packets of a sensor."""
        loss = self._tracks[sensor].intake.loss
        return loss.lost, loss.reordered

    @property
    def spans_ns(self) -> list[tuple[int, int] | None]:
        """First and newest stamp of each sensor; None without a stamp."""
        return [
            None if track.first_ns == NEVER else (track.first_ns, track.newest_ns)
            for track in self._tracks
        ]

    def oldest_ring_index(self, sensor: int) -> int | None:
        """First ring index whose pixels are still needed; None if no column waits."""
        track = self._tracks[sensor]
        held = track.intake.held_ring_index
        oldest = track.oldest_ring_index if held is None else min(track.oldest_ring_index, held)
        for window, _ in self._partial or ():
            own = window.columns.ring_index[window.columns.sensor == sensor]
            oldest = min(oldest, int(own.min(initial=FOREVER)))
        return None if oldest == FOREVER else oldest

    @property
    def limits_ns(self) -> tuple[int | None, int | None]:
        """`--start` and `--end` on the common clock; None: not given, or not known yet."""
        return self._schedule.limits_ns

    @property
    def past_end(self) -> bool:
        """True once `--end` is passed, so that no later packet can be written."""
        return self._schedule.is_past_end(self._watermark)

    # -- step 1: accept packets ---------------------------------------------------------------

    def _refuse_jumps(self, accepted: Sequence[Accepted | None]) -> None:
        """Raise ClockJump where clocks jump.

        If several clocks jump together, the recording is cut at the first packet after any of the
        jumps, including a packet that is held for confirmation. Otherwise the cut would depend on
        how packets are grouped into batches.
        """
        jumps = [one.jump for one in accepted if one is not None and one.jump is not None]
        if jumps:
            first = min(jumps, key=lambda jump: jump.host_ns)
            held_ns = [track.intake.held_host_ns for track in self._tracks]
            near_ns = [at for at in held_ns if at is not None and first.host_ns - at <= STEP_NS]
            raise ClockJump(str(first), min([first.host_ns, *near_ns]))

    def _check_clocks(self, accepted: Sequence[Accepted | None], ranks: Sequence[I64Array]) -> None:
        """Record first stamps; ClockError if two sensors are not comparable."""
        firsts = []
        for number, (track, one) in enumerate(zip(self._tracks, accepted, strict=True)):
            if one is None or track.first_ns > NEVER:
                continue
            measured = np.flatnonzero(one.newest_ns > NEVER)
            if len(measured):
                row = int(measured[0])
                column = int(np.argmax(one.columns.valid[row]))
                track.first_ns = int(one.columns.stamp_ns[row, column])
                track.offset_ns = track.first_ns - int(one.host_ns[row])
                firsts.append((int(ranks[number][row]), number))
        for _, number in sorted(firsts):
            refuse_incomparable(
                [(track.intake.name, track.offset_ns) for track in self._tracks],
                number,
                has_receive_times=all(track.intake.has_receive_times for track in self._tracks),
            )

    # -- step 2: newest stamps, eq. (1), watermark ----------------------------------------------

    def _advance(
        self, accepted: Sequence[Accepted | None], ranks: Sequence[I64Array], host_ns: I64Array
    ) -> Progress:
        """Newest stamps and watermark before and after each delivery; evaluates eq. (1)."""
        newest = np.full((len(self._tracks), len(host_ns) + 1), NEVER)
        for number, (track, one) in enumerate(zip(self._tracks, accepted, strict=True)):
            newest[number, 0] = track.newest_ns
            if one is not None:
                newest[number, 1:][ranks[number]] = one.newest_ns
        np.maximum.accumulate(newest, axis=1, out=newest)
        stalled = self._stalled(newest)
        live = newest if stalled is None else np.where(stalled, FOREVER, newest)
        watermark: I64Array = live.min(axis=0) - SLACK_NS
        began = 1
        if self.t_init_ns is None:
            began += self._begin(newest[:, 1:], None if stalled is None else stalled[:, 1:])
        watermark[:began] = self._watermark
        np.maximum.accumulate(watermark, out=watermark)
        return Progress(newest, watermark, host_ns)

    def _stalled(self, newest: I64Array) -> BoolArray | None:
        """Mask (S, E + 1) of sensors past the idle-source timeout; None if there are none."""
        wait_ns = self._policy.max_wait_ns
        if wait_ns is None:
            return None
        # The largest distance possible in this batch; the usual case ends here.
        before_ns = min(track.newest_ns for track in self._tracks)
        if before_ns > NEVER and max(newest[:, -1].tolist()) - before_ns <= wait_ns:
            return None
        leading = newest.max(axis=0)
        present = newest > NEVER
        first_ns = np.array([[track.first_ns] for track in self._tracks])
        first_of_all = np.where(present, first_ns, FOREVER).min(axis=0)
        behind: BoolArray = np.greater(leading - np.where(present, newest, first_of_all), wait_ns)
        behind &= leading > NEVER
        return behind

    def _begin(self, newest: I64Array, stalled: BoolArray | None) -> int:
        """Evaluate eq. (1) at the first delivery where every sensor has a stamp or is stalled.

        Returns the number of that delivery, or the number of all deliveries if there is none.
        """
        present = newest > NEVER
        away = np.zeros_like(present) if stalled is None else stalled
        ready: BoolArray = np.logical_and((present | away).all(axis=0), present.any(axis=0))
        if not ready.any():
            return len(ready)
        at = int(np.argmax(ready))
        live = present[:, at] & ~away[:, at]
        self._begin_after(
            max(track.first_ns for track, use in zip(self._tracks, live, strict=True) if use)
        )
        return at

    def _begin_after(self, t0max_ns: int) -> None:
        """Evaluate eq. (1); scans that are batched again have no window before their first one."""
        covered = self._policy.covered
        self._schedule.begin(t0max_ns if covered is None else covered.begin_ns - 1)

    # -- step 3: enqueue columns --------------------------------------------------------------

    def _enqueue(self, number: int, accepted: Accepted, published: I64Array) -> None:
        """Queue the valid columns of a sensor that are not late.

        published: (A,) watermark before each packet.
        """
        track = self._tracks[number]
        valid = accepted.columns.valid
        track.decoded += valid.size
        track.drop("invalid", accepted.invalid)
        columns = Columns(
            accepted.columns.stamp_ns.reshape(-1),
            accepted.ring_index.reshape(-1),
            accepted.columns.encoder.reshape(-1),
        )
        if accepted.invalid:
            columns = columns.take(valid.reshape(-1))
        wait_ns = self._policy.max_wait_ns
        has_gap = wait_ns is not None and accepted.ahead_ns > wait_ns
        may_be_late = accepted.behind_ns > SLACK_NS or bool((accepted.lowest_ns < published).any())
        if has_gap or may_be_late:
            published = published.repeat(valid.shape[1])[valid.reshape(-1)]
            columns = self._without_late(track, columns, published)
        if len(columns):
            track.waiting.append(columns)
            track.oldest_ring_index = min(track.oldest_ring_index, accepted.oldest)

    def _without_late(self, track: Track, columns: Columns, published: I64Array) -> Columns:
        """The columns that are not late; published: (n,) watermark before each column."""
        running = np.empty(len(columns) + 1, np.int64)
        running[0] = track.newest_ns
        running[1:] = columns.stamp_ns
        np.maximum.accumulate(running, out=running)
        self._record_gaps(track, running)
        late = self._late(columns.stamp_ns, np.maximum(running[:-1] - SLACK_NS, published))
        if not late.any():
            return columns
        track.drop("late", int(np.count_nonzero(late)))
        return columns.take(~late)

    def _record_gaps(self, track: Track, running: I64Array) -> None:
        """Record steps of a running maximum of stamps that exceed the idle-source timeout."""
        wait_ns = self._policy.max_wait_ns
        # No step is wider than all of them together.
        if wait_ns is None or int(running[-1]) - int(running[0]) <= wait_ns:
            return
        steps = running[1:] - running[:-1]
        wide = np.flatnonzero((steps > wait_ns) & (running[:-1] > NEVER))
        track.gaps += [(int(running[at]), int(running[at + 1])) for at in wide]

    def _late(self, stamp: I64Array, limit: I64Array) -> BoolArray:
        """Mask (n,) of columns whose window ends at or before the limit of the column."""
        late = np.less(stamp, limit)
        for at in np.flatnonzero(late).tolist():
            end = self._grid.bound(self._grid.index_of(int(stamp[at])) + 1)
            late[at] = end <= int(limit[at])
        return late

    # -- step 4: publish windows --------------------------------------------------------------

    def _publish(self, progress: Progress, last_of_all: int | None = None) -> list[Window]:
        """Return the windows that the watermark has passed; last_of_all: as in Schedule.enter.

        All at once: between the decoding of two, none of this would still be in the cache.
        """
        if self.t_init_ns is None:
            return []
        until = FOREVER
        if last_of_all is None:
            if self._watermark <= 0:
                return []
            until = self._grid.floor_bound(self._watermark)
        if until <= self._until:
            return []
        self._until = until
        covered = self._policy.covered
        merged = self._take_until(until)
        cuts = self._cuts(merged.stamp_ns)
        figures = self._merge.figures(merged, [stop for _, stop, _ in cuts])
        # By window: the delivery that closed it, and up to where all sensors were by then.
        closed_by = progress.watermark.searchsorted(np.array([end for *_, end in cuts], np.int64))
        reached_ns = progress.newest[:, closed_by].min(axis=0).tolist()
        ready_ns = progress.host_ns[closed_by - 1].tolist()
        windows = []
        begin = 0
        for (window, stop, end), own, reached, ready in zip(
            cuts, figures, reached_ns, ready_ns, strict=True
        ):
            start = self._grid.bound(window)
            columns = merged.take(slice(begin, stop))
            begin = stop
            # Also of windows that are dropped: later ones must not depend on options.
            gaps_ns = self._gaps.measure(start, end, own)
            fill = self._fill.measure(end - start, own, columns)
            reason = self._schedule.enter(window, last_of_all)
            is_kept = self._partial is not None and reason in ("head", "tail")
            if reason and not is_kept:
                self._drop(own, reason)
                continue
            one = Window(
                index=self._schedule.index_of(window),
                slice=window % self._grid.slices,
                start_ns=start,
                end_ns=end,
                complete=(reached >= end and self._is_covered(start, end))
                if covered is None
                else covered.is_complete(start, end),
                ready_host_ns=ready,
                columns=columns,
                figures=own,
                edge_gap_ns=gaps_ns,
                fill=fill,
                is_partial=self._schedule.is_partial(window, last_of_all),
            )
            if is_kept and self._partial is not None:
                self._partial.append((one, reason))
                continue
            self._drop_partial()
            windows.append(one)
        for track in self._tracks:
            if track.gaps:
                track.gaps = [gap for gap in track.gaps if gap[1] > until]
        return windows

    def _short(self, first_ns: int, last_ns: int) -> list[Window]:
        """The partial windows of an input of less than two windows, none of which is whole."""
        partial = self._partial
        if partial and (last_ns - first_ns) * self._grid.rate < 2 * NS_PER_S:
            self.gave_partial = True
            self._partial = None
            return [window for window, _ in partial]
        self._drop_partial()
        return []

    def _drop_partial(self) -> None:
        """Drop the partial windows that were kept."""
        for window, reason in self._partial or ():
            self._drop(window.figures, reason)
        self._partial = None

    def _take_until(self, until: int) -> WindowColumns:
        """Take the waiting columns before `until`, merged."""
        merged = self._merge.take_until([track.waiting for track in self._tracks], until)
        for track in self._tracks:
            oldest = (int(one.ring_index.min(initial=FOREVER)) for one in track.waiting)
            track.oldest_ring_index = min(oldest, default=FOREVER)
        return merged

    def _cuts(self, stamp_ns: I64Array) -> list[tuple[int, int, int]]:
        """Cut sorted stamps (n,) into windows: number, column after the last, end in ns of each."""
        cuts = []
        done = 0
        while done < len(stamp_ns):
            window = self._grid.index_of(int(stamp_ns[done]))
            end = self._grid.bound(window + 1)
            done = int(stamp_ns.searchsorted(end))
            cuts.append((window, done, end))
        return cuts

    def _is_covered(self, start: int, end: int) -> bool:
        """True if every sensor began by the start, and no stall overlaps."""
        for track in self._tracks:
            if track.first_ns > start:
                return False
            # Most sensors have none.
            if track.gaps and any(before < end and after > start for before, after in track.gaps):
                return False
        return True

    def _drop(self, figures: WindowFigures, reason: str) -> None:
        for track, own in zip(self._tracks, figures, strict=True):
            track.drop(reason, own.columns)


def ranked(accepted: Sequence[Accepted | None]) -> tuple[list[I64Array], I64Array]:
    """Order of delivery: per sensor the rank of each packet; and the positions of all, by rank."""
    events = [_NONE if one is None else one.position for one in accepted]
    delivering = [number for number, event in enumerate(events) if len(event)]
    if len(delivering) == 1:
        return [np.arange(len(event)) for event in events], events[delivering[0]]
    position = np.concatenate(events)
    order = position.argsort(kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    ranks = []
    begin = 0
    for event in events:
        ranks.append(rank[begin : begin + len(event)])
        begin += len(event)
    return ranks, position[order]
