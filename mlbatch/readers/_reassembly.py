"""Fragments of a buffer become datagrams: the usual case at once, the rest by `_fragments`' rules.

Usual: all fragments of a datagram lie in one buffer, in order, and no set of theirs is open. A
chain is a run of fragments of one set in which each continues the one before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.decode.kernels.reading import CaptureKernel
from mlbatch.readers._bytes import copy_runs, records
from mlbatch.readers._fragments import MAX_AGE_NS, MAX_DATAGRAM_BYTES, MAX_SETS, SetTable
from mlbatch.readers._frames import UDP, Datagrams, Fragments, in_order
from mlbatch.types import CaptureCounts


@dataclass(slots=True)
class _Chains:
    """Chains over the fragments sorted by set; chain c is `order[start[c] : stop[c]]`.

    whole: the chain is a complete datagram; new_set: it is the first chain of its set;
    total: bytes; udp_length, port: as its UDP header says.
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
    """Puts fragments together in the front part of a buffer; state survives the buffer's end.

    together: False takes every fragment by the rules, one at a time.
    """

    counts: CaptureCounts
    together: bool = True
    kernel: CaptureKernel | None = None
    sets: SetTable = field(init=False)

    def __post_init__(self) -> None:
        self.sets = SetTable(self.counts)

    def push(self, data: U8Array, fragments: Fragments, host_ns: I64Array) -> Datagrams:
        """Datagrams completed by `fragments`, assembled from byte 0 of `data` on.

        host_ns: (n,) int64, arrival of each fragment. The caller leaves enough room: the
        fragments' bytes and `sets.held_bytes`, or MAX_DATAGRAM_BYTES for each fragment.
        """
        every = np.arange(len(fragments))
        if not self.together or not _independent(fragments, host_ns):
            return self._one_by_one(data, fragments, host_ns, every, 0)
        chains = _find_chains(data, fragments, host_ns)
        if len(self.sets) + len(chains.start) > MAX_SETS:
            return self._one_by_one(data, fragments, host_ns, every, 0)
        self.sets.expire(int(host_ns[0]))
        usable = self._undisturbed(chains, fragments)
        copy = copy_runs if self.kernel is None else self.kernel.copy_runs
        done, end = _assemble(data, fragments, chains, usable, copy)
        lengths = chains.stop - chains.start
        self.counts.skip("fragment", int((lengths[usable] - 1).sum()))
        rest = np.sort(chains.order[np.repeat(~usable, lengths)])
        others = self._one_by_one(data, fragments, host_ns, rest, end)
        self.sets.expire(int(host_ns[-1]))
        return in_order(done, others)

    def _undisturbed(self, chains: _Chains, fragments: Fragments) -> BoolArray:
        """Whole chains of sets that are not open and of which nothing else came before."""
        broken = ~chains.whole
        if len(self.sets):
            head = chains.order[chains.start]
            columns = fragments.source[head], fragments.destination[head], fragments.ident[head]
            keys = zip(*(column.tolist() for column in columns), strict=True)
            broken |= np.array([key in self.sets for key in keys], bool)
        trouble = np.cumsum(broken)
        before_set: I64Array = (trouble - broken)[chains.new_set][np.cumsum(chains.new_set) - 1]
        usable: BoolArray = trouble == before_set
        return usable

    def _one_by_one(
        self, data: U8Array, fragments: Fragments, host_ns: I64Array, rows: I64Array, end: int
    ) -> Datagrams:
        """Take the fragments `rows` by the rules; assemble from byte `end` on."""
        view = data.data
        done = []
        for row in rows.tolist():
            start, size = int(fragments.start[row]), int(fragments.size[row])
            source, now_ns = int(fragments.source[row]), int(host_ns[row])
            key = source, int(fragments.destination[row]), int(fragments.ident[row])
            offset, more = int(fragments.offset[row]), bool(fragments.more[row])
            self.sets.expire(now_ns)
            parts = self.sets.add(key, offset, bytes(view[start : start + size]), more, now_ns)
            if parts is None:
                continue
            for at, part in parts.items():
                view[end + at : end + at + len(part)] = part
            port, length = (int.from_bytes(parts[0][at : at + 2], "big") for at in (2, 4))
            done.append((int(fragments.frame[row]), end + 8, length - 8, source, port))
            end += max(at + len(part) for at, part in parts.items())
        return Datagrams(*np.array(done, np.int64).reshape(-1, 5).T)


def _independent(fragments: Fragments, host_ns: I64Array) -> bool:
    """Whether only the last arrival decides on age, and all keys compare as numbers."""
    steps_back = host_ns[1:] < host_ns[:-1]
    return len(fragments) > 0 and not steps_back.any() and bool((fragments.source >= 0).all())


def _find_chains(data: U8Array, fragments: Fragments, host_ns: I64Array) -> _Chains:
    pair = fragments.source << 32 | fragments.destination
    order = np.lexsort((fragments.ident, pair))
    pair, ident, host_ns = pair[order], fragments.ident[order], host_ns[order]
    offset, more = fragments.offset[order], fragments.more[order]
    end = offset + fragments.size[order]
    same = np.zeros(len(order), bool)
    same[1:] = (pair[1:] == pair[:-1]) & (ident[1:] == ident[:-1])
    follows = same.copy()
    follows[1:] &= (offset[1:] == end[:-1]) & more[:-1]
    start = np.flatnonzero(~follows)
    stop = np.append(start[1:], len(order))
    last = stop - 1
    udp = records(data, UDP, fragments.start[order[start]])
    length, total = udp["length"].astype(np.int64), end[last]
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
    # Arrival order: sorting by set put the datagrams of one sensor after those of another.
    by_frame = np.argsort(datagrams.frame, kind="stable")
    sorted_columns = (getattr(datagrams, name)[by_frame] for name in Datagrams.__slots__)
    return Datagrams(*sorted_columns), int(total.sum())
