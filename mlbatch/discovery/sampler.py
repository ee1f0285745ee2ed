"""Which stream is which sensor: by what the packets say, never by file name.

A *kind* is a stream together with a payload size. At the start the kinds of the first seconds are
matched with calibrations or the rig's selectors (`matching.py`); later kinds join a sensor only if
their packets prove to be its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.clocks.watch import ClockWatch
from mlbatch.frames.naming import same_namespace
from mlbatch.lidar.interface import Beside, Evidence, Lidar
from mlbatch.rig.rig import StreamSelector
from mlbatch.types import PacketBatch, Stream, StreamTable
from mlbatch.units import NS_PER_S

Kind = tuple[int, int]  # (number of the stream, payload size)
SAMPLES_PER_KIND = 16
SAMPLE_EVERY_NS = NS_PER_S // 4
# Less of a recording does not tell how much a sensor sends.
SHORTEST_NS = 2 * NS_PER_S
# Different first words of a kind that are looked out for; most makers change them in every packet.
MOST_BEGINNINGS = 8
# No lidar sends so many kinds; a camera does, and a recorder that copies files.
MOST_BESIDE = 64
_WORD = 4


@dataclass(slots=True)
class Found:
    """A sensor: its name, how to read it, and the kinds of packets seen of it so far."""

    name: str
    lidar: Lidar
    selector: StreamSelector = field(default_factory=StreamSelector)
    kinds: set[Kind] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Sampler:
    """Collects the first payloads of every kind, and counts them all."""

    table: StreamTable
    samples: dict[Kind, list[bytes]] = field(default_factory=dict)
    sample_host_ns: dict[Kind, list[int]] = field(default_factory=dict)
    packets: dict[Kind, int] = field(default_factory=dict)
    span_ns: dict[Kind, tuple[int, int]] = field(default_factory=dict)
    beginnings: dict[Kind, set[int]] = field(default_factory=dict)
    _neighbours: dict[str, list[Kind]] = field(default_factory=dict)

    def add(self, batch: PacketBatch) -> None:
        """Look at a batch."""
        for kind, index in split_by_kind(batch):
            if kind not in self.samples:
                source = self.table.streams[kind[0]].source_ip
                self._neighbours.setdefault(source, []).append(kind)
            kept = self.samples.setdefault(kind, [])
            hosts_ns = self.sample_host_ns.setdefault(kind, [])
            for at in self._telling(kind, index, batch):
                begin = int(batch.start[at])
                kept.append(batch.data[begin : begin + kind[1]].tobytes())
                hosts_ns.append(int(batch.host_ns[at]))
            self.packets[kind] = self.packets.get(kind, 0) + len(index)
            first_ns, last_ns = int(batch.host_ns[index[0]]), int(batch.host_ns[index[-1]])
            self.span_ns[kind] = self.span_ns.get(kind, (first_ns, 0))[0], last_ns

    def _telling(self, kind: Kind, index: I64Array, batch: PacketBatch) -> list[int]:
        """Which packets of a kind to keep: the first ones, then two of every quarter of a second.

        Several sensors may share a kind, and one of them may start later than the others. The
        choice follows arrival times, so that it does not depend on the size of batches. Kept too
        are the first packets that begin differently: on a topic, device packets may hide among
        many times as many others.
        """
        first = SAMPLES_PER_KIND - min(SAMPLES_PER_KIND, self.packets.get(kind, 0))
        host_ns = batch.host_ns[index]
        tick = np.concatenate([[self.span_ns.get(kind, (0, 0))[1]], host_ns]) // SAMPLE_EVERY_NS
        fresh = tick[1:] != tick[:-1]
        fresh[1:] |= fresh[:-1]
        fresh[:first] = True
        beginnings = self.beginnings.setdefault(kind, set())
        if kind[1] >= _WORD and len(beginnings) < MOST_BEGINNINGS:
            words = batch.data[batch.start[index, None] + np.arange(_WORD)].view("<u4")[:, 0]
            values, at = np.unique(words, return_index=True)
            for value, row in sorted(zip(values.tolist(), at.tolist(), strict=True), key=_second):
                if value not in beginnings and len(beginnings) < MOST_BEGINNINGS:
                    beginnings.add(value)
                    fresh[row] = True
        chosen: list[int] = index[fresh].tolist()
        return chosen

    def clock_offset_ns(self, sensor: Found) -> int | None:
        """First stamp of a sensor in the samples minus its arrival; None if there is none."""
        firsts = []
        for kind in sensor.kinds:
            packets = as_rows(self.samples[kind], kind[1])[:, : sensor.lidar.packet_size]
            hosts_ns = np.array(self.sample_host_ns[kind], np.int64)
            heads = sensor.lidar.heads(packets, hosts_ns)
            good = sensor.lidar.owns(packets) & (sensor.lidar.faults(packets) == 0)
            rows = (heads.valid.any(axis=1) & good).nonzero()[0]
            if len(rows):
                row = int(rows[0])
                stamp_ns = int(heads.stamp_ns[row, int(heads.valid[row].argmax())])
                host_ns = self.sample_host_ns[kind][row]
                firsts.append((host_ns, stamp_ns - host_ns))
        return min(firsts)[1] if firsts else None

    def columns_per_s(self, sensor: Found) -> float | None:
        """Columns that a sensor sends in a second where nothing is lost; None if it is not known.

        What it would send over whole turns, times the share of it that was seen, in percent: rates
        that were measured must not depend on when packets arrive.
        """
        period_ns = sensor.lidar.column_period_ns
        shares = [self._share(sensor, kind, period_ns) for kind in sensor.kinds if period_ns]
        share = max((share for share in shares if share is not None), default=0.0)
        return round(share, 2) * NS_PER_S / period_ns if share else None

    def _share(self, sensor: Found, kind: Kind, period_ns: float) -> float | None:
        """Valid columns that were sent between two samples, by what a whole turn would hold."""
        lidar = sensor.lidar
        packets = as_rows(self.samples[kind], kind[1])[:, : lidar.packet_size]
        hosts_ns = np.array(self.sample_host_ns[kind], np.int64)
        good = lidar.owns(packets) & (lidar.faults(packets) == 0)
        packets, hosts_ns = packets[good], hosts_ns[good]
        if len(packets) < 2 or hosts_ns[-1] - hosts_ns[0] < SHORTEST_NS:
            return None
        heads, number = lidar.heads(packets, hosts_ns), lidar.sequence(packets)
        first, last = 0, len(packets) - 1
        sent = self.packets[kind] - 1
        counted = (number >= 0).nonzero()[0]
        if lidar.sequence_modulus and len(counted) > 1:
            first, last = int(counted[0]), int(counted[-1])
            sent = int(number[last] - number[first]) % lidar.sequence_modulus
        passed_ns = int(heads.stamp_ns[last].max() - heads.stamp_ns[first].max())
        valid = float(heads.valid.sum(axis=1).mean())
        return sent * valid * period_ns / passed_ns if passed_ns > 0 else None

    def evidence(self, kind: Kind) -> Evidence:
        """What is known of a kind."""
        stream = self.table.streams[kind[0]]
        near = (
            other
            for other in self._neighbours[stream.source_ip]
            if other != kind and is_beside(self.table.streams[other[0]], stream)
        )
        beside = tuple(
            Beside(self.table.streams[other[0]], other[1], *self._sample(other))
            for other in itertools.islice(near, MOST_BESIDE)
        )
        return Evidence(stream, kind[1], *self._sample(kind), beside)

    def _sample(self, kind: Kind) -> tuple[U8Array, I64Array]:
        rows = as_rows(self.samples[kind], kind[1])
        return rows, np.array(self.sample_host_ns[kind], np.int64)


def _second(pair: tuple[int, int]) -> int:
    return pair[1]


def as_rows(payloads: Sequence[bytes], size: int) -> U8Array:
    """Payloads of one size as (k, size) uint8."""
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), size)


def split_by_kind(batch: PacketBatch) -> list[tuple[Kind, I64Array]]:
    """Packets of a batch by stream and size: ((stream, size), indices in arrival order)."""
    if not len(batch):
        return []
    key = batch.stream << 17 | batch.size
    if bool((key == key[0]).all()):
        return [((int(batch.stream[0]), int(batch.size[0])), np.arange(len(batch)))]
    order = key.argsort(kind="stable")
    key = key[order]
    edges = (np.flatnonzero(key[1:] != key[:-1]) + 1).tolist()
    return [
        ((int(key[begin]) >> 17, int(key[begin]) & 0x1FFFF), order[begin:end])
        for begin, end in itertools.pairwise([0, *edges, len(key)])
    ]


def is_beside(one: Stream, other: Stream) -> bool:
    """Whether two streams may be of one sensor: same source IP, or topics of one namespace."""
    return one.source_ip == other.source_ip and same_namespace(one.topic, other.topic)


def has_receive_times(untimed: Collection[int], sensor: Found) -> bool:
    """True if the packets of a sensor have receive times of their own; untimed: see StreamTable."""
    return not any(stream in untimed for stream, _ in sensor.kinds)


def clock_watch(lidar: Lidar) -> ClockWatch:
    """A watch for the clock of a sensor."""
    return ClockWatch(period_ns=lidar.clock_period_ns, mode=lidar.timestamp_mode)
