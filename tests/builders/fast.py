"""The fast batcher behind the face of the reference: same feed in, same `Outcome` out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mlbatch.batching.batcher import Batcher
from mlbatch.batching.grid import Grid
from mlbatch.batching.intake import Accepted, Arrival, Intake
from mlbatch.batching.windows import Limit, Policy
from mlbatch.batching.windows import Window as FastWindow
from mlbatch.types import ColumnHeaders
from tests.reference.batching import FeedPacket, Outcome, Settings, Window


class _Watched(Intake):
    """An intake that remembers which places it let in, in which order."""

    def __init__(self, name: str, *, host_clock: bool) -> None:
        super().__init__(name, host_clock=host_clock)
        self.accepted: list[int] = []

    def accept(self, arrival: Arrival) -> Accepted:
        accepted = super().accept(arrival)
        self.accepted += accepted.packets.ring_index.tolist()
        return accepted


def run_fast(feed: Sequence[FeedPacket], settings: Settings, group_sizes: Sequence[int]) -> Outcome:
    """Push a feed in groups through the fast batcher."""
    intakes = [_Watched(str(s), host_clock=settings.host_clock) for s in range(settings.sensors)]
    policy = Policy(
        settings.max_wait_ns,
        settings.keep_partial,
        None if settings.start_ns is None else Limit(settings.start_ns),
        None if settings.end_ns is None else Limit(settings.end_ns),
    )
    batcher = Batcher(Grid(settings.rate, settings.slices), intakes, policy)
    windows: list[FastWindow] = []
    # A packet's place is its number among all of its sensor, times more than any packet's width.
    seen = [0] * settings.sensors
    at = 0
    for size in group_sizes:
        group = feed[at : at + size]
        at += size
        host_ns = np.array([packet.host_ns for packet in group], np.int64)
        windows += batcher.push(_arrivals(group, settings.sensors, seen), host_ns)
    windows += batcher.finish(feed[-1].host_ns if feed else 0)
    return Outcome(
        t_init_ns=batcher.t_init_ns,
        windows=[_window(window, intakes) for window in windows],
        rejected=[dict(counts) for counts in batcher.rejected],
        dropped=[dict(counts) for counts in batcher.dropped],
        decoded=list(batcher.decoded),
        written=_written(windows, settings.sensors),
        empty=batcher.empty,
        incomplete=sum(not window.complete for window in windows),
    )


_WIDEST = 64


def _arrivals(group: Sequence[FeedPacket], sensors: int, seen: list[int]) -> list[Arrival | None]:
    arrivals: list[Arrival | None] = []
    for sensor in range(sensors):
        own = [(at, packet) for at, packet in enumerate(group) if packet.sensor == sensor]
        if not own:
            arrivals.append(None)
            continue
        stamps = np.array([packet.stamps for _, packet in own], np.int64)
        headers = ColumnHeaders(
            stamps, np.zeros_like(stamps), np.array([packet.valid for _, packet in own], bool)
        )
        first = seen[sensor]
        seen[sensor] += len(own)
        arrivals.append(
            Arrival(
                np.array([at for at, _ in own], np.int64),
                np.array([packet.host_ns for _, packet in own], np.int64),
                np.array([packet.key for _, packet in own], np.int64),
                headers,
                np.arange(first, seen[sensor]) * _WIDEST,
            )
        )
    return arrivals


def _window(window: FastWindow, intakes: Sequence[_Watched]) -> Window:
    rank = [{place: n for n, place in enumerate(intake.accepted)} for intake in intakes]
    columns = [
        (sensor, rank[sensor][place - place % _WIDEST], place % _WIDEST)
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
