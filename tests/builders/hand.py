"""Feeds and settings for cases worked by hand; times in ms."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from fractions import Fraction

from tests.reference.batching import FeedPacket, Outcome, Settings, Window

MS = 10**6
TEN_HZ = Settings(rate=Fraction(10), sensors=1)
TWO = replace(TEN_HZ, sensors=2)
NEW_KEY = -1


def packet(
    sensor: int, *stamps_ms: float, host_ms: float | None = None, key: int = NEW_KEY
) -> FeedPacket:
    """A packet of valid columns that arrives at its last stamp, if nothing else is said."""
    stamps = tuple(round(stamp * MS) for stamp in stamps_ms)
    host = stamps[-1] if host_ms is None else round(host_ms * MS)
    return FeedPacket(sensor, host, key, stamps, (True,) * len(stamps))


def masked(whole: FeedPacket, *valid: bool) -> FeedPacket:
    """The packet with these columns valid."""
    return replace(whole, valid=valid)


def every(sensor: int, begin_ms: int, end_ms: int, step_ms: int = 50) -> list[FeedPacket]:
    """Packets of one column each, from begin to before end."""
    return [packet(sensor, stamp) for stamp in range(begin_ms, end_ms, step_ms)]


def by_host(packets: Iterable[FeedPacket]) -> list[FeedPacket]:
    """The packets in order of receive time."""
    return sorted(packets, key=lambda one: one.host_ns)


def spans(outcome: Outcome) -> list[tuple[int, int, int]]:
    """(index, start, end) of the written windows, ns."""
    return [(window.index, window.start_ns, window.end_ns) for window in outcome.windows]


def at_index(outcome: Outcome, index: int) -> Window:
    """The written window of that index."""
    return next(window for window in outcome.windows if window.index == index)
