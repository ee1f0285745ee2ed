"""Feeds and settings for cases worked by hand; times in ms."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction

from tests.reference.batching import FeedPacket, Settings

MS = 10**6
TEN_HZ = Settings(rate=Fraction(10), sensors=1)


def packet(
    sensor: int, *stamps_ms: float, host_ms: float | None = None, key: int = -1
) -> FeedPacket:
    """A packet of valid columns that arrives at its last stamp, if nothing else is said."""
    stamps = tuple(round(stamp * MS) for stamp in stamps_ms)
    host = stamps[-1] if host_ms is None else round(host_ms * MS)
    return FeedPacket(sensor, host, key, stamps, (True,) * len(stamps))


def by_host(packets: Iterable[FeedPacket]) -> list[FeedPacket]:
    """The packets in order of receive time."""
    return sorted(packets, key=lambda one: one.host_ns)
