"""The strategy of Faitli et al. (2025), section 2.1, over many packets at once.

The paper takes the smallest waiting stamp, converts, advances. Here a whole batch of packets is
judged by running maxima, columns wait as small records, and a stable sort of the stamps of a window
stands for the merge. `reference.py` is the same law in plain loops; tests compare the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import FOREVER, NEVER, STEP_NS, Accepted, Arrival, Intake, JumpGuard
from mlbatch.batching.windows import Policy, Schedule, Window
from mlbatch.clocks.compare import refuse_incomparable
from mlbatch.errors import ClockJump
from mlbatch.types import Columns
from mlbatch.units import NS_PER_MS

# A window closes this long after its end in stamps, so that packets swapped by the network count.
SLACK_NS = 10 * NS_PER_MS


class Batcher:
    """Takes packets in arrival order, gives windows; one named object owns all state."""

    def __init__(
        self,
        grid: Grid,
        intakes: Sequence[Intake],
        policy: Policy,
        guards: Sequence[JumpGuard] = (),
    ) -> None:
        """guards: one for each sensor whose clock must not jump; all or none."""
        self._grid = grid
        self._policy = policy
        self._schedule = Schedule(grid, policy)
        self._tracks = [Track(intake) for intake in intakes]
        self._watermark = NEVER
        # All that was waiting before this stamp was published.
        self._until = NEVER
        self._guards = tuple(guards)

    # -- what came in -------------------------------------------------------------------------

    def push(self, arrivals: Sequence[Arrival | None], host_ns: I64Array) -> Iterator[Window]:
        """Deliver a batch; yield every window that it closes.

        arrivals: one for each sensor; host_ns: (P,) arrival times of the whole batch, by position.
        """
        accepted = self._accept(arrivals)
        ranks, position = ranked(accepted)
        if not len(position):
            return
        self._check_clocks(accepted, ranks)
        progress = self._advance(accepted, ranks, host_ns[position])
        for number, delivery in enumerate(accepted):
            if delivery is not None:
                self._wait(number, delivery.packets, progress.watermark[:-1][ranks[number]])
        for track, newest_ns in zip(self._tracks, progress.newest[:, -1].tolist(), strict=True):
            track.newest_ns = newest_ns
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
            self._schedule.begin(max(firsts))
        self._watermark = FOREVER
        yield from self._publish(
            Progress(
                np.array([[track.newest_ns] * 2 for track in self._tracks]),
                np.array([NEVER, FOREVER]),
                np.array([host_ns]),
            ),
            last_of_all=max(track.newest_ns for track in self._tracks),
        )

    # -- what became of it --------------------------------------------------------------------

    @property
    def t_init_ns(self) -> int | None:
        """Eq. (1): start of the first window; None as long as it is not known."""
        return self._schedule.t_init_ns

    @property
    def empty(self) -> int:
        """Windows without a column between the first and the last so far."""
        return self._schedule.empty

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
        held = track.intake.held_place
        oldest = track.oldest_place if held is None else min(track.oldest_place, held)
        return None if oldest == FOREVER else oldest

    @property
    def limits_ns(self) -> tuple[int | None, int | None]:
        """`--start` and `--end` on the common clock; None: none, or not known yet."""
        return self._schedule.limits_ns

    @property
    def past_end(self) -> bool:
        """Whether `--end` was passed, so that nothing that comes can be written any more."""
        return self._schedule.is_past_end(self._watermark)

    # -- steps --------------------------------------------------------------------------------

    def _accept(self, arrivals: Sequence[Arrival | None]) -> list[Accepted | None]:
        """What the sensors' doors let in; ClockJump where clocks jump.

        Clocks that jump together are cut at the first packet of any of them, also of one whose
        next packet is not here yet: else it would depend on the batch where a recording is cut.
        """
        accepted: list[Accepted | None] = []
        jumps: list[ClockJump] = []
        for number, (track, arrival) in enumerate(zip(self._tracks, arrivals, strict=True)):
            delivery = None
            try:
                if arrival is not None:
                    delivery = track.intake.accept(arrival)
                    for guard in self._guards[number : number + 1]:
                        guard.check(delivery)
            except ClockJump as jump:
                jumps.append(jump)
            accepted.append(delivery)
        if jumps:
            first = min(jumps, key=lambda jump: jump.host_ns)
            held_ns = [track.intake.held_host_ns for track in self._tracks]
            near_ns = [at for at in held_ns if at is not None and first.host_ns - at <= STEP_NS]
            raise ClockJump(str(first), min([first.host_ns, *near_ns]))
        return accepted

    def _check_clocks(self, accepted: Sequence[Accepted | None], ranks: Sequence[I64Array]) -> None:
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
            refuse_incomparable(
                [(track.intake.name, track.offset_ns) for track in self._tracks], number
            )

    def _advance(
        self, accepted: Sequence[Accepted | None], ranks: Sequence[I64Array], host_ns: I64Array
    ) -> Progress:
        """Newest stamps and the watermark before and after each delivery; evaluates eq. (1)."""
        newest = np.full((len(self._tracks), len(host_ns) + 1), NEVER)
        for number, (track, delivery) in enumerate(zip(self._tracks, accepted, strict=True)):
            newest[number, 0] = track.newest_ns
            if delivery is not None:
                newest[number, 1:][ranks[number]] = delivery.newest_ns
        np.maximum.accumulate(newest, axis=1, out=newest)
        stalled = self._stalled(newest)
        waited = newest if stalled is None else np.where(stalled, FOREVER, newest)
        watermark: I64Array = waited.min(axis=0) - SLACK_NS
        began = 1
        if self.t_init_ns is None:
            began += self._begin(newest[:, 1:], None if stalled is None else stalled[:, 1:])
        watermark[:began] = self._watermark
        np.maximum.accumulate(watermark, out=watermark)
        return Progress(newest, watermark, host_ns)

    def _stalled(self, newest: I64Array) -> BoolArray | None:
        """Which sensors are not waited for, (S, E + 1); None: all are."""
        wait_ns = self._policy.max_wait_ns
        if wait_ns is None:
            return None
        # What was never further apart than from the first of these to the last is not told apart.
        before_ns = min(track.newest_ns for track in self._tracks)
        if before_ns > NEVER and int(newest[:, -1].max()) - before_ns <= wait_ns:
            return None
        leading = newest.max(axis=0)
        present = newest > NEVER
        first_ns = np.array([[track.first_ns] for track in self._tracks])
        first_of_all = np.where(present, first_ns, FOREVER).min(axis=0)
        behind: BoolArray = np.greater(leading - np.where(present, newest, first_of_all), wait_ns)
        behind &= leading > NEVER
        return behind

    def _begin(self, newest: I64Array, stalled: BoolArray | None) -> int:
        """Evaluate eq. (1) at the first delivery that allows it; its number, or past the end."""
        present = newest > NEVER
        away = np.zeros_like(present) if stalled is None else stalled
        ready: BoolArray = np.logical_and((present | away).all(axis=0), present.any(axis=0))
        if not ready.any():
            return len(ready)
        at = int(np.argmax(ready))
        live = present[:, at] & ~away[:, at]
        self._schedule.begin(
            max(track.first_ns for track, use in zip(self._tracks, live, strict=True) if use)
        )
        return at

    def _wait(self, number: int, arrival: Arrival, published: I64Array) -> None:
        """Queue the valid columns of a sensor, except late ones; published: watermarks before."""
        track, heads = self._tracks[number], arrival.heads
        valid = heads.valid.reshape(-1)
        count = int(np.count_nonzero(valid))
        track.decoded += len(valid)
        track.drop("invalid", len(valid) - count)
        if not count:
            return
        per_packet = heads.valid.shape[1]
        place = arrival.place[:, None] + np.arange(per_packet)
        columns = Columns(heads.stamp_ns.reshape(-1), place.reshape(-1), heads.encoder.reshape(-1))
        published = published.repeat(per_packet)
        if count < len(valid):
            columns, published = columns.take(valid), published[valid]
        if not self._goes_on(track, columns.stamp_ns, int(published[-1])):
            columns = self._without_late(track, columns, published)
        if len(columns):
            track.waiting.append(columns)
            track.oldest_place = min(track.oldest_place, int(columns.place.min()))

    def _goes_on(self, track: Track, stamp: I64Array, published: int) -> bool:
        """Whether, as in nearly all small batches, no column can be late, and none ends a gap."""
        newest, wait_ns = max(track.newest_ns, int(stamp.max())), self._policy.max_wait_ns
        is_near = wait_ns is None or newest - track.newest_ns <= wait_ns
        return is_near and int(stamp.min()) >= max(newest - SLACK_NS, published)

    def _without_late(self, track: Track, columns: Columns, published: I64Array) -> Columns:
        """The columns that are not late; published: (n,) watermark before each of them."""
        running = np.empty(len(columns) + 1, np.int64)
        running[0], running[1:] = track.newest_ns, columns.stamp_ns
        np.maximum.accumulate(running, out=running)
        self._note_gaps(track, running)
        late = self._late(columns.stamp_ns, np.maximum(running[:-1] - SLACK_NS, published))
        if not late.any():
            return columns
        track.drop("late", int(np.count_nonzero(late)))
        return columns.take(~late)

    def _note_gaps(self, track: Track, running: I64Array) -> None:
        wait_ns = self._policy.max_wait_ns
        # Stamps that never step back span at least their widest step.
        if wait_ns is None or int(running[-1]) - int(running[0]) <= wait_ns:
            return
        steps = running[1:] - running[:-1]
        wide = np.flatnonzero((steps > wait_ns) & (running[:-1] > NEVER))
        track.gaps += [(int(running[at]), int(running[at + 1])) for at in wide]

    def _late(self, stamp: I64Array, limit: I64Array) -> BoolArray:
        """Which columns come after the end of their window was passed: (n,) bool."""
        late = np.less(stamp, limit)
        for at in np.flatnonzero(late).tolist():
            end = self._grid.bound(self._grid.index_of(int(stamp[at])) + 1)
            late[at] = end <= int(limit[at])
        return late

    # -- windows ------------------------------------------------------------------------------

    def _publish(self, progress: Progress, last_of_all: int | None = None) -> Iterator[Window]:
        if self.t_init_ns is None:
            return
        until = FOREVER
        if last_of_all is None:
            if self._watermark <= 0:
                return
            until = self._grid.floor_bound(self._watermark)
        if until <= self._until:
            return
        self._until = until
        stamp, sensor, place, encoder = self._take_until(until)
        done = 0
        while done < len(stamp):
            window = self._grid.index_of(int(stamp[done]))
            start, end = self._grid.bound(window), self._grid.bound(window + 1)
            upto = int(np.searchsorted(stamp, end))
            closed_by = int(np.searchsorted(progress.watermark, end))
            part = slice(done, upto)
            done = upto
            reason = self._schedule.enter(window, last_of_all)
            if reason:
                self._drop(sensor[part], reason)
                continue
            yield Window(
                index=self._schedule.index_of(window),
                slice=window % self._grid.slices,
                start_ns=start,
                end_ns=end,
                complete=self._complete(progress, closed_by, start, end),
                ready_host_ns=int(progress.host_ns[closed_by - 1]),
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
            due, left = parted(chained(track.waiting), until)
            taken.append(due)
            track.waiting = [left] if len(left) else []
            track.oldest_place = int(left.place.min(initial=FOREVER))
        merged = chained(taken)
        sensor = np.arange(len(taken)).repeat([len(columns) for columns in taken])
        order = merged.stamp_ns.argsort(kind="stable")
        return (
            merged.stamp_ns[order],
            sensor[order],
            merged.place[order],
            merged.encoder[order],
        )

    def _complete(self, progress: Progress, at: int, start: int, end: int) -> bool:
        """Every sensor began at or before the start and came past the end, and none stalled."""
        return bool((progress.newest[:, at] >= end).all()) and not any(
            track.first_ns > start
            or any(before < end and after > start for before, after in track.gaps)
            for track in self._tracks
        )

    def _drop(self, sensor: I64Array, reason: str) -> None:
        for number, count in enumerate(np.bincount(sensor, minlength=len(self._tracks))):
            self._tracks[number].drop(reason, int(count))


# What the batching knows of each sensor, and of all of them over the deliveries of a batch.

_NONE = np.empty(0, np.int64)


@dataclass(slots=True)
class Track:
    """What is known of one sensor so far, and its columns that wait."""

    intake: Intake
    first_ns: int = NEVER
    newest_ns: int = NEVER
    offset_ns: int | None = None
    gaps: list[tuple[int, int]] = field(default_factory=list)
    waiting: list[Columns] = field(default_factory=list)
    # No column that waits has a smaller place.
    oldest_place: int = FOREVER
    decoded: int = 0
    dropped: dict[str, int] = field(default_factory=dict)

    def drop(self, reason: str, count: int) -> None:
        """Count columns that reach no window."""
        if count:
            self.dropped[reason] = self.dropped.get(reason, 0) + count


@dataclass(slots=True)
class Progress:
    """State before the first delivery of a batch and after each of its E deliveries.

    newest: (S, E + 1) int64; watermark: (E + 1,); host_ns: (E,), arrival of each delivery.
    """

    newest: I64Array
    watermark: I64Array
    host_ns: I64Array


def ranked(accepted: Sequence[Accepted | None]) -> tuple[list[I64Array], I64Array]:
    """Of each sensor, the number of each of its packets among all; positions of these, in order."""
    events = [_NONE if delivery is None else delivery.packets.position for delivery in accepted]
    delivering = [number for number, event in enumerate(events) if len(event)]
    if len(delivering) == 1:
        ranks: list[I64Array] = [np.arange(len(event)) for event in events]
        return ranks, events[delivering[0]]
    position = np.concatenate(events)
    order = position.argsort(kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    cuts = np.cumsum([len(event) for event in events])[:-1]
    return np.split(rank, cuts), position[order]


def parted(columns: Columns, until: int) -> tuple[Columns, Columns]:
    """Columns with stamps before `until`, and the others; each in their order."""
    stamp = columns.stamp_ns
    if bool((stamp[1:] >= stamp[:-1]).all()):
        at = int(stamp.searchsorted(until))
        return columns.take(slice(None, at)), columns.take(slice(at, None))
    due = stamp < until
    return columns.take(due), columns.take(~due)


def chained(parts: Sequence[Columns]) -> Columns:
    """Columns one after the other."""
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
