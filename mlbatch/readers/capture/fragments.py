"""Reassembly of fragmented UDP datagrams (RFC 791 section 3.2, RFC 8200 section 4.5).

The rules, in receive order of the fragments:
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
the sets that the other left open and that its own first fragments belong to (`SetTable.hand_over`).
Captures that overlap in time do not follow each other: their fragments never mix.

`SetTable` applies the rules to one fragment at a time. `Reassembler` treats the usual case many at
once: all fragments of a datagram are in one buffer, in order, and no set of theirs is open. Where
their frames also follow each other, compiled loops join them in place. A chain is a run of
fragments of one set in which each continues the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.native.capture import JOIN_SETS, CaptureLoops
from mlbatch.readers.byte_records import copy_runs, records
from mlbatch.readers.capture.frames import UDP, Datagrams, Fragments, in_order
from mlbatch.types import CaptureCounts
from mlbatch.units import NS_PER_S

MAX_SETS = 2048
MAX_FIRST_KEYS = 64
MAX_DATAGRAM_BYTES = 65535
MAX_AGE_NS = NS_PER_S
_UDP_BYTES = 8
# So few fragments are faster one at a time.
_FEW = 64


@dataclass(slots=True)
class FragmentSet:
    """Fragments of one datagram so far; total: its length, known from the last fragment."""

    # Receive time of the first fragment.
    birth_ns: int
    # Data by offset in the datagram.
    parts: dict[int, bytes] = field(default_factory=dict)
    # Number of frames of the capture that is read, and of those before it.
    frames: int = 0
    earlier: list[tuple[CaptureCounts, int]] = field(default_factory=list)
    # Bytes of `parts`.
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


# Source, destination, identification.
Key: TypeAlias = tuple[int, int, int]


@dataclass(slots=True)
class SetTable:
    """The open sets, oldest first; held_bytes: of their fragments.

    first_keys: the sets that were open first, at most MAX_FIRST_KEYS; now_ns: largest receive time
    so far.
    """

    counts: CaptureCounts
    held_bytes: int = 0
    first_keys: set[Key] = field(default_factory=set)
    now_ns: int = 0
    _sets: dict[Key, FragmentSet] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._sets)

    def __contains__(self, key: Key) -> bool:
        return key in self._sets

    def open_keys(self) -> list[Key]:
        """Source, destination and identification of the open sets."""
        return list(self._sets)

    def running_ns(self, host_ns: I64Array) -> I64Array | None:
        """Largest receive times so far (n,); None where they are times of another clock."""
        running: I64Array = np.maximum.accumulate(np.append(self.now_ns, host_ns))[1:]
        return None if bool((running - host_ns > MAX_AGE_NS).any()) else running

    def expire(self, host_ns: int) -> None:
        """Advance the clock; drop the sets that are more than a second old."""
        if self.now_ns - host_ns > MAX_AGE_NS:
            for key in list(self._sets):
                self._drop(key)
            self.now_ns = host_ns
        self.now_ns = max(self.now_ns, host_ns)
        while self._sets:
            key, oldest = next(iter(self._sets.items()))
            if self.now_ns - oldest.birth_ns <= MAX_AGE_NS:
                return
            self._drop(key)

    def add(self, key: Key, offset: int, part: bytes, more: bool) -> dict[int, bytes] | None:
        """Add a fragment; the parts of the datagram by offset if it is complete."""
        held = self._sets.get(key)
        known = held.parts.get(offset) if held else None
        if held and known == part and more == (offset + len(part) != held.total):
            held.frames += 1
            return None
        if held and known is not None and offset == 0:
            self._drop(key)
            held = None
        held = held or self._open(key)
        held.frames += 1
        if not held.fits(offset, len(part), more):
            self._drop(key)
            return None
        self.held_bytes += len(part)
        return self._close(key) if held.add(offset, part, more) else None

    def finish(self) -> None:
        """Count the open sets as lost, which `hand_over` takes back."""
        for held in self._sets.values():
            self._count(held, "fragment_lost", 1)

    def forget(self) -> None:
        """Free what no capture follows soon enough for."""
        self._sets = {}
        self.held_bytes = 0

    def hand_over(self, key: Key) -> FragmentSet:
        """Give an open set, after `finish`, to the table of a capture that follows."""
        held = self._sets.pop(key)
        self._count(held, "fragment_lost", -1)
        held.earlier.append((self.counts, held.frames))
        held.frames = 0
        return held

    def take_over(self, sets: Mapping[Key, FragmentSet], now_ns: int) -> None:
        """Begin with sets of captures before this one; now_ns: their largest receive time."""
        by_age = sorted(sets.items(), key=lambda item: item[1].birth_ns)
        self._sets = dict(by_age)
        self.first_keys = set(self._sets)
        self.held_bytes = sum(held.received for held in self._sets.values())
        self.now_ns = now_ns

    def _open(self, key: Key) -> FragmentSet:
        if len(self._sets) >= MAX_SETS:
            self._drop(next(iter(self._sets)))
        if len(self.first_keys) < MAX_FIRST_KEYS:
            self.first_keys.add(key)
        held = self._sets[key] = FragmentSet(self.now_ns)
        return held

    def _close(self, key: Key) -> dict[int, bytes] | None:
        held = self._sets[key]
        length = int.from_bytes(held.parts[0][4:6], "big")
        if len(held.parts[0]) < _UDP_BYTES or not _UDP_BYTES <= length <= held.received:
            self._drop(key)
            return None
        del self._sets[key]
        self.held_bytes -= held.received
        # The completing frame is the datagram's.
        held.frames -= 1
        self._count(held, "fragment", 1)
        return held.parts

    def _drop(self, key: Key) -> None:
        held = self._sets.pop(key)
        self.held_bytes -= held.received
        self._count(held, "fragment_lost", 1)

    def _count(self, held: FragmentSet, reason: str, sign: int) -> None:
        """Count the frames of a set, each for its own capture; sign: -1 to take them back."""
        for counts, frames in (*held.earlier, (self.counts, held.frames)):
            counts.skip(reason, sign * frames)


# -- many at once ----------------------------------------------------------------------------------


class _Chains(NamedTuple):
    """Chains over the fragments sorted by set; chain c is `order[start[c] : stop[c]]`.

    whole: the chain is a complete datagram; new_set: it is the first chain of its set;
    total: bytes; udp_length, port: of its UDP header.
    """

    order: I64Array
    start: I64Array
    stop: I64Array
    whole: BoolArray
    new_set: BoolArray
    total: I64Array
    udp_length: I64Array
    port: I64Array


@dataclass(slots=True)
class Reassembler:
    """Joins fragments in the front part of a buffer; open sets survive the buffer's end.

    together: False applies the rules to one fragment at a time.
    """

    counts: CaptureCounts
    together: bool = True
    loops: CaptureLoops | None = None
    sets: SetTable = field(init=False)

    def __post_init__(self) -> None:
        self.sets = SetTable(self.counts)

    def push(self, data: U8Array, fragments: Fragments, host_ns: I64Array) -> Datagrams:
        """Datagrams completed by `fragments`, assembled from byte 0 of `data` on.

        host_ns: (n,) int64, receive time of each fragment. The caller leaves enough room: the
        fragments' bytes and `sets.held_bytes`, or MAX_DATAGRAM_BYTES for each fragment.
        """
        running_ns = self.sets.running_ns(host_ns)
        is_ipv4 = bool((fragments.source >= 0).all())
        if running_ns is None or not (self.together and is_ipv4 and len(fragments)):
            return self._one_by_one(data, fragments, host_ns, _every(fragments), 0)
        # With times that rise, the last one decides on age.
        host_ns = running_ns
        if self.loops is None or len(self.sets) >= JOIN_SETS:
            return self._by_chains(data, fragments, host_ns)
        columns = np.array([getattr(fragments, name) for name in Fragments.__slots__], np.int64)
        joined, rest = self.loops.join(data, columns, host_ns, MAX_AGE_NS, self.sets.open_keys())
        self.counts.skip("fragment", len(fragments) - len(rest) - joined.shape[1])
        if len(rest) < _FEW:
            others = self._one_by_one(data, fragments, host_ns, rest, 0)
        else:
            others = self._by_chains(data, fragments.take(rest), host_ns[rest])
        self.sets.expire(int(host_ns[-1]))
        return in_order(Datagrams(*joined), others)

    def _by_chains(self, data: U8Array, fragments: Fragments, host_ns: I64Array) -> Datagrams:
        every = _every(fragments)
        chains = _find_chains(data, fragments, host_ns)
        if len(self.sets) + len(chains.start) > MAX_SETS:
            return self._one_by_one(data, fragments, host_ns, every, 0)
        self.sets.expire(int(host_ns[0]))
        usable = self._undisturbed(chains, fragments)
        copy = copy_runs if self.loops is None else self.loops.copy_runs
        done, end = _assemble(data, fragments, chains, usable, copy)
        lengths = chains.stop - chains.start
        self.counts.skip("fragment", int((lengths[usable] - 1).sum()))
        rest = np.sort(chains.order[np.repeat(~usable, lengths)])
        others = self._one_by_one(data, fragments, host_ns, rest, end)
        self.sets.expire(int(host_ns[-1]))
        return in_order(done, others)

    def _undisturbed(self, chains: _Chains, fragments: Fragments) -> BoolArray:
        """Whole chains of sets that are not open and have no other fragments before them."""
        broken = ~chains.whole
        if len(self.sets):
            head = chains.order[chains.start]
            columns = fragments.source[head], fragments.destination[head], fragments.ident[head]
            keys = zip(*(column.tolist() for column in columns), strict=True)
            broken |= np.array([key in self.sets for key in keys], bool)
        count = np.cumsum(broken)
        before_set: I64Array = (count - broken)[chains.new_set][np.cumsum(chains.new_set) - 1]
        usable: BoolArray = count == before_set
        return usable

    def _one_by_one(
        self, data: U8Array, fragments: Fragments, host_ns: I64Array, rows: I64Array, end: int
    ) -> Datagrams:
        """Add the fragments `rows` by the rules; assemble from byte `end` on."""
        view = data.data
        done = []
        for row in rows.tolist():
            start = int(fragments.start[row])
            size = int(fragments.size[row])
            source = int(fragments.source[row])
            key = (source, int(fragments.destination[row]), int(fragments.ident[row]))
            offset = int(fragments.offset[row])
            more = bool(fragments.more[row])
            self.sets.expire(int(host_ns[row]))
            parts = self.sets.add(key, offset, bytes(view[start : start + size]), more)
            if parts is None:
                continue
            for at, part in parts.items():
                view[end + at : end + at + len(part)] = part
            port = int.from_bytes(parts[0][2:4], "big")
            length = int.from_bytes(parts[0][4:6], "big")
            done.append((int(fragments.frame[row]), end + 8, length - 8, source, port))
            end += max(at + len(part) for at, part in parts.items())
        return Datagrams(*np.array(done, np.int64).reshape(-1, 5).T)


def _every(fragments: Fragments) -> I64Array:
    return np.arange(len(fragments))


def _find_chains(data: U8Array, fragments: Fragments, host_ns: I64Array) -> _Chains:
    pair = fragments.source << 32 | fragments.destination
    order = np.lexsort((fragments.ident, pair))
    pair = pair[order]
    ident = fragments.ident[order]
    host_ns = host_ns[order]
    offset = fragments.offset[order]
    more = fragments.more[order]
    end = offset + fragments.size[order]
    same = np.zeros(len(order), bool)
    same[1:] = (pair[1:] == pair[:-1]) & (ident[1:] == ident[:-1])
    follows = same.copy()
    follows[1:] &= (offset[1:] == end[:-1]) & more[:-1]
    start = np.flatnonzero(~follows)
    stop = np.append(start[1:], len(order))
    last = stop - 1
    udp = records(data, UDP, fragments.start[order[start]])
    length = udp["length"].astype(np.int64)
    total = end[last]
    whole = (offset[start] == 0) & ~more[last] & (host_ns[last] - host_ns[start] <= MAX_AGE_NS)
    whole &= (end[start] >= UDP.itemsize) & (total <= MAX_DATAGRAM_BYTES)
    whole &= (length >= UDP.itemsize) & (length <= total)
    port = udp["port"].astype(np.int64)
    return _Chains(order, start, stop, whole, ~same[start], total, length, port)


def _assemble(
    data: U8Array,
    fragments: Fragments,
    chains: _Chains,
    usable: BoolArray,
    copy: Callable[[U8Array, I64Array, I64Array, U8Array, I64Array], None],
) -> tuple[Datagrams, int]:
    """Copy the usable chains to the front of `data`; the datagrams and the first free byte."""
    lengths = (chains.stop - chains.start)[usable]
    rows = chains.order[np.repeat(usable, chains.stop - chains.start)]
    total = chains.total[usable]
    place = np.cumsum(total) - total
    target = np.repeat(place, lengths) + fragments.offset[rows]
    copy(data, fragments.start[rows], fragments.size[rows], data, target)
    last = chains.order[chains.stop[usable] - 1]
    datagrams = Datagrams(
        frame=fragments.frame[last],
        start=place + UDP.itemsize,
        size=chains.udp_length[usable] - UDP.itemsize,
        source=fragments.source[last],
        port=chains.port[usable],
    )
    # File order: sorting by set separated the datagrams of different sensors.
    by_frame = np.argsort(datagrams.frame, kind="stable")
    sorted_columns = (getattr(datagrams, name)[by_frame] for name in Datagrams._fields)
    return Datagrams(*sorted_columns), int(total.sum())
