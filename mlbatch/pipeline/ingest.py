"""Packets of a batch to columns of sensors: routing, validity, raw packets into rings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.batching.intake import Accepted, Arrival, Intake, Payloads
from mlbatch.discovery.router import Role, Router
from mlbatch.discovery.sampler import SAMPLES_PER_KIND, KindFilter, split_by_kind
from mlbatch.discovery.types import PacketKind
from mlbatch.lidar.headers import Headers
from mlbatch.lidar.interface import Lidar
from mlbatch.pipeline.sensor import Sensor
from mlbatch.readers.byte_records import rows
from mlbatch.sensors import content_keys
from mlbatch.types import ImuSamples, PacketBatch

_WORD_BYTES = 4
# Duplicate IMU packets are detected among this many.
RECENT_IMU = 64
# Maps timestamps (P, C) of packets of a sensor, received at (P,), to timestamps for batching.
StampMap = Callable[[Sensor, I64Array, I64Array], I64Array]


@dataclass(slots=True)
class Ingested:
    """Content of a batch: what each sensor accepts (None: no packet of it), IMU samples."""

    accepted: list[Accepted | None]
    imu: list[ImuSamples]


@dataclass(slots=True)
class UnassignedPackets:
    """Packets of one kind that no sensor has; sample: (k, size), some of them.

    Device packets may be more frequent than those of a lidar, so that after the first packets only
    those with another first word are kept.
    """

    sample: U8Array
    packets: int = 0
    what: str | None = None  # description, once it was asked for

    def add(self, batch: PacketBatch, index: I64Array) -> None:
        """Count packets of a batch, and keep some."""
        self.packets += len(index)
        kept = len(self.sample)
        if kept >= SAMPLES_PER_KIND:
            return
        size = self.sample.shape[1]
        head = batch.data[batch.start[index, None] + np.arange(min(size, _WORD_BYTES))]
        is_new = ~np.isin(_words(head), _words(self.sample[:, :_WORD_BYTES]))
        is_new[: max(SAMPLES_PER_KIND // 2 - kept, 0)] = True
        chosen = np.flatnonzero(is_new)[: SAMPLES_PER_KIND - kept]
        rows = batch.data[batch.start[index[chosen], None] + np.arange(size)]
        self.sample = np.concatenate([self.sample, rows])
        self.what = None


def _words(head: U8Array) -> I64Array:
    """(n,) numbers of the first bytes (n, up to 4) of packets."""
    weights = np.int64(1) << 8 * np.arange(head.shape[1])
    return np.asarray(head @ weights, np.int64)


# By kind, and whether the user left them out.
UnassignedKey = tuple[PacketKind, bool]
# Which packets (P, size) of a kind the user left out: (P,) bool.
IsIgnored = Callable[[PacketKind, U8Array], BoolArray]


class Ingest:
    """Assigns packets to sensors and takes their columns in; pixels stay raw.

    intakes: one per sensor; unassigned: packets of no sensor; kind_filter: decides which of their
    kinds are listed.
    """

    def __init__(
        self,
        router: Router,
        sensors: Sequence[Sensor],
        intakes: Sequence[Intake],
        stamp_map: StampMap | None = None,
        is_ignored: IsIgnored | None = None,
    ) -> None:
        """stamp_map: applied to timestamps before they are batched; None: unchanged."""
        self.unassigned: dict[UnassignedKey, UnassignedPackets] = {}
        self.kind_filter = KindFilter()
        self._is_ignored = is_ignored
        self._router = router
        self._sensors = list(sensors)
        self.intakes = list(intakes)
        self._stamp_map = stamp_map
        self._recent_imu: list[I64Array] = [np.empty(0, np.int64) for _ in self._sensors]

    def columns(self, batch: PacketBatch) -> Ingested:
        """Route a batch, keep lidar packets in their rings and take their columns in."""
        own: list[list[I64Array]] = [[] for _ in self._sensors]
        ingested = Ingested([None] * len(self._sensors), [])
        owned = np.zeros(len(batch), bool)
        shared: list[tuple[PacketKind, I64Array]] = []
        unassigned: list[tuple[PacketKind, I64Array]] = []
        for kind, index in split_by_kind(batch):
            route = self._router.route_of(kind, batch, int(index[0]))
            if route.role is Role.LIDAR:
                shared.append((kind, index))
                for number in route.sensors:
                    own[number].append(index)
            elif route.role is Role.IMU:
                owned[index] = True
                ingested.imu += self._imu(batch, index, self._sensors[route.sensors[0]])
            elif route.role is Role.BAD_SIZE:
                packets = self._sensors[route.sensors[0]].ledger.packets
                packets.read += len(index)
                packets.reject("bad_size", len(index))
            else:
                unassigned.append((kind, index))
        for sensor, parts in zip(self._sensors, own, strict=True):
            if parts:
                index = parts[0] if len(parts) == 1 else np.sort(np.concatenate(parts))
                ingested.accepted[sensor.index] = self._accept(sensor, batch, index, owned)
        if not owned.all():
            unassigned += [(kind, index[~owned[index]]) for kind, index in shared]
        left = [(kind, index) for kind, index in unassigned if len(index)]
        for kind, index in self.kind_filter.followed(batch, left):
            self._unassign(kind, batch, index)
        return ingested

    def _unassign(self, kind: PacketKind, batch: PacketBatch, index: I64Array) -> None:
        if self._is_ignored is None:
            self._count(kind, False, batch, index)
            return
        payloads = batch.data[batch.start[index, None] + np.arange(kind.size)]
        ignored = self._is_ignored(kind, payloads)
        self._count(kind, False, batch, index[~ignored])
        self._count(kind, True, batch, index[ignored])

    def _count(self, kind: PacketKind, ignored: bool, batch: PacketBatch, index: I64Array) -> None:
        if not len(index):
            return
        known = self.unassigned.get((kind, ignored))
        if known is None:
            known = UnassignedPackets(np.zeros((0, kind.size), np.uint8))
            self.unassigned[kind, ignored] = known
        known.add(batch, index)

    def _accept(
        self, sensor: Sensor, batch: PacketBatch, index: I64Array, owned: BoolArray
    ) -> Accepted:
        """Keep packets that may be of a sensor, and accept packets that are."""
        intake = self.intakes[sensor.index]
        kept = sensor.source.ring.keep(batch.data, batch.start[index], batch.place)
        host_ns = batch.host_ns[index]
        keys = None if batch.content_key is None else batch.content_key[index]
        packets = Payloads(kept.data, kept.start, keys)
        content: Payloads | Headers = packets
        if self._stamp_map is not None or not intake.reads:
            content = _headers(sensor.lidar, packets, host_ns)
            if self._stamp_map is not None:
                columns = content.columns
                columns.stamp_ns = self._stamp_map(sensor, columns.stamp_ns, host_ns)
        arrival = Arrival(index, host_ns, kept.ring_index, content)
        accepted = intake.accept(arrival, owned)
        sensor.ledger.packets.read += accepted.read
        return accepted

    def _imu(self, batch: PacketBatch, index: I64Array, sensor: Sensor) -> list[ImuSamples]:
        """Samples of IMU packets; duplicates are counted and left out."""
        ledger = sensor.ledger
        ledger.imu_packets += len(index)
        payloads = rows(batch.data, batch.start[index], int(batch.size[index[0]]))
        fresh = self._fresh_imu(sensor, content_keys(payloads))
        if not fresh.all():
            again = len(sensor.lidar.imu(payloads[~fresh], sensor.index).stamp_ns)
            ledger.imu_samples.decoded += again
            ledger.imu_samples.drop("duplicate", again)
            payloads = payloads[fresh]
            index = index[fresh]
        if not sensor.clock.by_host and self._stamp_map is None:
            return [sensor.lidar.imu(payloads, sensor.index)]
        samples = []
        for host_ns, payload in zip(batch.host_ns[index].tolist(), payloads, strict=True):
            sample = sensor.lidar.imu(payload[None], sensor.index)
            if not sensor.clock.by_host and self._stamp_map is not None:
                stamps_ns = sample.stamp_ns[None]
                sample.stamp_ns = self._stamp_map(sensor, stamps_ns, np.array([host_ns]))[0]
            elif len(sample.stamp_ns):
                # Subtract first: damaged timestamps may overflow if added to a receive time.
                sample.stamp_ns = sample.stamp_ns - sample.stamp_ns[-1:] + host_ns
            samples.append(sample)
        return samples

    def _fresh_imu(self, sensor: Sensor, key: I64Array) -> BoolArray:
        """Mask (n,) of the IMU packets whose content differs from that of recent ones."""
        keys = np.concatenate([self._recent_imu[sensor.index], key])
        self._recent_imu[sensor.index] = keys[-RECENT_IMU:]
        if len(set(keys.tolist())) == len(keys):
            # A fifth of the time of `unique`, for packets that are few and nearly always fresh.
            return np.ones(len(key), np.bool_)
        _, first = np.unique(keys, return_index=True)
        fresh = np.zeros(len(keys), np.bool_)
        fresh[first] = True
        return fresh[len(keys) - len(key) :]


def _headers(lidar: Lidar, packets: Payloads, host_ns: I64Array) -> Headers:
    """Headers of packets by the reader of a lidar, or by its own methods."""
    data, start, keys = packets
    if lidar.reader is not None:
        return lidar.reader.read(data, start, host_ns, keys)
    payloads = data[start[:, None] + np.arange(lidar.packet_size)]
    return Headers(
        lidar.sent_by_me(payloads),
        lidar.faults(payloads),
        lidar.sequence(payloads),
        lidar.column_headers(payloads, host_ns),
    )
