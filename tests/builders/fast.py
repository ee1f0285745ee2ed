"""The fast batcher behind the face of the reference: same feed in, same `Outcome` out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import BoolArray
from mlbatch.batching.batcher import Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import Accepted, Arrival, Intake
from mlbatch.batching.windows import Limit, Policy
from mlbatch.types import Window as FastWindow
from tests.builders.arrivals import WIDEST, accepted_by, arrival_of
from tests.reference.batching import FeedPacket, Outcome, Settings, Window


class _Watched(Intake):
    """An intake that remembers which places it let in, in which order."""

    def __init__(self, name: str, width: int, *, host_clock: bool) -> None:
        super().__init__(name, np.arange(width), host_clock=host_clock)
        self.accepted: list[int] = []

    def accept(self, arrival: Arrival, owned: BoolArray) -> Accepted:
        accepted = super().accept(arrival, owned)
        self.accepted += accepted.ring_index[:, 0].tolist()
        return accepted


def run_fast(feed: Sequence[FeedPacket], settings: Settings, group_sizes: Sequence[int]) -> Outcome:
    """Push a feed in groups through the fast batcher."""
    width = max((len(packet.stamps) for packet in feed), default=1)
    intakes = [
        _Watched(str(sensor), width, host_clock=settings.host_clock)
        for sensor in range(settings.sensors)
    ]
    policy = Policy(
        settings.max_wait_ns,
        settings.keep_partial,
        None if settings.start_ns is None else Limit(settings.start_ns),
        None if settings.end_ns is None else Limit(settings.end_ns),
    )
    batcher = Batcher(Grid(settings.rate, settings.slices), intakes, policy)
    windows: list[FastWindow] = []
    seen = [0] * settings.sensors
    at = 0
    for size in group_sizes:
        group = feed[at : at + size]
        at += size
        host_ns = np.array([packet.host_ns for packet in group], np.int64)
        windows += batcher.push(_accepted(group, intakes, width, seen), host_ns)
    windows += batcher.finish(feed[-1].host_ns if feed else 0)
    outcome = Outcome(
        t_init_ns=batcher.t_init_ns,
        windows=[_window(window, intakes) for window in windows],
        rejected=[dict(counts) for counts in batcher.rejected],
        dropped=[dict(counts) for counts in batcher.dropped],
        decoded=list(batcher.decoded),
        written=_written(windows, settings.sensors),
        empty=batcher.empty,
        incomplete=sum(not window.complete for window in windows),
    )
    for number, intake in enumerate(intakes):
        own = [packet for packet in feed if packet.sensor == number]
        added = sum(width - len(own[place // WIDEST].stamps) for place in intake.accepted)
        outcome.decoded[number] -= added
        invalid = outcome.dropped[number].pop("invalid", 0) - added
        outcome.dropped[number] |= {"invalid": invalid} if invalid else {}
    return outcome


def _accepted(
    group: Sequence[FeedPacket], intakes: Sequence[Intake], width: int, seen: list[int]
) -> list[Accepted | None]:
    accepted: list[Accepted | None] = []
    for sensor, intake in enumerate(intakes):
        position = np.array([at for at, one in enumerate(group) if one.sensor == sensor], np.int64)
        own = [group[at] for at in position.tolist()]
        arrival = arrival_of(own, width, position, seen[sensor])
        seen[sensor] += len(own)
        accepted.append(accepted_by(intake, arrival) if own else None)
    return accepted


def _window(window: FastWindow, intakes: Sequence[_Watched]) -> Window:
    rank = [{place: n for n, place in enumerate(intake.accepted)} for intake in intakes]
    columns = [
        (sensor, rank[sensor][place - place % WIDEST], place % WIDEST)
        for sensor, place in zip(
            window.columns.sensor.tolist(), window.columns.ring_index.tolist(), strict=True
        )
    ]
    return Window(
        window.index,
        window.slice,
        window.start_ns,
        window.end_ns,
        window.complete,
        window.ready_host_ns,
        columns,
    )


def _written(windows: Sequence[FastWindow], sensors: int) -> list[int]:
    counts = [np.bincount(window.columns.sensor, minlength=sensors) for window in windows]
    return [int(sum(count[s] for count in counts)) for s in range(sensors)]
