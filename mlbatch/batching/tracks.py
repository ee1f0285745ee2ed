"""What the batching knows of each sensor, and of all of them over the deliveries of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mlbatch.batching.intake import FOREVER, NEVER, Delivery, Intake
from mlbatch.types import Columns, I64Array

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


def ranked(accepted: Sequence[Delivery | None]) -> tuple[list[I64Array], I64Array]:
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
