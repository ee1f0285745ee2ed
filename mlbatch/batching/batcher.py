"""The strategy of Faitli et al. (2025), section 2.1, over many packets at once.

The paper takes the smallest waiting stamp, converts, advances. Here a whole batch of packets is
judged by running maxima, columns wait as small records, and a stable sort of the stamps of a window
stands for the merge. `reference.py` is the same law in plain loops; tests compare the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import FOREVER, NEVER, Arrival, Delivery, Intake
from mlbatch.errors import ClockError
from mlbatch.types import BoolArray, Columns, I64Array
from mlbatch.units import NS_PER_MS, NS_PER_S

# A window closes this long after its end in stamps, so that packets swapped by the network count.
SLACK_NS = 10 * NS_PER_MS
COMPARABLE_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class Limit:
    """An end of `--start`/`--end`: a time, or (from_t_init) a time after t_init; int ns."""

    ns: int
    from_t_init: bool = False

    def at(self, t_init: int) -> int:
        """The limit as a time on the common clock."""
        return self.ns + t_init if self.from_t_init else self.ns


@dataclass(frozen=True, slots=True)
class Policy:
    """Options of the batching; max_wait_ns None waits for ever (the paper to the letter)."""

    max_wait_ns: int | None = NS_PER_S
    keep_partial: bool = False
    start: Limit | None = None
    end: Limit | None = None


@dataclass(slots=True)
class Window:
    """Columns of one window (or slice) of all sensors, by (stamp, sensor, arrival).

    stamp_ns, sensor, place, encoder: (n,) int64; `index` is -1 for the head.
    """

    index: int
    slice: int
    start_ns: int
    end_ns: int
    complete: bool
    ready_host_ns: int
    stamp_ns: I64Array
    sensor: I64Array
    place: I64Array
    encoder: I64Array


@dataclass(slots=True)
class _Track:
    """What is known of one sensor so far, and its columns that wait."""

    intake: Intake
    first_ns: int = NEVER
    newest_ns: int = NEVER
    offset_ns: int | None = None
    gaps: list[tuple[int, int]] = field(default_factory=list)
    waiting: list[Columns] = field(default_factory=list)
    decoded: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str, count: int) -> None:
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count


@dataclass(slots=True)
class _Progress:
    """State of all sensors after each delivery of a batch; newest (S, E) int64, the others (E,)."""

    newest: I64Array
    watermark: I64Array
    host_ns: I64Array


class Batcher:
    """Takes packets in arrival order, gives windows; one named object owns all state."""

    def __init__(self, grid: Grid, intakes: Sequence[Intake], policy: Policy) -> None:
        self.t_init_ns: int | None = None
        self.empty = 0
        self._grid = grid
        self._policy = policy
        self._tracks = [_Track(intake) for intake in intakes]
        self._watermark = NEVER
        self._first_window = 0
        self._seen_windows = 0
        self._last_window: int | None = None

    # -- what came in -------------------------------------------------------------------------

    def push(self, arrivals: Sequence[Arrival | None], host_ns: I64Array) -> Iterator[Window]:
        """Deliver a batch; yield every window that it closes.

        arrivals: one for each sensor; host_ns: (P,) arrival times of the whole batch, by position.
        """
        accepted = [
            None if arrival is None else track.intake.accept(arrival)
            for track, arrival in zip(self._tracks, arrivals, strict=True)
        ]
        events = [
            np.empty(0, np.int64) if delivery is None else delivery.packets.position
            for delivery in accepted
        ]
        order = np.argsort(np.concatenate(events), kind="stable")
        if not len(order):
            return
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        cuts = np.cumsum([len(event) for event in events])[:-1]
        ranks = np.split(rank, cuts)
        self._check_clocks(accepted, ranks)
        position = np.concatenate(events)[order]
        progress = self._advance(accepted, ranks, host_ns[position])
        before = np.concatenate([[self._watermark], progress.watermark[:-1]])
        for number, delivery in enumerate(accepted):
            if delivery is not None:
                self._wait(number, delivery.packets, before[ranks[number]])
        for number, track in enumerate(self._tracks):
            track.newest_ns = int(progress.newest[number, -1])
        self._watermark = int(progress.watermark[-1])
        yield from self._publish(progress)

    def finish(self, host_ns: int) -> Iterator[Window]:
        """End of input: close what is open; host_ns: arrival of the last packet."""
        for track in self._tracks:
            track.intake.finish()
        firsts = [track.first_ns for track in self._tracks if track.first_ns > NEVER]
        if not firsts:
            return
        if self.t_init_ns is None:
            self._start(max(firsts))
        self._watermark = FOREVER
        yield from self._publish(
            _Progress(
                np.array([[track.newest_ns] for track in self._tracks]),
                np.array([FOREVER]),
                np.array([host_ns]),
            ),
            last_of_all=max(track.newest_ns for track in self._tracks),
        )
        self._count_empty()

    # -- what became of it --------------------------------------------------------------------

    @property
    def rejected(self) -> list[dict[str, int]]:
        """Packets of each sensor that were turned away, by reason."""
        return [track.intake.rejected for track in self._tracks]

    @property
    def dropped(self) -> list[dict[str, int]]:
        """Columns of each sensor that reach no window, by reason."""
        return [track.dropped for track in self._tracks]

    @property
    def decoded(self) -> list[int]:
        """Columns of each sensor in accepted packets, valid or not."""
        return [track.decoded for track in self._tracks]

    @property
    def firsts(self) -> list[tuple[int, int] | None]:
        """First stamp of each sensor and the arrival of its packet; None if it gave none."""
        return [
            None if track.offset_ns is None else (track.first_ns, track.first_ns - track.offset_ns)
            for track in self._tracks
        ]

    def loss(self, sensor: int) -> tuple[int, int]:
        """Packets of a sensor that were lost, and that came out of order."""
        loss = self._tracks[sensor].intake.loss
        return loss.lost, loss.reordered

    @property
    def spans_ns(self) -> list[tuple[int, int] | None]:
        """First and newest stamp of each sensor; None if it gave none."""
        return [
            None if track.first_ns == NEVER else (track.first_ns, track.newest_ns)
            for track in self._tracks
        ]

    def oldest_place(self, sensor: int) -> int | None:
        """First ring place whose pixels are still needed; None: nothing waits."""
        track = self._tracks[sensor]
        places = [int(columns.place.min()) for columns in track.waiting if len(columns)]
        if track.intake.held_place is not None:
            places.append(track.intake.held_place)
        return min(places, default=None)

    @property
    def past_end(self) -> bool:
        """Whether `--end` was passed, so that nothing that comes can be written any more."""
        if self.t_init_ns is None or self._policy.end is None:
            return False
        # A window that begins before the end may reach past it by less than a period.
        end = self._policy.end.at(self.t_init_ns)
        return self._watermark >= self._grid.bound(self._grid.index_of(max(end, 0)) + 1)

    # -- steps --------------------------------------------------------------------------------

    def _check_clocks(self, accepted: Sequence[Delivery | None], ranks: Sequence[I64Array]) -> None:
        """As soon as two sensors have a packet, their stamps must be comparable."""
        firsts = []
        for number, (track, delivery) in enumerate(zip(self._tracks, accepted, strict=True)):
            if delivery is None or track.first_ns > NEVER:
                continue
            arrival = delivery.packets
            measured = np.flatnonzero(arrival.heads.valid.any(axis=1))
            if len(measured):
                row = int(measured[0])
                column = int(np.argmax(arrival.heads.valid[row]))
                track.first_ns = int(arrival.heads.stamp_ns[row, column])
                track.offset_ns = track.first_ns - int(arrival.host_ns[row])
                firsts.append((int(ranks[number][row]), number))
        for _, number in sorted(firsts):
            self._compare(number)

    def _compare(self, number: int) -> None:
        mine = self._tracks[number]
        for other, track in enumerate(self._tracks):
            if other == number or track.offset_ns is None or mine.offset_ns is None:
                continue
            apart = mine.offset_ns - track.offset_ns
            if abs(apart) > COMPARABLE_NS:
                raise ClockError(
                    f"clocks of the sensors cannot be compared: stamp minus arrival is "
                    f"{track.offset_ns / NS_PER_S:+.3f} s for {track.intake.name} and "
                    f"{mine.offset_ns / NS_PER_S:+.3f} s for {mine.intake.name}, "
                    f"{abs(apart) / NS_PER_S:.3f} s apart; wanted at most 1 s; "
                    "use --clock host, or give clock.offset_s in the rig"
                )

    def _advance(
        self, accepted: Sequence[Delivery | None], ranks: Sequence[I64Array], host_ns: I64Array
    ) -> _Progress:
        """Newest stamps and the watermark after each delivery; evaluates eq. (1)."""
        shape = (len(self._tracks), len(host_ns))
        newest, first = np.full(shape, NEVER), np.full(shape, FOREVER)
        for number, (track, delivery) in enumerate(zip(self._tracks, accepted, strict=True)):
            if delivery is not None:
                newest[number, ranks[number]] = delivery.newest_ns
            newest[number, 0] = max(newest[number, 0], track.newest_ns)
            np.maximum.accumulate(newest[number], out=newest[number])
            first[number, newest[number] > NEVER] = track.first_ns
        stalled = self._stalled(newest, first.min(axis=0))
        watermark = np.where(stalled, FOREVER, newest).min(axis=0) - SLACK_NS
        began = 0
        if self.t_init_ns is None:
            began = self._begin(newest > NEVER, stalled)
        watermark[:began] = NEVER
        watermark[0] = max(watermark[0], self._watermark)
        np.maximum.accumulate(watermark, out=watermark)
        return _Progress(newest, watermark, host_ns)

    def _stalled(self, newest: I64Array, first_of_all: I64Array) -> BoolArray:
        """Which sensors are not waited for, after each delivery: (S, E)."""
        if self._policy.max_wait_ns is None:
            return np.zeros(newest.shape, bool)
        leading = newest.max(axis=0)
        own = np.where(newest > NEVER, newest, first_of_all)
        behind: BoolArray = np.greater(leading - own, self._policy.max_wait_ns)
        behind &= leading > NEVER
        return behind

    def _begin(self, present: BoolArray, stalled: BoolArray) -> int:
        """Evaluate eq. (1) at the first delivery that allows it; its number, or past the end."""
        ready: BoolArray = np.logical_and((present | stalled).all(axis=0), present.any(axis=0))
        if not ready.any():
            return len(ready)
        at = int(np.argmax(ready))
        live = present[:, at] & ~stalled[:, at]
        self._start(
            max(track.first_ns for track, use in zip(self._tracks, live, strict=True) if use)
        )
        return at

    def _start(self, t0max_ns: int) -> None:
        self._first_window = self._grid.first_window(t0max_ns)
        self.t_init_ns = self._grid.bound(self._first_window * self._grid.slices)

    def _wait(self, number: int, arrival: Arrival, published: I64Array) -> None:
        """Queue the valid columns of a sensor, except late ones; published: watermarks before."""
        track, heads = self._tracks[number], arrival.heads
        valid = heads.valid.reshape(-1)
        count = int(np.count_nonzero(valid))
        track.decoded += len(valid)
        track.drop("invalid", len(valid) - count)
        if not count:
            return
        place = arrival.place[:, None] + np.arange(heads.valid.shape[1])
        columns = Columns(heads.stamp_ns.reshape(-1), place.reshape(-1), heads.encoder.reshape(-1))
        published = np.repeat(published, heads.valid.shape[1])
        if count < len(valid):
            columns, published = columns.take(valid), published[valid]
        stamp = columns.stamp_ns
        running = np.maximum.accumulate(np.concatenate([[track.newest_ns], stamp]))
        self._note_gaps(track, running)
        limit = np.maximum(running[:-1] - SLACK_NS, published)
        late = self._late(stamp, limit)
        if late.any():
            track.drop("late", int(np.count_nonzero(late)))
            columns = columns.take(~late)
        track.waiting.append(columns)

    def _note_gaps(self, track: _Track, running: I64Array) -> None:
        wait = self._policy.max_wait_ns
        if wait is None:
            return
        wide = np.flatnonzero((np.diff(running) > wait) & (running[:-1] > NEVER))
        track.gaps += [(int(running[at]), int(running[at + 1])) for at in wide]

    def _late(self, stamp: I64Array, limit: I64Array) -> BoolArray:
        """Which columns come after the end of their window was passed: (n,) bool."""
        late = np.less(stamp, limit)
        for at in np.flatnonzero(late).tolist():
            end = self._grid.bound(self._grid.index_of(int(stamp[at])) + 1)
            late[at] = end <= int(limit[at])
        return late

    # -- windows ------------------------------------------------------------------------------

    def _publish(self, progress: _Progress, last_of_all: int | None = None) -> Iterator[Window]:
        if self.t_init_ns is None:
            return
        until = FOREVER
        if last_of_all is None:
            if self._watermark <= 0:
                return
            until = self._grid.floor_bound(self._watermark)
        stamp, sensor, place, encoder = self._take_until(until)
        done = 0
        while done < len(stamp):
            window = self._grid.index_of(int(stamp[done]))
            start, end = self._grid.bound(window), self._grid.bound(window + 1)
            upto = int(np.searchsorted(stamp, end))
            closed_by = int(np.searchsorted(progress.watermark, end))
            part = slice(done, upto)
            done = upto
            self._note_window(window)
            reason = self._unwanted(window, start, end, last_of_all)
            if reason:
                self._drop(sensor[part], reason)
                continue
            yield Window(
                index=window // self._grid.slices - self._first_window,
                slice=window % self._grid.slices,
                start_ns=start,
                end_ns=end,
                complete=self._complete(progress, closed_by, start, end),
                ready_host_ns=int(progress.host_ns[closed_by]),
                stamp_ns=stamp[part],
                sensor=sensor[part],
                place=place[part],
                encoder=encoder[part],
            )
        for track in self._tracks:
            track.gaps = [gap for gap in track.gaps if gap[1] > until]

    def _take_until(self, until: int) -> tuple[I64Array, I64Array, I64Array, I64Array]:
        """Take waiting columns before `until`, merged: by stamp, then sensor, then arrival."""
        taken = []
        for track in self._tracks:
            columns = _chained(track.waiting)
            due = columns.stamp_ns < until
            taken.append(columns.take(due))
            track.waiting = [columns.take(~due)]
        merged = _chained(taken)
        sensor = np.repeat(np.arange(len(taken)), [len(columns) for columns in taken])
        order = np.argsort(merged.stamp_ns, kind="stable")
        return (
            merged.stamp_ns[order],
            sensor[order],
            merged.place[order],
            merged.encoder[order],
        )

    def _unwanted(self, window: int, start: int, end: int, last_of_all: int | None) -> str:
        """Why the columns of a window are dropped; empty if they are not."""
        index = window // self._grid.slices - self._first_window
        if index < -1:
            return "before_start"
        if not self._inside(index):
            return "outside_time"
        if index == -1:
            return "" if self._policy.keep_partial else "head"
        if last_of_all is not None and start <= last_of_all < end:
            return "" if self._policy.keep_partial else "tail"
        return ""

    def _inside(self, index: int) -> bool:
        """Whether the start of window `index` lies in [--start, --end)."""
        if self.t_init_ns is None:
            return False
        start = self._grid.bound((index + self._first_window) * self._grid.slices)
        low, high = self._policy.start, self._policy.end
        return (low is None or start >= low.at(self.t_init_ns)) and (
            high is None or start < high.at(self.t_init_ns)
        )

    def _complete(self, progress: _Progress, at: int, start: int, end: int) -> bool:
        """Every sensor began at or before the start and came past the end, and none stalled."""
        return bool((progress.newest[:, at] >= end).all()) and not any(
            track.first_ns > start
            or any(before < end and after > start for before, after in track.gaps)
            for track in self._tracks
        )

    def _drop(self, sensor: I64Array, reason: str) -> None:
        for number, count in enumerate(np.bincount(sensor, minlength=len(self._tracks))):
            self._tracks[number].drop(reason, int(count))

    def _note_window(self, window: int) -> None:
        index = window // self._grid.slices - self._first_window
        if index >= 0:
            self._last_window = window
            self._seen_windows += self._inside(index)

    def _count_empty(self) -> None:
        """Windows without a column between the first and the last, by subtraction."""
        if self._last_window is None or self.t_init_ns is None:
            return
        slices, first = self._grid.slices, self._first_window
        low, high = first, self._last_window // slices
        policy = self._policy
        if policy.start is not None:
            low = max(low, self._window_at_or_after(policy.start.at(self.t_init_ns)))
        begin, stop = low * slices, self._last_window + 1
        if policy.end is not None:
            high_end = self._window_at_or_after(policy.end.at(self.t_init_ns))
            if high_end <= high:
                stop = high_end * slices
        self.empty = max(0, stop - begin - self._seen_windows)

    def _window_at_or_after(self, time_ns: int) -> int:
        """First window whose start is at or after `time_ns`."""
        slices = self._grid.slices
        window = self._grid.index_of(max(time_ns, 0)) // slices
        return window if self._grid.bound(window * slices) >= time_ns else window + 1


def _chained(parts: Sequence[Columns]) -> Columns:
    if len(parts) == 1:
        return parts[0]
    if not parts:
        nothing = np.empty(0, np.int64)
        return Columns(nothing, nothing, nothing)
    return Columns(
        np.concatenate([part.stamp_ns for part in parts]),
        np.concatenate([part.place for part in parts]),
        np.concatenate([part.encoder for part in parts]),
    )
