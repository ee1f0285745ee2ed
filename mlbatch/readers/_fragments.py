"""Rules of reassembly of fragmented UDP datagrams (RFC 791 section 3.2, RFC 8200 section 4.5).

The rules, in order of arrival of the fragments:
- a set is known by (source, destination, identification); the protocol is always UDP here;
- a set whose first arrival lies more than 1 s before or after any later fragment is dropped:
  fragments of one datagram arrive within a millisecond, and identifications are used again;
- a fragment at offset 0 with other bytes than the one already there begins a new datagram: the old
  set is dropped; a repeated fragment (same place, same bytes) changes nothing;
- fragments that overlap otherwise, or lie behind the last one, drop their set;
- the last missing fragment completes the datagram and gives its time of arrival;
- at most MAX_SETS sets are open: a further one drops the oldest.
Frames of dropped and never completed sets are counted `fragment_lost`; the frames of a completed
datagram but the completing one are counted `fragment`, so that each datagram is one frame.

These are the rules one fragment at a time; `_reassembly` applies them to many at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from mlbatch.types import CaptureCounts
from mlbatch.units import NS_PER_S

MAX_SETS = 2048
MAX_DATAGRAM_BYTES = 65535
MAX_AGE_NS = NS_PER_S
_UDP_BYTES = 8


@dataclass(slots=True)
class _Set:
    """Fragments of one datagram so far; `total` is its length once the last one is here."""

    birth_ns: int
    parts: dict[int, bytes] = field(default_factory=dict)
    frames: int = 0
    received: int = 0
    total: int | None = None

    def fits(self, offset: int, size: int, more: bool) -> bool:
        """Whether a fragment neither overlaps the others nor contradicts the datagram's end."""
        end = offset + size
        limit = MAX_DATAGRAM_BYTES if self.total is None else self.total
        if end > limit or (not more and self.total is not None):
            return False
        starts = self.parts.items()
        if any(offset < at + len(part) and at < end for at, part in starts):
            return False
        return more or all(at + len(part) <= end for at, part in starts)

    def add(self, offset: int, part: bytes, more: bool) -> bool:
        """Add a fragment that fits; whether the datagram is complete."""
        self.parts[offset] = part
        self.received += len(part)
        if not more:
            self.total = offset + len(part)
        return self.received == self.total


@dataclass(slots=True)
class SetTable:
    """The open sets; `held_bytes` is what their fragments take."""

    counts: CaptureCounts
    held_bytes: int = 0
    _sets: dict[tuple[int, int, int], _Set] = field(default_factory=dict)
    _oldest_ns: int = 0
    _newest_ns: int = 0

    def __len__(self) -> int:
        return len(self._sets)

    def __contains__(self, key: tuple[int, int, int]) -> bool:
        return key in self._sets

    def expire(self, now_ns: int) -> None:
        """Drop the sets that are more than a second away from `now_ns`."""
        if now_ns - self._oldest_ns <= MAX_AGE_NS and self._newest_ns - now_ns <= MAX_AGE_NS:
            return
        for key, held in list(self._sets.items()):
            if abs(now_ns - held.birth_ns) > MAX_AGE_NS:
                self._drop(key)
        births = [held.birth_ns for held in self._sets.values()]
        self._oldest_ns, self._newest_ns = min(births, default=now_ns), max(births, default=now_ns)

    def add(
        self, key: tuple[int, int, int], offset: int, part: bytes, more: bool, now_ns: int
    ) -> dict[int, bytes] | None:
        """Take a fragment; the parts of the datagram by offset if it is complete."""
        held = self._sets.get(key)
        known = held.parts.get(offset) if held else None
        if held and known == part and more == (offset + len(part) != held.total):
            held.frames += 1
            return None
        if held and known is not None and offset == 0:
            self._drop(key)
            held = None
        held = held or self._open(key, now_ns)
        held.frames += 1
        if not held.fits(offset, len(part), more):
            self._drop(key)
            return None
        self.held_bytes += len(part)
        return self._close(key) if held.add(offset, part, more) else None

    def finish(self) -> None:
        """Count what is still open as lost."""
        for key in list(self._sets):
            self._drop(key)

    def _open(self, key: tuple[int, int, int], now_ns: int) -> _Set:
        if len(self._sets) >= MAX_SETS:
            self._drop(next(iter(self._sets)))
        if not self._sets:
            self._oldest_ns = self._newest_ns = now_ns
        self._oldest_ns = min(self._oldest_ns, now_ns)
        self._newest_ns = max(self._newest_ns, now_ns)
        held = self._sets[key] = _Set(now_ns)
        return held

    def _close(self, key: tuple[int, int, int]) -> dict[int, bytes] | None:
        held = self._sets[key]
        length = int.from_bytes(held.parts[0][4:6], "big")
        if len(held.parts[0]) < _UDP_BYTES or not _UDP_BYTES <= length <= held.received:
            self._drop(key)
            return None
        del self._sets[key]
        self.held_bytes -= held.received
        self.counts.skip("fragment", held.frames - 1)
        return held.parts

    def _drop(self, key: tuple[int, int, int]) -> None:
        held = self._sets.pop(key)
        self.held_bytes -= held.received
        self.counts.skip("fragment_lost", held.frames)
