"""Windows to scans, by one thread or several: what is due, and who decodes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, replace

import numpy as np

from mlbatch.batching.windows import Window
from mlbatch.decode.decoder import Decoder, Due, Label, Source
from mlbatch.report.ledger import PointCounts
from mlbatch.types import Scan

# What became of the slots of every sensor in a scan, in the order of `ledger.POINT_FATES`.
Fates = Sequence[Sequence[int]]
NewDecoder = Callable[[Sequence[Source], int | None], Decoder]


@dataclass(slots=True)
class Task:
    """Columns of a scan to be decoded.

    only: with `--split` the sensor that they are of; fates: as `Decoder.scan` takes them.
    """

    due: Due
    label: Label
    only: int | None
    fates: Fates | None
    is_decoded: bool = False

    @property
    def end_ns(self) -> int:
        """End of the window."""
        return self.label.end_ns

    def oldest_place(self, sensor: int) -> int | None:
        """First ring place of a sensor whose pixels are still needed."""
        if self.is_decoded:
            return None
        if self.only is None:
            place = self.due.place[self.due.sensor == sensor]
        else:
            place = self.due.place[: len(self.due) if self.only == sensor else 0]
        return int(place.min()) if len(place) else None


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A window that gives no scan, though it holds columns; what passes by goes on."""

    end_ns: int


@dataclass(frozen=True, slots=True)
class Decoded:
    """A scan, and what became of the slots of every sensor in it."""

    scan: Scan
    fates: list[list[int]]


class Bench:
    """The decoders of one thread, with scratch that no other thread uses."""

    def __init__(self, sources: Sequence[Source], split: bool, new: NewDecoder) -> None:
        """split: a decoder for each sensor, as tasks then are of one sensor."""
        self._sensors = len(sources)
        if split:
            for source in sources:
                source.ring_base = 0
            self._decoders = [new([source], number) for number, source in enumerate(sources)]
        else:
            self._decoders = [new(sources, None)]

    def decode(self, task: Task) -> Decoded:
        """The scan of a task; its arrays live as long as the decoder says."""
        decoder = self._decoders[task.only or 0]
        before = [one.fates for one in decoder.counts]
        scan = decoder.scan(task.due, task.label, task.fates)
        task.is_decoded = True
        after = [one.fates for one in decoder.counts]
        own = [
            [late - early for late, early in zip(now, was, strict=True)]
            for now, was in zip(after, before, strict=True)
        ]
        if task.only is not None:
            nothing = [[0] * len(own[0])] * self._sensors
            own = [*nothing[: task.only], *own, *nothing[task.only + 1 :]]
        return Decoded(scan, own)

    @property
    def points(self) -> list[PointCounts]:
        """What became of the pixels of each sensor here."""
        return [counts for decoder in self._decoders for counts in decoder.counts]


@dataclass(slots=True)
class Benches:
    """The benches of a run, and the tasks whose raw packets they still need."""

    benches: list[Bench] = field(default_factory=list)
    _open: list[Task] = field(default_factory=list)

    def points(self, number: int) -> PointCounts:
        """What became of the pixels of a sensor, whoever decoded them."""
        total = PointCounts()
        for bench in self.benches:
            counts = bench.points[number]
            for part in fields(PointCounts):
                setattr(total, part.name, getattr(total, part.name) + getattr(counts, part.name))
        return total

    def open(self, window: Window, split: bool, fates: Iterator[Fates]) -> Iterator[Task]:
        """What is to be decoded of a window: one scan, or one of each sensor in it."""
        label = Label(
            window.index,
            window.slice,
            window.start_ns,
            window.end_ns,
            window.complete,
            window.ready_host_ns,
        )
        due = Due(window.stamp_ns, window.sensor, window.place, window.encoder)
        if not split:
            yield self._task(due, label, None, fates)
            return
        for number in np.unique(window.sensor).tolist():
            own = window.sensor == number
            alone = np.zeros(int(np.count_nonzero(own)), np.int64)
            part = Due(due.stamp_ns[own], alone, due.place[own], due.encoder[own])
            yield self._task(part, label, number, fates)

    def _task(self, due: Due, label: Label, only: int | None, fates: Iterator[Fates]) -> Task:
        task = Task(due, label, only, next(fates, None))
        self._open.append(task)
        return task

    def oldest_place(self, sensor: int, waiting: int | None) -> int | None:
        """First ring place of a sensor that is needed, `waiting` being that of the batching."""
        self._open = [task for task in self._open if not task.is_decoded]
        places = [task.oldest_place(sensor) for task in self._open]
        return min((at for at in (*places, waiting) if at is not None), default=None)


def with_own_lidars(sources: Sequence[Source]) -> list[Source]:
    """The same sources for another thread: lidars have scratch of their own, rings are shared."""
    return [replace(source, lidar=deepcopy(source.lidar)) for source in sources]
