"""Samples of the packets of every stream, by which sensors are recognised and measured."""

from __future__ import annotations

import itertools
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import I64Array, U8Array, rows_of
from mlbatch.batching.intake import extremes
from mlbatch.clocks.watch import ClockWatch
from mlbatch.discovery.types import DetectedSensor, PacketKind
from mlbatch.frames.naming import same_namespace
from mlbatch.lidar.interface import Evidence, Lidar, NeighbourStream
from mlbatch.types import PacketBatch, Stream, StreamTable
from mlbatch.units import NS_PER_S

# First packets of a kind that are kept.
SAMPLES_PER_KIND = 16
SAMPLE_EVERY_NS = NS_PER_S // 4
# Packets in a row that are kept of each: where two lidars alternate, some of both.
SAMPLES_IN_A_ROW = 6
# Rates are not measured on less.
SHORTEST_NS = 2 * NS_PER_S
# Packets with a new first word are kept up to this count; most vendors change it in every packet.
MAX_FIRST_WORDS = 8
# No lidar sends so many kinds; cameras and file transfers do.
MAX_NEIGHBOURS = 64
_WORD_BYTES = 4
# Kinds that are followed whatever they are; vehicles with ten lidars send a few dozen.
MOST_KINDS = 256
# Later kinds are examined at this packet, and then each time their number has doubled.
EXAMINED_AT = 16
# Kinds that are counted one by one; then all of them begin anew.
_MOST_COUNTED = 1 << 16


@dataclass(slots=True)
class KindSamples:
    """Samples and counts of one packet kind; times are receive times."""

    pieces: list[bytes]  # payloads of the kept packets, one or more each
    host_ns: list[int]  # of the kept packets, receive times
    numbers: list[int]  # of the kept packets, among all of the kind
    packets: int  # count, kept or not
    first_host_ns: int
    last_host_ns: int
    first_words: set[int]  # of the packets kept for their first word
    since_tick: int = 0  # packets since the first one of a quarter of a second

    def keep(self, batch: PacketBatch, at: int, size: int, number: int) -> None:
        """Keep packet `at` of a batch; number: among all of the kind."""
        begin = int(batch.start[at])
        self.pieces.append(batch.data[begin : begin + size].tobytes())
        self.host_ns.append(int(batch.host_ns[at]))
        self.numbers.append(number)

    def arrays(self) -> tuple[U8Array, I64Array]:
        """Kept payloads (k, size) and their receive times (k,)."""
        if len(self.pieces) > 1:
            # Once: they may be megabytes, and every check of a sensor needs them.
            self.pieces = [b"".join(self.pieces)]
        payloads = np.frombuffer(self.pieces[0], np.uint8)
        rows = payloads.reshape(len(self.host_ns), len(payloads) // len(self.host_ns))
        return rows, np.array(self.host_ns, np.int64)


@dataclass(slots=True)
class KindFilter:
    """Decides which packet kinds are followed, where port scans, file transfers or video send many.

    The first kinds are followed one by one. A later kind is only counted, until it has sent some
    packets and a vendor recognises one of them: memory and time do not grow with streams that no
    sensor sends, and a lidar that starts last is found.

    packets: number of packets that were only counted; kinds: least number of their kinds.
    """

    packets: int = 0
    kinds: int = 0
    _followed: set[PacketKind] = field(default_factory=set)
    _counted: dict[PacketKind, int] = field(default_factory=dict)

    def followed(
        self, batch: PacketBatch, parts: list[tuple[PacketKind, I64Array]]
    ) -> list[tuple[PacketKind, I64Array]]:
        """Return the kinds of a batch to follow, each with its rows from the first one followed.

        parts: kinds with their rows, as by `split_by_kind`. All other packets are counted. The
        result does not depend on the size of batches.
        """
        if len(self._followed) + len(parts) > MOST_KINDS:
            parts = sorted(parts, key=lambda part: int(part[1][0]))
        chosen = []
        for kind, index in parts:
            begin = self._first_row(batch, kind, index)
            self.packets += begin
            if begin < len(index):
                chosen.append((kind, index[begin:] if begin else index))
        return chosen

    def _first_row(self, batch: PacketBatch, kind: PacketKind, index: I64Array) -> int:
        """Number of packets of a kind in a batch before it is followed."""
        if kind in self._followed:
            return 0
        if len(self._followed) < MOST_KINDS:
            self._followed.add(kind)
            return 0
        before = self._counted.get(kind, 0)
        if not before:
            self.kinds += 1
            if len(self._counted) >= _MOST_COUNTED:
                self._counted.clear()
        examined = EXAMINED_AT
        while examined <= before + len(index):
            row = examined - before - 1
            if row >= 0 and _is_recognised(batch, kind, int(index[row])):
                self._counted.pop(kind, None)
                self._followed.add(kind)
                return row
            examined *= 2
        self._counted[kind] = before + len(index)
        return len(index)


def _is_recognised(batch: PacketBatch, kind: PacketKind, row: int) -> bool:
    begin = int(batch.start[row])
    payload = batch.data[begin : begin + kind.size]
    return sensors.describe(kind.size, payload[None]) is not None


@dataclass(slots=True)
class Sampler:
    """Keeps the first packets of every kind and some later ones, and counts them all.

    kind_filter: decides which kinds to follow if there are very many; released: descriptions of
    kinds whose payloads are no longer kept.
    """

    table: StreamTable
    # Samples of each kind, in receive order of their first packets.
    kinds: dict[PacketKind, KindSamples] = field(default_factory=dict)
    kind_filter: KindFilter = field(default_factory=KindFilter)
    released: dict[PacketKind, str | None] = field(default_factory=dict)
    _kinds_of_ip: dict[str, list[PacketKind]] = field(default_factory=dict)

    def add(self, batch: PacketBatch) -> None:
        """Sample a batch."""
        for kind, index in self.kind_filter.followed(batch, split_by_kind(batch)):
            first_ns = int(batch.host_ns[index[0]])
            samples = self.kinds.get(kind) or self._new(kind, first_ns)
            for row in _rows_to_keep(samples, kind, index, batch):
                samples.keep(batch, int(index[row]), kind.size, samples.packets + row)
            samples.packets += len(index)
            samples.last_host_ns = int(batch.host_ns[index[-1]])

    def _new(self, kind: PacketKind, first_host_ns: int) -> KindSamples:
        """Add a kind without packets."""
        source_ip = self.table.streams[kind.stream].source_ip
        self._kinds_of_ip.setdefault(source_ip, []).append(kind)
        samples = KindSamples([], [], [], 0, first_host_ns, 0, set())
        self.kinds[kind] = samples
        return samples

    def restart_counts(self) -> None:
        """Count from zero in another pass, by `count`; samples are kept."""
        for samples in self.kinds.values():
            samples.packets = 0
        self.kind_filter.packets = 0

    def count(self, kind: PacketKind, index: I64Array, batch: PacketBatch) -> bool:
        """Count the packets of a kind at `index` of a batch; True if the kind is new.

        One packet of a new kind is kept: memory does not grow with the recording.
        """
        first_ns = int(batch.host_ns[index[0]])
        is_new = kind not in self.kinds
        if is_new:
            self._new(kind, first_ns).keep(batch, int(index[0]), kind.size, 0)
        samples = self.kinds[kind]
        if not samples.packets:
            samples.first_host_ns = first_ns
        samples.packets += len(index)
        samples.last_host_ns = int(batch.host_ns[index[-1]])
        return is_new

    def share_of(self, kinds: Collection[PacketKind]) -> float:
        """Share of some kinds in the bytes so far; of streams not followed, with the mean size."""
        sizes = {kind: one.packets * kind.size for kind, one in self.kinds.items()}
        packets = sum(one.packets for one in self.kinds.values())
        total = sum(sizes.values())
        if not total:
            return 0.0
        unfollowed = self.kind_filter.packets * total / packets
        return sum(size for kind, size in sizes.items() if kind in kinds) / (total + unfollowed)

    def evidence(self, kind: PacketKind) -> Evidence:
        """Samples of a kind and of its neighbours, as vendors recognise them."""
        stream = self.table.streams[kind.stream]
        near = (
            other
            for other in self._kinds_of_ip[stream.source_ip]
            if other != kind and are_neighbours(self.table.streams[other.stream], stream)
        )
        neighbours = tuple(
            NeighbourStream(
                self.table.streams[other.stream], other.size, *self.kinds[other].arrays()
            )
            for other in itertools.islice(near, MAX_NEIGHBOURS)
        )
        return Evidence(stream, kind.size, *self.kinds[kind].arrays(), neighbours)

    def good_samples(self, kind: PacketKind, lidar: Lidar) -> tuple[U8Array, I64Array, I64Array]:
        """Packets (k, packet_size) of a kind that a lidar sent intact.

        With receive times (k,), and the position of each among all of its kind (k,).
        """
        samples = self.kinds[kind]
        packets, host_ns = samples.arrays()
        packets = packets[:, : lidar.packet_size]
        good = lidar.sent_by_me(packets) & (lidar.faults(packets) == 0)
        numbers = np.array(samples.numbers, np.int64)
        return rows_of(packets, good), rows_of(host_ns, good), rows_of(numbers, good)

    def first_host_ns(self, sensor: DetectedSensor) -> int | None:
        """Receive time of the first packet of a sensor; None if it sent none."""
        sampled = sensor.kinds & self.kinds.keys()
        return min((self.kinds[kind].first_host_ns for kind in sampled), default=None)

    def has_receive_times(self, sensor: DetectedSensor) -> bool:
        """True if the packets of a sensor have receive times of their own; see `StreamTable`."""
        return not sensor.streams & self.table.untimed

    def clock_offset_ns(self, sensor: DetectedSensor) -> int | None:
        """Clock of a sensor minus the capture host's, up to the first step; None if unknown.

        By the envelope; where packets have no receive times, the first timestamp minus the log time
        of its message.
        """
        firsts = []
        for kind in sensor.kinds:
            packets, host_ns, _ = self.good_samples(kind, sensor.lidar)
            headers = sensor.lidar.column_headers(packets, host_ns)
            rows = np.flatnonzero(headers.valid.any(axis=1))
            if not len(rows):
                continue
            row = int(rows[0])
            stamp_ns = int(headers.stamp_ns[row, int(headers.valid[row].argmax())])
            offset_ns = stamp_ns - int(host_ns[row])
            if self.has_receive_times(sensor):
                _, newest_ns = extremes(headers)
                watch = clock_watch(sensor.lidar)
                watch.add(newest_ns[rows], host_ns[rows])
                estimate = watch.estimate()
                offset_ns = offset_ns if estimate is None else estimate.segments[0].offset_ns
            firsts.append((int(host_ns[row]), offset_ns))
        return min(firsts)[1] if firsts else None

    def columns_per_s(self, sensor: DetectedSensor) -> float | None:
        """Columns per second that a sensor sends without loss; None if unknown.

        The nominal rate times the share of columns that is sent, rounded to percent: the figure
        must not depend on receive times.
        """
        period_ns = sensor.lidar.column_period_ns
        if not period_ns:
            return None
        shares = [self._share_sent(kind, sensor.lidar) for kind in sensor.kinds]
        share = max((share for share in shares if share is not None), default=0.0)
        return round(share, 2) * NS_PER_S / period_ns if share else None

    def _share_sent(self, kind: PacketKind, lidar: Lidar) -> float | None:
        """Valid columns sent per column of whole revolutions, from the first sample to the last."""
        packets, host_ns, _ = self.good_samples(kind, lidar)
        if len(packets) < 2 or host_ns[-1] - host_ns[0] < SHORTEST_NS:
            return None
        headers = lidar.column_headers(packets, host_ns)
        number = lidar.sequence(packets)
        first = 0
        last = len(packets) - 1
        sent = self.kinds[kind].packets - 1
        counted = np.flatnonzero(number >= 0)
        if lidar.sequence_modulus and len(counted) > 1:
            first = int(counted[0])
            last = int(counted[-1])
            sent = int(number[last] - number[first]) % lidar.sequence_modulus
        passed_ns = int(headers.stamp_ns[last].max() - headers.stamp_ns[first].max())
        valid = float(headers.valid.sum(axis=1).mean())
        return sent * valid * lidar.column_period_ns / passed_ns if passed_ns > 0 else None


def _rows_to_keep(
    samples: KindSamples, kind: PacketKind, index: I64Array, batch: PacketBatch
) -> list[int]:
    """Rows of `index` to keep: the first packets, then six of every quarter of a second.

    Several sensors may share a kind, and one of them may start later than the others. The choice
    follows receive times, so that it does not depend on the size of batches. The first packets
    with each first word are kept as well: device packets may be rare among others on one topic.
    """
    host_ns = batch.host_ns[index]
    last_host_ns = samples.last_host_ns
    tick = np.concatenate([[last_host_ns], host_ns]) // SAMPLE_EVERY_NS
    is_first = tick[1:] != tick[:-1]
    # Of each packet, the number of packets since the first one of its quarter.
    number = np.arange(len(index))
    last_first = np.maximum.accumulate(np.where(is_first, number, -1))
    since = np.where(last_first < 0, samples.since_tick + 1 + number, number - last_first)
    keep = since < SAMPLES_IN_A_ROW
    samples.since_tick = int(since[-1])
    keep[: max(SAMPLES_PER_KIND - samples.packets, 0)] = True
    if kind.size >= _WORD_BYTES and len(samples.first_words) < MAX_FIRST_WORDS:
        words = batch.data[batch.start[index, None] + np.arange(_WORD_BYTES)].view("<u4")[:, 0]
        values, rows = np.unique(words, return_index=True)
        for at in np.argsort(rows, kind="stable").tolist():
            value = int(values[at])
            if value not in samples.first_words and len(samples.first_words) < MAX_FIRST_WORDS:
                samples.first_words.add(value)
                keep[rows[at]] = True
    chosen: list[int] = np.flatnonzero(keep).tolist()
    return chosen


def split_by_kind(batch: PacketBatch) -> list[tuple[PacketKind, I64Array]]:
    """Indices of the packets of each kind in a batch, in receive order."""
    if not len(batch):
        return []
    key = batch.stream << 17 | batch.size
    if bool((key == key[0]).all()):
        only = PacketKind(int(batch.stream[0]), int(batch.size[0]))
        return [(only, np.arange(len(batch)))]
    order = key.argsort(kind="stable")
    key = key[order]
    edges = (np.flatnonzero(key[1:] != key[:-1]) + 1).tolist()
    return [
        (PacketKind(int(key[begin]) >> 17, int(key[begin]) & 0x1FFFF), order[begin:end])
        for begin, end in itertools.pairwise([0, *edges, len(key)])
    ]


def are_neighbours(one: Stream, other: Stream) -> bool:
    """True if two streams may be of one sensor: same source IP, or topics of one namespace."""
    return one.source_ip == other.source_ip and same_namespace(one.topic, other.topic)


def clock_watch(lidar: Lidar) -> ClockWatch:
    """A watch for the clock of a sensor."""
    return ClockWatch(period_ns=lidar.clock_period_ns, mode=lidar.timestamp_mode)
