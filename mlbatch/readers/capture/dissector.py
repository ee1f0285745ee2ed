"""From captured frames to UDP datagrams, whole or joined of fragments, by `native/capture.c`.

Fragments (RFC 791 section 3.2, RFC 8200 section 4.5) are joined by these rules, in receive order:
- a set is identified by (source, destination, identification); the protocol is always UDP here;
- a set whose first fragment is more than 1 s older than a later fragment is dropped: fragments of
  one datagram arrive within a millisecond, and identifications are used again; ages are differences
  of the largest receive time so far, since times step back where several queues are captured, and
  a step back by more than 1 s is another clock, which drops all sets;
- a fragment at offset 0 with other bytes than the one already there begins a new datagram: the old
  set is dropped; a duplicate fragment (same place, same bytes) changes nothing;
- fragments that overlap otherwise, or are beyond the last one, drop their set;
- the last missing fragment completes the datagram and gives its receive time;
- at most MAX_SETS sets are open: a further one drops the oldest.
Frames of dropped and never completed sets are counted `fragment_lost`; the frames of a completed
datagram but the completing one are counted `fragment`, so that each datagram is one frame.

A capture that follows another one (tcpdump -C and -G begin a new file within a datagram) takes over
the sets that the other left open and that its own first fragments belong to (`inherit`). Captures
that overlap in time do not follow each other: their fragments never mix.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.native.library import Dissection, library
from mlbatch.readers.capture.frames import RAW_IP, Frames
from mlbatch.types import MOST_STREAMS, OTHER_STREAMS, CaptureCounts, Stream, StreamTable
from mlbatch.units import NS_PER_S

MAX_SETS = 2048
MAX_FIRST_KEYS = 64
MAX_DATAGRAM_BYTES = 65535
MAX_AGE_NS = NS_PER_S
# In the order of `capture.c`.
_REASONS = ("not_ip", "not_udp", "truncated", "fragment", "fragment_lost")
_KEY_WORDS = 5
_FIELDS = ("birth_ns", "frames", "received", "total", "top", "inherited")
_SET = np.dtype([("key", np.uint64, (_KEY_WORDS,)), *((name, np.int64) for name in _FIELDS)])
_PART_FIELDS = ("below", "offset", "size", "start", "is_kept", "frame")
_PART = np.dtype([(name, np.int64) for name in _PART_FIELDS])
# Of a stream: version above, port below.
_PORT_BITS = 16

# Version and identification, source, destination: 8 bytes each.
Key: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OpenSet:
    """Fragments of a datagram that later captures may complete; total: -1 if it is not known.

    parts: their offsets and bytes, the highest offset first; frames: of each capture so far.
    """

    birth_ns: int
    total: int
    parts: tuple[tuple[int, bytes], ...]
    frames: tuple[tuple[CaptureCounts, int], ...]

    def count(self, reason: str, sign: int = 1) -> None:
        """Count the frames of a set, each for its own capture; sign: -1 to take them back."""
        for counts, frames in self.frames:
            counts.skip(reason, sign * frames)


class Datagrams(NamedTuple):
    """UDP payloads in the order in which frames complete them; all fields (n,) int64.

    stream: number in the `StreamTable`; host_ns: receive time of the completing frame.
    """

    start: I64Array
    size: I64Array
    stream: I64Array
    host_ns: I64Array


class Dissector:
    """Finds the datagrams of a capture, buffer by buffer.

    first_keys: the sets that were open first, at most MAX_FIRST_KEYS; open_sets: after `finish`,
    what is left for captures that follow; begin_ns, end_ns: receive times of all frames.
    """

    def __init__(
        self, counts: CaptureCounts, streams: StreamTable, max_age_ns: int = MAX_AGE_NS
    ) -> None:
        """max_age_ns: of sets of fragments; -1: none are joined."""
        self.counts = counts
        self.begin_ns: int | None = None
        self.end_ns = 0
        self.open_sets: dict[Key, OpenSet] = {}
        self._streams = streams
        self._library = library()
        self._inherited: list[OpenSet] = []
        # By number of `capture.c`.
        self._stream_numbers: I64Array = np.zeros(0, np.int64)
        self._skipped = np.zeros(len(_REASONS), np.int64)
        self._addresses = np.empty((MOST_STREAMS, 3), np.uint64)
        self._sets = np.empty(MAX_SETS, _SET)
        self._parts = np.empty(0, _PART)
        self._kept: U8Array = np.empty(0, np.uint8)
        self._kept_bytes = 0
        self._first_keys = np.empty((MAX_FIRST_KEYS, _KEY_WORDS), np.uint64)
        self._settled = np.empty(0, np.int64)
        self._state = Dissection(
            skipped=self._skipped,
            most_streams=MOST_STREAMS,
            slot_count=2 * MOST_STREAMS,
            streams=self._addresses,
            stream_slots=np.zeros(2 * MOST_STREAMS, np.int64),
            most_age_ns=max_age_ns,
            most_sets=MAX_SETS,
            sets=self._sets,
            free_part=-1,
            most_first=MAX_FIRST_KEYS,
            first_keys=self._first_keys,
        )

    @property
    def held_bytes(self) -> int:
        """Bytes of the fragments of open sets."""
        return int(self._state.held_bytes)

    @property
    def now_ns(self) -> int:
        """Largest receive time of a fragment so far."""
        return int(self._state.now_ns)

    @property
    def first_keys(self) -> set[Key]:
        """The sets that were open first."""
        return {tuple(key) for key in self._first_keys[: self._state.first_count].tolist()}

    def push(self, data: U8Array, frames: Frames) -> tuple[Datagrams, int]:
        """Return the datagrams that frames contain or complete, and the bytes used in front.

        Fragments are joined where they are, or from byte 0 of `data` on. The caller leaves room
        there: the bytes of the frames and `held_bytes`, or MAX_DATAGRAM_BYTES for each frame.
        Odd frames in `frames` become the IP packets in them.
        """
        count = len(frames)
        self._span(frames.host_ns)
        start, captured = frames.start, frames.captured
        is_outside = (start < 0) | (captured < 0) | (captured > len(data))
        if bool((is_outside | (start > len(data) - captured)).any()):
            raise IndexError("frames outside of their array")
        columns = [
            np.ascontiguousarray(column)
            for column in (start, captured, frames.original, frames.link, frames.host_ns)
        ]
        state = self._state
        self._room_for_parts(state.part_count + count)
        found = np.empty((4, count), np.int64)
        state.room = count
        state.datagrams = found
        state.datagram_count = state.front = 0
        frame = depth = 0
        opened = -1
        while True:
            frame = self._library.mlbatch_dissect(state, data, frame, count, *columns)
            if frame == count:
                break
            # A packet in a packet is odd again.
            depth = depth + 1 if frame == opened else 1
            opened = frame
            if not self._open_odd(data, columns, frame, depth):
                frame += 1
        if state.loose_bytes:
            self._keep(data)
        self.counts.frames += count
        self.counts.datagrams += state.datagram_count
        for reason, frame_count in zip(_REASONS, self._skipped.tolist(), strict=True):
            if frame_count:
                self.counts.skip(reason, frame_count)
        self._skipped[:] = 0
        start, size, stream, host_ns = found[:, : state.datagram_count]
        return Datagrams(start, size, self._numbers(stream), host_ns), state.front

    def inherit(self, sets: Mapping[Key, OpenSet], now_ns: int) -> None:
        """Begin with sets of captures before this one; now_ns: their largest receive time."""
        by_age = sorted(sets.items(), key=lambda item: item[1].birth_ns)
        self._inherited = [held for _, held in by_age]
        self._settled = np.full(len(by_age), -1)
        parts: list[tuple[int, int, int, int, bool, int]] = []
        store = bytearray()
        for number, (key, held) in enumerate(by_age):
            self._first_keys[number] = key
            received = 0
            for rank, (offset, part) in enumerate(held.parts, 1):
                below = len(parts) + 1 if rank < len(held.parts) else -1
                parts.append((below, offset, len(part), len(store), True, 0))
                store += part
                received += len(part)
            top = len(parts) - len(held.parts)
            self._sets[number] = (key, held.birth_ns, 0, received, held.total, top, number)
        self._parts = np.array(parts, _PART)
        self._kept = np.frombuffer(store, np.uint8)
        self._kept_bytes = self._state.held_bytes = len(store)
        self._state.kept = self._kept
        self._state.settled = self._settled
        self._state.parts = self._parts
        self._state.part_count = len(parts)
        self._state.set_count = self._state.first_count = len(by_age)
        self._state.now_ns = now_ns

    def finish(self) -> None:
        """Count the open sets as lost; they are in `open_sets` for captures that follow."""
        for key, birth_ns, frames, _, total, top, inherited in self._sets[
            : self._state.set_count
        ].tolist():
            parts = []
            while top >= 0:
                top, offset, size, start, *_ = self._parts[top].tolist()
                parts.append((offset, self._kept[start : start + size].tobytes()))
            before = self._inherited[inherited].frames if inherited >= 0 else ()
            held = OpenSet(birth_ns, total, tuple(parts), (*before, (self.counts, frames)))
            held.count("fragment_lost")
            self.open_sets[tuple(key)] = held
        self._state.set_count = 0
        for held, reason in zip(self._inherited, self._settled.tolist(), strict=True):
            if reason >= 0:
                held.count(_REASONS[reason])

    def hand_over(self, key: Key) -> OpenSet:
        """Give a set that is left to a capture that follows, which counts its frames."""
        held = self.open_sets.pop(key)
        held.count("fragment_lost", -1)
        return held

    def _span(self, host_ns: I64Array) -> None:
        if len(host_ns) and self.begin_ns is None:
            self.begin_ns = int(host_ns[0])
        self.end_ns = int(host_ns.max(initial=self.end_ns))

    def _open_odd(self, data: U8Array, columns: list[I64Array], frame: int, depth: int) -> bool:
        """Replace a frame by the IP packet in it, or count it; whether there is one."""
        from mlbatch.readers.capture.odd import MAX_DEPTH, MAX_HEADER_BYTES, find_ip

        start, captured, original, link, _ = columns
        kind = self._state.odd_kind
        odd_at = self._state.odd_at
        stop = int(start[frame] + captured[frame])
        headers = data[odd_at : min(stop, odd_at + MAX_HEADER_BYTES)].tobytes()
        place = find_ip(headers, kind) if depth <= MAX_DEPTH else None
        if place is None:
            is_in_ip = 0 <= kind < 256
            self._skipped[_REASONS.index("not_udp" if is_in_ip else "not_ip")] += 1
            return False
        passed = odd_at + place - start[frame]
        start[frame] += passed
        captured[frame] -= passed
        original[frame] -= passed
        link[frame] = RAW_IP
        return True

    def _room_for_parts(self, count: int) -> None:
        if count > len(self._parts):
            self._parts = np.concatenate([self._parts, np.empty(count, _PART)])
            self._state.parts = self._parts

    def _keep(self, data: U8Array) -> None:
        """Copy what open sets have in `data`, whose bytes will be replaced."""
        state = self._state
        kept = self._kept
        needs_room = self._kept_bytes + state.loose_bytes > len(kept)
        if needs_room:
            kept = np.empty(2 * state.held_bytes, np.uint8)
            self._kept_bytes = 0
        self._kept_bytes = self._library.mlbatch_keep(
            state, data, needs_room, kept, self._kept_bytes
        )
        self._kept = kept

    def _numbers(self, stream: I64Array) -> I64Array:
        """Numbers in the table of the session; new streams are added to it."""
        first = len(self._stream_numbers)
        if first < self._state.stream_count:
            new = [
                self._streams.number(_stream(*words))
                for words in self._addresses[first : self._state.stream_count].tolist()
            ]
            self._stream_numbers = np.append(self._stream_numbers, new)
        is_other = stream < 0
        numbers = self._stream_numbers[stream]
        if is_other.any():
            numbers[is_other] = self._streams.number(OTHER_STREAMS)
        return numbers


def _stream(high: int, low: int, end: int) -> Stream:
    ip = (
        ipaddress.IPv4Address(low)
        if end >> _PORT_BITS == 4
        else ipaddress.IPv6Address(high << 64 | low)
    )
    return Stream(str(ip), end & (1 << _PORT_BITS) - 1)
